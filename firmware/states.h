// The states of a device and what leads from one to the next: one table, in states.c.
#ifndef HEADWAY_STATES_H
#define HEADWAY_STATES_H

enum device_state {
    DEVICE_BOOT,     // output off, brake on: settings are read and checked
    DEVICE_UNSYNCED, // no motion; the only state in which the clock may step
    DEVICE_IDLE,     // synced, output off, brake on
    DEVICE_ARMED,    // output on, holds the position; a homing or jog task may run
    DEVICE_RUNNING,  // executes its tracks
    DEVICE_COAST,    // no plan accepted for a while: the last one runs on to its rest
    DEVICE_TAIL,     // ramps to rest from the measured motion
    DEVICE_HOLD,     // at rest: keeps position and last torque, integrator on, takes no plan
    DEVICE_FAULT, // latched: ramps to rest if the encoder is trusted, then brake, then output off
    DEVICE_ESTOP, // the same, by the emergency line, with a timer that does not wait for the ramp
    DEVICE_STATES,
};

enum device_event {
    EVENT_BOOTED,    // settings are good
    EVENT_SYNCED,    // the clock has settled
    EVENT_SYNC_LOST, // no clock sample for too long
    EVENT_ARM,       // host: at rest, homed or for a task with low limits of its own
    EVENT_DISARM,    // host
    EVENT_PLAN,      // a plan passed the gate
    EVENT_OVERDUE,   // no plan accepted for too long
    EVENT_RESTED,    // the last plan, or the ramp, has come to its rest
    EVENT_RESUME,    // host: a new epoch of plans
    EVENT_STOP,      // host, a gap or a monitor: come to rest from the measured motion
    EVENT_FAULT,     // a monitor or the self-test
    EVENT_CLEAR,     // operator: cause gone, output off; for ESTOP, the line closed again
    EVENT_ESTOP,     // the emergency line is open
    DEVICE_EVENTS,
};

// The state after an event: the same one where the table has no exit for it.
enum device_state next_state(enum device_state state, enum device_event event);

#endif
