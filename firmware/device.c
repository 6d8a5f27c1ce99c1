#include "device.h"
#include "admit.h"
#include "drive.h"
#include "happen.h"
#include "inbox.h"
#include "near.h"
#include "outbox.h"
#include "store.h"
#include <string.h>

void device_locate(struct device *device) {
    int32_t count = fixed_sum(device->encoder_count, device->offset_count);
    device->position_pq =
        servo_position_pq(count, device->settings.limits[TRACK_POSITION].continuous);
}

void device_configure(struct device *device, const struct device_settings *settings) {
    device->settings = *settings;
    device->law = settings->servo;
    device->watch.settings = settings->monitor;
    device->ahead = (uint32_t)settings->servo.ahead_us << (16 - settings->knot_shift);
    device->offset_count = settings->offset_count;
    device_locate(device); // what is asked for next may rely on it
    device->brake_periods = settings->brake_periods;
    device->steps = settings->step_least_q16 != 0;
    device->takes_turns = settings->servo_period_us * DEVICE_TURNS <= DEVICE_TURNS_US;
    device->status.homed = settings->home.method == HOME_NONE;
}

void device_boot(struct device *device, struct board *board, uint32_t count_us) {
    struct device_settings settings;
    memset(device, 0, sizeof *device);
    bool counted = store_count_boot(board, &device->boots);
    store_load_faults(board, &device->faults);
    device->clock.count_us = count_us;
    device->sync.id = (uint32_t)board_random(board) | 1; // not 0
    sync_restart(&device->sync);
    device->status.mark.width_us = MARK_OPEN;
    device->next_servo_us = count_us;
    device->offer.looked_us = count_us - OFFER_PAUSE_US;
    device->brake = true;
    device->trusted = true;
    device->configured =
        store_load_settings(board, &settings) && settings_valid(&settings) && counted;
    struct breach unusable = {REASON_SETTINGS, 0, 0};
    if (device->configured)
        device_configure(device, &settings);
    else
        happen_breach(device, unusable, count_us);
}

int64_t device_knot_at(const struct device *device, int64_t time_us) {
    return instant_at(time_us, device->settings.knot_shift).knot;
}

bool device_at_rest(const struct device *device) {
    int32_t speed_pq = monitor_speed_pq(&device->watch.monitor);
    return speed_pq < DEVICE_REST_PQ && speed_pq > -DEVICE_REST_PQ;
}

void device_take_stamps(struct device *device, const struct sync_source *source,
                        const struct stamps *stamps, uint32_t arrived_us, uint32_t count_us) {
    bool may_step = device->state == DEVICE_UNSYNCED;
    sync_take(&device->sync, &device->settings.sync, &device->clock, source, stamps, arrived_us,
              count_us, may_step);
}

static void measure(struct device *device, const struct board *board, int64_t time_us) {
    device->encoder_count = board_encoder_count(board);
    device_locate(device);
    if (device->sample_wait-- == 0) {
        device->sample_wait = device->settings.sample_every - 1;
        history_push(&device->history, time_us,
                     fixed_sum(device->encoder_count, device->offset_count));
    }
}

// Whether it is there to stand against something.
static bool may_stand(const struct device *device) {
    return device->brake || (device->state == DEVICE_ARMED && device->home.task == TASK_HOME &&
                             device->settings.home.method == HOME_STOP);
}

// The last period's motion, judged.
static void observe(struct device *device, const struct board *board, uint32_t count_us,
                    uint32_t late_us) {
    uint32_t duties = device->duties;
    struct watch *watch = &device->watch;
    NEAR(watch);
    struct observation seen; // field by field: else all of it is set to 0 first
    seen.count = device->encoder_count;
    seen.position_pq = device->position_pq;
    seen.servo = &device->servo;
    seen.late_us = late_us;
    seen.power = device->power;
    seen.driven = device->power && device->trusted;
    seen.bounded = device->status.homed && device->state != DEVICE_HOLD; // which rests anyhow
    seen.looks = duties & LOOKS;
    if (seen.looks != 0) { // of what they alone judge
        seen.setpoint_pq = device->setpoint.position_pq;
        seen.torque_limit_tq = device->law.torque_limit_tq;
        seen.may_stand = may_stand(device);
        bool all = duties == DUTIES;
        seen.heat_shift = all ? 0 : DEVICE_TURNS_SHIFT;
        seen.stuck_periods = all ? 1 : DEVICE_TURNS / 2;
        if (duties & DUTY_SUPPLY)
            seen.supply_mV = board_supply_mV(board);
    }
    monitor_step(&watch->settings, &watch->monitor, &seen);
    if (duties & DUTY_HEAT)
        device->servo.effort_tq = 0;
    if (watch->monitor.breach.reason != REASON_NONE)
        happen_breach(device, watch->monitor.breach, count_us);
}

// The guard has braked, and the monitor may not have seen why.
static void heed_guard(struct device *device, uint32_t count_us) {
    const struct guard *guard = &device->guard;
    if (guard->verdict == GUARD_LETS || device->state >= DEVICE_FAULT)
        return;
    struct breach late = {REASON_LATE, guard->overdue_us, guard->limit_us};
    happen_breach(device, late, count_us);
}

