// What happens to a device: events and breaches, and what entering a state does.
#ifndef HEADWAY_HAPPEN_H
#define HEADWAY_HAPPEN_H

#include "device.h"

// Takes the device to the event's next state. Returns whether there is one.
bool happen(struct device *device, enum device_event event);

// The torque that holds the axis at rest, the integrator's share included.
int32_t held_torque(const struct device *device);

// A stop with a reason: frozen, logged, and answered as fault_response says.
void happen_breach(struct device *device, struct breach breach, uint32_t count_us);

#endif
