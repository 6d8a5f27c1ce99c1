// When a board that no plant steps is polled: at each of its servo periods, by its own counter, and
// at random in between.
#ifndef HEADWAY_SIM_POLLS_H
#define HEADWAY_SIM_POLLS_H

#include "oscillator.h"

struct polls {
    struct oscillator counter; // as the board's, but never stepped
    uint32_t period_us;        // by the counter
    uint32_t period_count;     // at the next period
    int64_t period_at_us;      // true time then, the first at which the counter is there
    uint32_t pause_us;         // between random polls, on average; 0: there are none
    int64_t pause_at_us;
    uint64_t random;
};

// From true time 0 on.
void polls_begin(struct polls *polls, const struct oscillator *counter, uint32_t period_us,
                 uint32_t pause_us, uint64_t random);

// True time of the next poll.
int64_t polls_next_us(const struct polls *polls);

// That one is over.
void polls_pass(struct polls *polls);

#endif