static bool tracks_rest(const struct device *device, int64_t knot) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (device->tracks[sink].written && knot < device->tracks[sink].end - 1)
            return false;
    return true;
}

// Whether the time can be relied on.
static void follow_sync(struct device *device, uint32_t count_us) {
    const struct sync *sync = &device->sync;
    int64_t alone_us = device->clock.ticks_us - sync->heard_us;
    bool resting = device->state == DEVICE_UNSYNCED || device->state == DEVICE_IDLE;
    bool wrong = sync->outcast >= SYNC_OUTCAST || sync->doubtful;
    if (resting && wrong) { // not one sample is wrong, but what is known
        sync_restart(&device->sync);
        happen(device, EVENT_SYNC_LOST);
    } else if (sync->settled && alone_us <= device->settings.sync_lost_us) {
        if (device->state == DEVICE_UNSYNCED) // the only one in which that is news
            happen(device, EVENT_SYNCED);
    } else if (device->state > DEVICE_UNSYNCED) {
        struct breach alone = {REASON_SYNC_LOST, (int32_t)fixed_clamp64(alone_us, INT32_MAX),
                               (int32_t)device->settings.sync_lost_us};
        struct breach wide = {REASON_CLOCK, sync_error_us(sync),
                              (int32_t)device->settings.sync.limit_us};
        happen_breach(device, sync->settled ? alone : wide, count_us);
    }
}

// What follows from time and from the emergency line.
static void follow(struct device *device, const struct board *board, int64_t knot,
                   uint32_t count_us) {
    if (device->state < DEVICE_FAULT)
        device->stop_count_us = count_us;
    if (board_stop_line(board))
        happen(device, EVENT_ESTOP);
    if (device->state == DEVICE_BOOT)
        happen(device, EVENT_BOOTED);
    if (device->duties & DUTY_RELY)
        follow_sync(device, count_us);
    if (device->state < DEVICE_RUNNING)
        return;
    if ((int32_t)((uint32_t)knot - (uint32_t)device->accepted_knot) > DEVICE_COAST_KNOTS &&
        happen(device, EVENT_OVERDUE))
        device->status.counters.coasts++;
    if (device->state == DEVICE_RUNNING)
        return;
    if (device->state == DEVICE_COAST && tracks_rest(device, knot))
        happen(device, EVENT_RESTED);
    if (device->state == DEVICE_TAIL && device->ramp.resting)
        happen(device, EVENT_RESTED);
}

// A status leaves as its knot begins; now and then a little later, at random: servo periods may keep
// step with a bus, and then each status would wait for its turn there as long as any other. After a
// step of the clock it waits for the next period, which forgets the samples of the time before.
void device_report(struct device *device, struct board *board) {
    if (device->settings.neighbours != 0)
        neighbours_speak(device, board);
    if (!device->status_waits || device->sync.stepped)
        return;
    uint32_t count_us = board_count_us(board);
    if ((int32_t)(count_us - device->status_us) < 0)
        return;
    device->status_waits = false;
    outbox_status(device, board, count_us);
    if (device->signals.used)
        outbox_readings(device, board);
}

// What few logics read. Apart, and called.
static RARE void read_more(struct device *device, const struct board *board, int64_t knot,
                           uint32_t phase) {
    struct instant now = {knot, phase};
    uint32_t reads = device->signals.reads;
    int32_t *values = device->signals.values;
    for (int32_t sink = TRACK_KP; sink <= TRACK_KD; sink++)
        if (reads >> sink & 1)
            values[sink] =
                device->tracks[sink].written ? track_value(&device->tracks[sink], &now) : 0;
    if (reads >> SOURCE_OF_INPUTS) {
        uint8_t inputs = board_digital_inputs(board);
        values[INPUT_POSITION] = fixed_sum(device->encoder_count, device->offset_count);
        values[INPUT_ERROR] = device->servo.error_pq;
        values[INPUT_TORQUE] = device->power ? device->servo.torque_tq : 0;
        values[INPUT_SUPPLY] = board_supply_mV(board);
        values[INPUT_STATE] = (int32_t)device->state;
        for (int32_t i = 0; i < BOARD_DIGITAL; i++)
            values[INPUT_DIGITAL + i] = inputs >> i & 1;
        if (reads >> SIGNALS_READ_PAST)
            signals_recall(&device->signals, device->tracks, device->clock.system_us,
                           device->settings.knot_shift);
    }
}

static void run_signals(struct device *device, struct board *board, const struct instant *now) {
    struct signals *signals = &device->signals;
    NEAR(signals);
    int32_t *values = signals->values;
    values[TRACK_POSITION] = device->setpoint.position_pq;
    values[TRACK_TORQUE] = device->setpoint.torque_tq;
    if (signals->reads >> TRACK_KP != 0)
        read_more(device, board, now->knot, now->phase);
    bool live = device->sync.settled && device->state < DEVICE_FAULT;
    if (!device->sync.settled && signals->logic.feds != 0)
        values[INPUT_LAG] = FEED_UNKNOWN_MS;
    signals_step(signals, board, &device->clock, device->settings.servo_period_us, live);
}

