// What a host may ask of a device besides plans.
#ifndef HEADWAY_OBEY_H
#define HEADWAY_OBEY_H

#include "command.h"
#include "device.h"

// Carries out a command, unless its number has been before; the status tells the result.
void obey(struct device *device, struct board *board, const struct command *command);

// The one command that a group's frame may bring. Its number does not count: it is not the device's.
void obey_stop(struct device *device, const struct board *board);

#endif
