#include "happen.h"
#include <string.h>

static bool executes(enum device_state state) {
    return state == DEVICE_RUNNING || state == DEVICE_COAST;
}

static bool follows(enum device_state state) { // a setpoint, by the servo
    return state >= DEVICE_ARMED && state <= DEVICE_HOLD;
}

// The torque that holds the axis where the last plan ends.
static int32_t last_torque(const struct device *device) {
    const struct track *torque = &device->tracks[TRACK_TORQUE];
    return executes(device->state) && torque->written ? track_point(torque, torque->end)
                                                      : device->hold_tq;
}

static void flush(struct device *device) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        device->tracks[sink].written = false;
}

// What carries the axis besides the holding torque and the integral: without an integral it has
// sagged until its error pulled as much as it weighs. It rests where it is now, with that pull.
static int32_t pull(const struct device *device, enum device_state from) {
    bool rests = (from == DEVICE_ARMED || from == DEVICE_HOLD) && device->home.task == TASK_NONE;
    return rests ? fixed_clamp(fixed_scale(device->servo.error_pq, device->settings.servo.kp_tq),
                               device->settings.servo.torque_limit_tq)
                 : 0;
}

// From the motion as the next servo period measures it, whatever was asked for before.
static void begin_ramp(struct device *device, enum device_state from) {
    device->hold_tq = fixed_clamp(last_torque(device) + pull(device, from),
                                  device->settings.servo.torque_limit_tq);
    device->hold_pq = device->steps ? device->stepper.target_pq : device->position_pq;
    device->ramp.begun = device->ramp.resting = false;
    device->servo.primed = false; // the error jumps: no kick by its difference
}

static void rest_where_it_is(struct device *device, enum device_state from) {
    if (executes(from)) {
        const struct track *position = &device->tracks[TRACK_POSITION];
        device->hold_tq = last_torque(device);
        device->hold_pq = track_point(position, position->end);
    } else { // the ramp's
        device->hold_pq = ramp_position_pq(&device->ramp);
    }
}

int32_t held_torque(const struct device *device) {
    return fixed_clamp(device->hold_tq + (device->servo.integral >> SERVO_INTEGRAL_BITS),
                       device->settings.servo.torque_limit_tq);
}

static void take_hold(struct device *device) {
    memset(&device->servo, 0, sizeof device->servo);
    device->hold_pq = device->position_pq;
    device->setpoint.torque_tq = device->hold_tq;
    stepper_begin(&device->stepper, device->hold_pq);
    device->power = true;
}

// What the integrator found out at rest becomes holding torque: a plan brings its own, and would
// have the integral on top of it.
static void fold_integral(struct device *device) {
    device->hold_tq = held_torque(device);
    device->servo.integral = 0;
}

bool happen(struct device *device, enum device_event event) {
    enum device_state from = device->state, to = next_state(from, event);
    if (to == from)
        return false;
    switch (to) {
    case DEVICE_UNSYNCED:
        sync_restart(&device->sync); // it may have run alone for long
        break;
    case DEVICE_ARMED:
        if (from == DEVICE_IDLE)
            take_hold(device);
        else
            fold_integral(device);
        break;
    case DEVICE_TAIL:
        begin_ramp(device, from);
        break;
    case DEVICE_HOLD:
        rest_where_it_is(device, from);
        break;
    case DEVICE_FAULT:
    case DEVICE_ESTOP:
        if (follows(from) && from != DEVICE_TAIL) // else nothing moves, or the ramp is under way
            begin_ramp(device, from);
        break;
    default:
        break;
    }
    if (!executes(to))
        flush(device);
    device->home.task = TASK_NONE;
    device->state = to;
    if (!(executes(from) && executes(to))) { // another setpoint, from here on
        bool held = to == DEVICE_ARMED || to == DEVICE_HOLD;
        device->setpoint.position_pq = held ? device->hold_pq : device->position_pq;
        monitor_begin(&device->watch.monitor);
    }
    return true;
}

// A ramp that the axis does not follow is no way to stop it.
static enum device_event event_of(enum fault_reason reason, enum device_state state) {
    if (reason == REASON_SYNC_LOST || reason == REASON_CLOCK)
        return EVENT_SYNC_LOST;
    if (state == DEVICE_TAIL && (reason == REASON_FOLLOWING || reason == REASON_TORQUE))
        return EVENT_FAULT;
    return fault_response(reason) == RESPONSE_TAIL ? EVENT_STOP : EVENT_FAULT;
}

void happen_breach(struct device *device, struct breach breach, uint32_t count_us) {
    enum device_state from = device->state;
    if (fault_response(breach.reason) == RESPONSE_BRAKE)
        device->trusted = false; // also in the middle of a ramp
    bool stops = happen(device, event_of(breach.reason, from));
    if (breach.reason == REASON_OUTSIDE) // the brake now: there is no way left for a ramp
        device->ramp.resting = true;
    if (!stops || device->state == DEVICE_UNSYNCED)
        return; // nothing stopped
    struct fault fault = {
        .reason = (uint8_t)breach.reason,
        .state = (uint8_t)from,
        .boots = device->boots,
        .time_us = clock_at(&device->clock, count_us),
        .value = breach.value,
        .limit = breach.limit,
        .position_pq = device->position_pq,
        .torque_tq = device->servo.unclipped_tq,
    };
    device->status.fault = fault;
    fault_log_add(&device->faults, &fault);
    device->faults_unsaved = true;
}
