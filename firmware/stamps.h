// The stamps of two frames, one each way. The own ones are counts: whatever is done to the clock
// meanwhile, they stay what they were.
#ifndef HEADWAY_STAMPS_H
#define HEADWAY_STAMPS_H

#include "mark.h"

struct stamps {
    uint32_t echo_us;    // own count when our frame left ...
    int64_t received_us; // ... and the other clock when it arrived there; 0: nothing to echo
    int64_t sent_us;     // the other clock when its own frame left
    struct mark mark;    // what all boards on the bus agree on
};

#endif
