// The boards beside this one, asked for their time, and given and giving values.
#ifndef HEADWAY_NEIGHBOURS_H
#define HEADWAY_NEIGHBOURS_H

#include "board.h"
#include <stdbool.h>
#include <stdint.h>

struct device;

// What was asked last, and is not answered yet.
struct question {
    bool open;
    uint64_t nonce;
    uint32_t sent_us; // count
};

// What a neighbour asked last, and has no answer yet.
struct demand {
    bool open;
    uint64_t nonce;
    uint32_t arrived_us;  // count ...
    int64_t received_us;  // ... and system time
    uint32_t answered_us; // count from which on it is answered
};

struct neighbours {
    uint32_t asked_us; // count of the last round
    uint32_t pause_us; // until the next
    struct question questions[BOARD_PORTS];
    struct demand demands[BOARD_PORTS];
};

// Asks all ports that the settings name, once an interval, and answers what they have asked. Gives all of
// them what the logic says (feed.h), one frame each at a time. Pauses
// differ at random by up to a quarter, and an answer waits at random for up to the settings'
// `dither_us`: neither keeps step with anything on the way. To be called as often as may be.
void neighbours_speak(struct device *device, struct board *board);

// After a step of the clock: the arrival of what was asked before is by another time than an answer
// would be, so there will be none.
void neighbours_flush(struct device *device);

// What came from a neighbour: keeps a request, takes the stamps of a response or the points of a feed.
bool neighbours_take(struct device *device, struct board *board, const uint8_t *frame, int32_t size,
                     int32_t port, uint32_t arrived_us, uint32_t count_us);

#endif
