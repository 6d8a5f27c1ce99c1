// What comes out of a device each servo period: power, brake and duty, as its state has it.
#ifndef HEADWAY_DRIVE_H
#define HEADWAY_DRIVE_H

#include "device.h"

void drive(struct device *device, struct board *board, const struct instant *now,
           uint32_t count_us);

#endif
