// What arrives at a device: packets, opened and acted on.
#ifndef HEADWAY_INBOX_H
#define HEADWAY_INBOX_H

#include "device.h"

// Takes all that has arrived.
void inbox_empty(struct device *device, struct board *board);

#endif
