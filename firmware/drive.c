#include "drive.h"
#include "happen.h"
#include "near.h"
#include "store.h" // the fault log
#include <string.h>

#define ACCELERATION_BITS 27 // with a torque track's it cannot overflow

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
static INLINE int32_t value(struct track *track, const struct instant *at) {
    return span_value(track_span(track, at->knot), at->phase);
}

// A gain by its track, which has mantissas in 1/256. Apart, and called: it has turns of its own.
static APART void find_gain(struct scale *gain, struct track *track, const struct instant *at,
                            const struct scale *fixed) {
    int32_t mantissa = fixed->mantissa;
    gain->shift = fixed->shift;
    if (track->written)
        mantissa = value(track, at) >> 8;
    gain->mantissa = (uint16_t)(mantissa < 0 ? 0 : mantissa > 65535 ? 65535 : mantissa);
}

static void find_gains(struct device *device, const struct instant *now, uint32_t duties) {
    const struct servo_settings *servo = &device->law;
    struct setpoint *setpoint = &device->setpoint;
    struct track *tracks = device->tracks;
    if (duties & DUTY_KP)
        find_gain(&setpoint->kp, &tracks[TRACK_KP], now, &servo->kp_tq);
    if (duties & DUTY_KI)
        find_gain(&setpoint->ki, &tracks[TRACK_KI], now, &servo->ki_tq);
    if (duties & DUTY_KD)
        find_gain(&setpoint->kd, &tracks[TRACK_KD], now, &servo->kd_tq);
}

// What the position track's acceleration takes. Apart, and called: most axes have a torque track for it.
static APART int32_t accelerating(const struct device *device, int64_t knot, uint32_t phase) {
    struct instant at = {knot, phase};
    int32_t curve_pq = track_curve(&device->tracks[TRACK_POSITION], &at);
    return fixed_scale_within(curve_pq, device->law.acceleration_tq, ACCELERATION_BITS);
}

// What stays as it is while tracks are followed.
static RARE void begin_tracks(struct device *device) {
    device->executes = true;
    device->setpoint.feedback_limit_tq = SERVO_FEEDBACK_FREE;
    device->setpoint.integrate = device->law.integrate_running;
}

static void from_tracks(struct device *device, const struct instant *now,
                        struct setpoint *setpoint) {
    const struct servo_settings *servo = &device->law;
    struct track *tracks = device->tracks;
    uint32_t duties = device->duties;
    // The output holds for a while: the least that feed-forward leads by is half of it.
    struct ahead ahead = instant_ahead(now, device->ahead);
    setpoint->position_pq = value(&tracks[TRACK_POSITION], now);
    if (duties & DUTY_SPEED)
        setpoint->velocity_pq =
            span_rate(track_span_ahead(&tracks[TRACK_POSITION], now, &ahead), ahead.phase);
    if (duties & DUTY_TORQUE) {
        setpoint->torque_tq =
            span_value(track_span_ahead(&tracks[TRACK_TORQUE], now, &ahead), ahead.phase);
        if (servo->acceleration_tq.mantissa)
            setpoint->torque_tq += accelerating(device, now->knot + ahead.knots, ahead.phase);
    }
    if (duties & (DUTY_KP | DUTY_KI | DUTY_KD)) {
        struct instant at = *now; // `now` stays in registers: this copy is what goes to memory
        find_gains(device, &at, duties);
    }
    if (!device->executes)
        begin_tracks(device);
}

// A place beside the tracks, how it moves in a period, and the torque that is needed there.
struct pose {
    int32_t position_pq, period_pq, torque_tq;
};

