// What arrives at a device: packets, opened and acted on.
#ifndef HEADWAY_INBOX_H
#define HEADWAY_INBOX_H

#include "device.h"

// Takes a packet that arrived at a count; `count_us` is now. The packet is decoded in place.
void inbox_take(struct device *device, struct board *board, uint8_t *packet, int32_t size,
                int32_t port, uint32_t arrived_us, uint32_t count_us);

#endif
