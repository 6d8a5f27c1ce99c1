#include "drive.h"
#include "happen.h"
#include "near.h"
#include "store.h" // the fault log
#include <string.h>

// Where the setpoint comes from.
enum source {
    SOURCE_NONE,   // nothing to drive, or the guard has the output
    SOURCE_OPEN,   // the holding torque alone: the encoder is not trusted
    SOURCE_HOLD,   // the place of the last rest
    SOURCE_TASK,   // homing or jogging
    SOURCE_RAMP,   // the stop ramp
    SOURCE_TRACKS, // what the plans wrote
};

// Inlined where it is called: a call would cost as much as the polynomial.
static inline __attribute__((always_inline)) int32_t value(struct track *track,
                                                           const struct instant *at) {
    return span_value(track_span(track, at->knot), at->phase);
}

static inline __attribute__((always_inline)) struct scale
gain(struct track *track, const struct instant *at, struct scale fixed) {
    if (!track->written)
        return fixed;
    int32_t mantissa = value(track, at) >> 8; // points are mantissa Q8
    fixed.mantissa = (uint16_t)(mantissa < 0 ? 0 : mantissa > 65535 ? 65535 : mantissa);
    return fixed;
}

static void from_tracks(struct device *device, const struct instant *now,
                        struct setpoint *setpoint) {
    const struct device_settings *settings = &device->settings;
    const struct servo_settings *servo = &settings->servo;
    struct track *tracks = device->tracks;
    // The output holds for a whole period: the least that feed-forward leads by is half of it.
    struct instant ahead = instant_after(now, servo->ahead_us, settings->knot_shift);
    setpoint->position_pq = value(&tracks[TRACK_POSITION], now);
    const struct span *way = track_span(&tracks[TRACK_POSITION], ahead.knot);
    setpoint->velocity_pq = span_rate(way, ahead.phase);
    setpoint->curve_pq = servo->acceleration_tq.mantissa == 0 ? 0 : span_curve(way, ahead.phase);
    setpoint->torque_tq = value(&tracks[TRACK_TORQUE], &ahead);
    setpoint->kp = gain(&tracks[TRACK_KP], now, servo->kp_tq);
    setpoint->ki = gain(&tracks[TRACK_KI], now, servo->ki_tq);
    setpoint->kd = gain(&tracks[TRACK_KD], now, servo->kd_tq);
    setpoint->feedback_limit_tq = SERVO_FEEDBACK_FREE;
    setpoint->integrate = servo->integrate_running;
}

// At a place of its own, with the settings' gains.
static void at(const struct device *device, int32_t position_pq, int32_t period_pq,
               int32_t torque_tq, struct setpoint *setpoint) {
    const struct servo_settings *servo = &device->settings.servo;
    setpoint->position_pq = position_pq;
    setpoint->velocity_pq = fixed_scale(period_pq, device->settings.knot_periods);
    setpoint->curve_pq = 0;
    setpoint->torque_tq = torque_tq;
    setpoint->kp = servo->kp_tq;
    setpoint->ki = servo->ki_tq;
    setpoint->kd = servo->kd_tq;
    setpoint->feedback_limit_tq = SERVO_FEEDBACK_FREE;
    setpoint->integrate = device->state == DEVICE_HOLD && !device->brake;
}

static bool ramps(const struct device *device, uint32_t count_us) {
    bool forced = count_us - device->stop_count_us >= device->settings.stop_us;
    return device->power && device->trusted && !device->brake && !device->ramp.resting && !forced;
}

static enum source source_of(const struct device *device, uint32_t count_us) {
    if (device->guard.verdict != GUARD_LETS)
        return SOURCE_NONE;
    switch (device->state) {
    case DEVICE_ARMED:
        return device->home.task == TASK_NONE ? SOURCE_HOLD : SOURCE_TASK;
    case DEVICE_RUNNING:
    case DEVICE_COAST:
        return SOURCE_TRACKS;
    case DEVICE_TAIL:
        return SOURCE_RAMP;
    case DEVICE_HOLD:
        return SOURCE_HOLD;
    case DEVICE_FAULT:
    case DEVICE_ESTOP:
        if (ramps(device, count_us))
            return SOURCE_RAMP;
        break;
    default:
        break;
    }
    if (!device->power) // else until the brake has engaged
        return SOURCE_NONE;
    return device->trusted ? SOURCE_HOLD : SOURCE_OPEN;
}

// When the brake has to let go for a first plan.
static int64_t release_us(const struct device *device) {
    const struct device_settings *settings = &device->settings;
    return device->start_knot * (1 << settings->knot_shift) -
           (int64_t)settings->brake_periods * settings->servo_period_us;
}

// Off while something may move. It lets go just before a first plan begins, so that till then the
// axis is where it was; where a braked axis is told to stop, it stays.
static bool brake_wanted(const struct device *device, enum source source) {
    switch (source) {
    case SOURCE_NONE:
    case SOURCE_OPEN:
        return true;
    case SOURCE_HOLD:
        return device->brake || !(device->state == DEVICE_ARMED || device->state == DEVICE_HOLD);
    case SOURCE_RAMP:
        return device->brake;
    case SOURCE_TRACKS:
        return device->brake && device->clock.system_us < release_us(device);
    default:
        return false;
    }
}