// There, with the settings' gains.
static void at(const struct device *device, struct pose pose, struct setpoint *setpoint) {
    const struct servo_settings *servo = &device->law;
    setpoint->position_pq = pose.position_pq;
    setpoint->velocity_pq = fixed_scale(pose.period_pq, device->settings.knot_periods);
    setpoint->torque_tq = pose.torque_tq;
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

static RARE enum source source_beside(const struct device *device, uint32_t count_us) {
    switch (device->state) {
    case DEVICE_ARMED:
        return device->home.task == TASK_NONE ? SOURCE_HOLD : SOURCE_TASK;
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

static enum source source_of(const struct device *device, uint32_t count_us) {
    if (device->guard.verdict != GUARD_LETS)
        return SOURCE_NONE;
    bool executes = device->state == DEVICE_RUNNING || device->state == DEVICE_COAST;
    return executes ? SOURCE_TRACKS : source_beside(device, count_us);
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

// A stepper without current may be turned, and nobody counts.
static void switch_off(struct device *device) {
    if (device->power && device->steps)
        device->status.homed = false;
    device->power = false;
}

static RARE void set_brake(struct device *device, bool on) {
    if (device->brake != on)
        device->brake_periods = 0;
    else if (device->brake_periods < device->settings.brake_periods)
        device->brake_periods++;
    device->brake = on;
    bool settled = device->brake_periods == device->settings.brake_periods;
    if (settled && on && !(device->state >= DEVICE_ARMED && device->state <= DEVICE_HOLD))
        switch_off(device); // the brake has it
    if (device->guard.verdict == GUARD_OFF)
        switch_off(device);
    device->status.released = settled && !on;
}

static struct pose run_task(struct device *device, struct board *board) {
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
            stepper_shift(&device->stepper, moved_count);
            if (settings->method == HOME_STOP) { // no longer into it
                position_pq = device->position_pq;
                device->servo.primed = false;
            }
            device->status.homed = true;
        }
        device->hold_pq = position_pq;
        home->task = TASK_NONE;
        monitor_begin(&device->watch.monitor);
    }
    struct pose pose = {position_pq, velocity_pq, device->hold_tq};
    if (result == TASK_FAILED) {
        struct breach breach = {REASON_HOMING,
                                fixed_difference(device->encoder_count, home->start_count),
                                settings->way_counts};
        happen_breach(device, breach, board_count_us(board));
    }
    return pose;
}

static struct pose run_ramp(struct device *device) {
    const struct device_settings *settings = &device->settings;
    struct ramp *ramp = &device->ramp;
    const struct stepper *stepper = &device->stepper;
    bool begins = !ramp->begun, steps = device->steps;
    if (begins && steps) // from what its pulses do: it has to go on as it does
        ramp_start(ramp, stepper->target_pq, fixed_difference(stepper->target_pq, stepper->now_pq),
                   device->hold_tq, device->hold_tq);
    else if (begins)
        ramp_start(ramp, device->position_pq, monitor_speed_pq(&device->watch.monitor),
                   device->setpoint.torque_tq, device->hold_tq);
    if (!begins || steps)
        ramp_step(ramp, settings->monitor.deceleration_q16, settings->torque_step_tq);
    device->hold_pq = ramp_position_pq(ramp);
    return (struct pose){device->hold_pq, ramp_velocity_pq(ramp), ramp->torque_tq};
}

// Where there are no tracks to follow. Apart, and called: so the servo's setpoint stays in registers.
static RARE struct pose lead(struct device *device, struct board *board, enum source source) {
    if (source == SOURCE_RAMP)
        return run_ramp(device);
    if (source == SOURCE_TASK)
        return run_task(device, board);
    return (struct pose){device->hold_pq, 0, device->hold_tq};
}

static RARE void find_beside(struct device *device, struct board *board, enum source source) {
    struct setpoint *setpoint = &device->setpoint;
    device->executes = false;
    at(device, lead(device, board, source), setpoint);
    if (source == SOURCE_TASK)
        setpoint->feedback_limit_tq = device->settings.home.torque_tq;
    if (source == SOURCE_OPEN) { // nothing of what the encoder says: no speed for the back-EMF
        memset(&device->servo, 0, sizeof device->servo);
        setpoint->feedback_limit_tq = 0;
    }
}

static void note_torque(struct status *status, struct servo *servo) {
    int32_t torque = servo->unclipped_tq < 0 ? -servo->unclipped_tq : servo->unclipped_tq;
    if (torque > status->torque_peak_tq)
        status->torque_peak_tq = torque;
    if (servo->clipped) {
        status->torque_clipped++;
        torque = servo->torque_tq < 0 ? -servo->torque_tq : servo->torque_tq;
    }
    servo->effort_tq += torque;
}

// Of a stepper, at the end of the window that begins with the next servo period.
static int32_t find_target(struct device *device, struct board *board, enum source source) {
    uint32_t end_us = device->next_servo_us + device->settings.servo_period_us;
    struct instant end = instant_at(clock_at(&device->clock, end_us), device->settings.knot_shift);
    return source == SOURCE_TRACKS ? track_value(&device->tracks[TRACK_POSITION], &end)
                                   : lead(device, board, source).position_pq;
}

// A stepper's pulses are told a period ahead: the board gives those of a window by itself, however
// late the servo is. Apart, and called: a servo's tick is not to make way for it.
static APART void step(struct device *device, struct board *board, enum source source) {
    const struct device_settings *settings = &device->settings;
    struct stepper *stepper = &device->stepper;
    board_set_duty(board, 0);
    if (!device->power || source == SOURCE_NONE || source == SOURCE_OPEN)
        return;
    int32_t target_pq = find_target(device, board, source);
    struct pulses pulses =
        stepper_step(stepper, settings->step_least_q16, target_pq, settings->servo_period_us);
    if (pulses.steps != 0)
        board_step(board, device->next_servo_us, pulses.steps, pulses.first_q16,
                   pulses.spacing_q16);
    device->setpoint.position_pq = stepper->now_pq;
    device->setpoint.velocity_pq =
        fixed_scale(fixed_difference(stepper->target_pq, stepper->now_pq), settings->knot_periods);
    device->servo.error_pq = fixed_difference(stepper->now_pq, device->position_pq);
}

static uint8_t outputs(const struct device *device) {
    return (uint8_t)(device->brake | device->power << 1 | device->watch.monitor.chopper << 2);
}

// When they change, and else now and then, in case that the board has lost one.
static APART void switch_outputs(struct device *device, struct board *board) {
    device->outputs = outputs(device);
    board_set_brake(board, device->brake);
    board_set_power(board, device->power);
    board_set_chopper(board, device->watch.monitor.chopper);
}

static RARE void save_faults(struct device *device, struct board *board) {
    store_save_faults(board, &device->faults);
    device->faults_unsaved = false;
}

void drive(struct device *device, struct board *board, const struct instant *now,
           uint32_t count_us) {
    enum source source = source_of(device, count_us);
    bool brakes = brake_wanted(device, source);
    if (brakes || !device->status.released) // else it has let go, and there is nothing to do
        set_brake(device, brakes);
    if (device->steps) {
        step(device, board, source);
    } else if (device->power && source != SOURCE_NONE) {
        struct setpoint *setpoint = &device->setpoint;
        const struct servo_settings *settings = &device->law;
        struct servo *servo = &device->servo;
        if (source == SOURCE_TRACKS)
            from_tracks(device, now, setpoint);
        else
            find_beside(device, board, source);
        int32_t duty = servo_step(settings, servo, setpoint, device->position_pq);
        board_set_duty(board, duty);
        note_torque(&device->status, servo);
    } else {
        board_set_duty(board, 0);
    }
    if (device->duties & DUTY_RELY || outputs(device) != device->outputs)
        switch_outputs(device, board);
    guard_assert(&device->guard, board); // it may have tripped between these lines
    if (device->faults_unsaved)          // at once, and after all outputs: a reset may come next
        save_faults(device, board);
}