// One track's next span a turn: so none has to make all of them as a knot begins.
static void look_ahead(struct device *device, int64_t knot) {
    if (!(device->duties & DUTY_AHEAD))
        return;
    device->foreseen = device->foreseen == 0 ? TRACK_COUNT - 1 : device->foreseen - 1;
    track_span(&device->tracks[device->foreseen], knot + 1);
}

// Whose turn it is: what takes long is alone. STUCK and SUPPLY come twice, as far apart.
static const uint16_t duties[DEVICE_TURNS] = {
    DUTY_SPEED | DUTY_AHEAD,
    DUTY_CARRY,
    DUTY_SPEED | DUTY_TORQUE | DUTY_COMPARE,
    DUTY_LEAD,
    DUTY_SPEED | DUTY_TORQUE | DUTY_KP,
    DUTY_TORQUE | DUTY_TELL,
    DUTY_SPEED | DUTY_AHEAD,
    DUTY_TORQUE | DUTY_STUCK | DUTY_SUPPLY,
    DUTY_SPEED | DUTY_AHEAD,
    DUTY_TORQUE | DUTY_RELY,
    DUTY_SPEED | DUTY_TORQUE | DUTY_KI,
    DUTY_HEAT,
    DUTY_SPEED | DUTY_AHEAD,
    DUTY_TORQUE | DUTY_WINDING,
    DUTY_SPEED | DUTY_KD,
    DUTY_TORQUE | DUTY_STUCK | DUTY_SUPPLY,
};

static void take_turn(struct device *device) {
    bool all = !device->takes_turns || device->state == DEVICE_UNSYNCED;
    device->turn = (device->turn + 1) % DEVICE_TURNS;
    device->duties = all ? DUTIES : duties[device->turn];
}

static void steer(struct device *device, struct headway_clock *clock) {
    const struct sync_settings *settings = &device->settings.sync;
    struct sync *sync = &device->sync;
    NEAR(settings);
    NEAR(sync);
    if (device->duties == DUTIES) {
        if (sync_steer(sync, settings, clock, device->state == DEVICE_UNSYNCED)) {
            history_flush(&device->history);
            neighbours_flush(device);
        }
    } else if (device->duties & DUTY_CARRY) {
        sync_carry(sync, settings, clock);
    } else if (device->duties & DUTY_COMPARE) {
        sync_compare(sync, settings, clock);
    } else if (device->duties & DUTY_LEAD) {
        sync_lead(sync, settings, clock);
    } else if (device->duties & DUTY_TELL) {
        sync_tell(sync, settings);
    }
}

static void run_period(struct device *device, struct board *board, uint32_t count_us,
                       uint32_t late_us) {
    struct headway_clock *clock = &device->clock;
    NEAR(clock);
    clock_advance(clock, count_us);
    take_turn(device);
    if (device->duties & (DUTY_CARRY | DUTY_COMPARE | DUTY_LEAD | DUTY_TELL))
        steer(device, clock);
    int64_t time_us = device->clock.system_us;
    struct instant now = instant_at(time_us, device->settings.knot_shift);
    measure(device, board, time_us);
    observe(device, board, count_us, late_us);
    follow(device, board, now.knot, count_us);
    heed_guard(device, count_us);
    drive(device, board, &now, count_us);
    look_ahead(device, now.knot);
    if (device->signals.used || !signals_idle(&device->signals))
        run_signals(device, board, &now);
    if (device->duties & DUTY_RELY)
        admit_advance(device, count_us);
    if ((uint32_t)now.knot != (uint32_t)device->status_knot) {
        device->status_knot = now.knot;
        device->status_waits = true;
        device->status_us = count_us;
        if (++device->reports % DEVICE_DITHER_EVERY == 0 && device->settings.dither_us != 0)
            device->status_us += (uint32_t)(board_random(board) % device->settings.dither_us);
    }
}

// Dates a mark as soon as it is seen: later the clock would be another one.
static void watch_bus(struct device *device, const struct board *board) {
    uint16_t number;
    uint32_t count_us;
    if (board_frame_start(board, &number, &count_us) &&
        marks_note(&device->marks, number, count_us))
        device->status.mark =
            sync_date(&device->sync, &device->settings.sync, &device->clock, number, count_us);
}

void device_poll(struct device *device, struct board *board) {
    if (!device->configured) { // off and braked
        board_set_brake(board, true);
        board_set_power(board, false);
        board_set_duty(board, 0);
        return;
    }
    uint32_t count_us = board_count_us(board);
    watch_bus(device, board);
    int32_t late_us = (int32_t)(count_us - device->next_servo_us);
    if (late_us >= 0) {
        // Missed periods are not made up for: what counts them counts time, such as the brake's.
        if (late_us >= device->settings.servo_period_us)
            device->next_servo_us = count_us;
        device->next_servo_us += device->settings.servo_period_us;
        run_period(device, board, count_us, (uint32_t)late_us);
    }
    inbox_take(device, board); // after the servo, which waits for nobody
    device_report(device, board);
}