static void set_brake(struct device *device, bool on) {
    if (device->brake != on)
        device->brake_periods = 0;
    else if (device->brake_periods < device->settings.brake_periods)
        device->brake_periods++;
    device->brake = on;
    bool settled = device->brake_periods == device->settings.brake_periods;
    if (settled && on && !(device->state >= DEVICE_ARMED && device->state <= DEVICE_HOLD))
        device->power = false; // the brake has it
    if (device->guard.verdict == GUARD_OFF)
        device->power = false;
    device->status.released = settled && !on;
}

static void run_task(struct device *device, struct board *board, struct setpoint *setpoint) {
    struct home *home = &device->home;
    const struct home_settings *settings = &device->settings.home;
    struct home_marks marks = {.count = device->encoder_count,
                               .on_switch = board_home_switch(board)};
    marks.indexed = board_index(board, &marks.index_count);
    int32_t feedback_tq = device->servo.unclipped_tq - device->hold_tq;
    marks.pushing = feedback_tq >= settings->torque_tq || feedback_tq <= -settings->torque_tq;
    enum task_result result =
        device->status.released ? home_step(settings, home, &marks) : TASK_RUNS;
    int32_t position_pq = home_position_pq(home), velocity_pq = home_velocity_pq(home);
    if (result == TASK_DONE) {
        if (home->task == TASK_HOME) {
            int32_t moved_count = fixed_difference(home->offset_count, device->offset_count);
            device->offset_count = home->offset_count;
            device_locate(device);
            position_pq = fixed_sum(position_pq, servo_position_pq(moved_count, true));
            if (settings->method == HOME_STOP) { // no longer into it
                position_pq = device->position_pq;
                device->servo.primed = false;
            }
            device->status.homed = true;
        }
        device->hold_pq = position_pq;
        home->task = TASK_NONE;
        monitor_begin(&device->monitor);
    }
    at(device, position_pq, velocity_pq, device->hold_tq, setpoint);
    setpoint->feedback_limit_tq = settings->torque_tq;
    if (result == TASK_FAILED) {
        struct breach breach = {REASON_HOMING,
                                fixed_difference(device->encoder_count, home->start_count),
                                settings->way_counts};
        happen_breach(device, breach, board_count_us(board));
    }
}

static void run_ramp(struct device *device, struct setpoint *setpoint) {
    const struct device_settings *settings = &device->settings;
    struct ramp *ramp = &device->ramp;
    if (ramp->begun)
        ramp_step(ramp, settings->monitor.deceleration_q16, settings->torque_step_tq);
    else
        ramp_start(ramp, device->position_pq, monitor_speed_pq(&device->monitor),
                   device->setpoint.torque_tq, device->hold_tq);
    device->hold_pq = ramp_position_pq(ramp);
    at(device, device->hold_pq, ramp_velocity_pq(ramp), ramp->torque_tq, setpoint);
}

static void find_setpoint(struct device *device, struct board *board, const struct instant *now,
                          enum source source, struct setpoint *setpoint) {
    if (source == SOURCE_TRACKS) {
        from_tracks(device, now, setpoint);
    } else if (source == SOURCE_RAMP) {
        run_ramp(device, setpoint);
    } else if (source == SOURCE_TASK) {
        run_task(device, board, setpoint);
    } else {
        at(device, device->hold_pq, 0, device->hold_tq, setpoint);
        if (source == SOURCE_OPEN) { // nothing of what the encoder says: no speed for the back-EMF
            memset(&device->servo, 0, sizeof device->servo);
            setpoint->feedback_limit_tq = 0;
        }
    }
}

static void note_torque(struct status *status, const struct servo *servo) {
    int32_t torque = servo->unclipped_tq < 0 ? -servo->unclipped_tq : servo->unclipped_tq;
    if (torque > status->torque_peak_tq)
        status->torque_peak_tq = torque;
    if (servo->torque_tq != servo->unclipped_tq)
        status->torque_clipped++;
}

void drive(struct device *device, struct board *board, const struct instant *now,
           uint32_t count_us) {
    enum source source = source_of(device, count_us);
    set_brake(device, brake_wanted(device, source));
    if (device->power && source != SOURCE_NONE) {
        struct setpoint setpoint;
        const struct servo_settings *settings = &device->settings.servo;
        struct servo *servo = &device->servo;
        NEAR(settings);
        NEAR(servo);
        find_setpoint(device, board, now, source, &setpoint);
        int32_t duty = servo_step(settings, servo, &setpoint, device->position_pq);
        // Not as a whole: between its fields a struct has bytes that nobody has set, and a device's
        // state is the same to the last byte after the same history.
        device->setpoint.position_pq = setpoint.position_pq;
        device->setpoint.velocity_pq = setpoint.velocity_pq;
        device->setpoint.torque_tq = setpoint.torque_tq;
        board_set_duty(board, duty);
        note_torque(&device->status, servo);
    } else {
        board_set_duty(board, 0);
    }
    board_set_brake(board, device->brake);
    board_set_power(board, device->power);
    guard_assert(&device->guard, board); // it may have tripped between these lines
    board_set_chopper(board, device->monitor.chopper);
    if (device->faults_unsaved) { // at once, and after all outputs: a reset may come next
        store_save_faults(board, &device->faults);
        device->faults_unsaved = false;
    }
}
