// What arrives at a device: packets, opened and acted on.
#ifndef HEADWAY_INBOX_H
#define HEADWAY_INBOX_H

#include "device.h"

#define INBOX_PACKETS 12 // looked at in a poll

// Takes what has arrived, up to the first packet that is worth decoding: the servo waits for one at
// most. The rest waits in the board's queue.
void inbox_take(struct device *device, struct board *board);

#endif
