// The boards beside this one, asked for their time.
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

struct neighbours {
    uint32_t asked_us; // count of the last round
    uint32_t pause_us; // until the next
    struct question questions[BOARD_PORTS];
};

// Asks all ports that the settings name, once an interval. The pauses differ at random by up to a
// quarter, so that they do not stay in step with anything on the way.
void neighbours_ask(struct device *device, struct board *board, uint32_t count_us);

// What came from a neighbour: answers a request, takes the stamps of a response.
bool neighbours_take(struct device *device, struct board *board, const uint8_t *frame, int32_t size,
                     int32_t port, uint32_t arrived_us, uint32_t count_us);

#endif
