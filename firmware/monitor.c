#include "monitor.h"
#include "near.h"

static int32_t magnitude(int32_t value) { return value < 0 ? -value : value; }

int32_t monitor_speed_pq(const struct monitor *monitor) {
    return monitor->speed_sum / MONITOR_SPEED_PERIODS;
}

void monitor_begin(struct monitor *monitor) {
    monitor->following = 0;
    monitor->torque = 0;
    monitor->begun = false;
    monitor->still_periods = 0;
}

// Of two that one period found: the one with the sterner response, else the first. Apart, and called:
// what hardly ever happens is not to make way for what always does.
static RARE void found(struct monitor *monitor, enum fault_reason reason, int32_t value,
                       int32_t limit) {
    struct breach *worst = &monitor->breach;
    if (worst->reason != REASON_NONE && fault_response(reason) <= fault_response(worst->reason))
        return;
    worst->reason = reason;
    worst->value = value;
    worst->limit = limit;
}

// The encoder's counts: a jump is lost pulses or a broken wire.
static inline void watch_count(const struct monitor_settings *settings, struct monitor *monitor,
                               int32_t count) {
    int32_t change = fixed_difference(count, monitor->count);
    if (!monitor->primed) {
        monitor->primed = true;
        change = 0;
    }
    monitor->count = count;
    if (change > settings->spike_counts || change < -settings->spike_counts)
        found(monitor, REASON_SPIKE, change, settings->spike_counts);
    else
        monitor->speed_sum += change * (1 << SERVO_COUNT_BITS) - monitor_speed_pq(monitor);
}

// Pushed hard, by whatever asks for it, or led on by its setpoint, an axis moves: an encoder that shows
// nothing is stuck. What counts is how the torque has changed since the last count: at rest a heavy
// load is held by any torque for as long as it takes; and a homing stop or a brake is there to stand
// against.
static inline void watch_stuck(const struct monitor_settings *settings, struct monitor *monitor,
                               const struct observation *seen) {
    bool moved = seen->count != monitor->still_count;
    monitor->still_count = seen->count;
    if (!seen->driven)
        return;
    int32_t setpoint_pq = seen->setpoint_pq, torque_tq = seen->servo->torque_tq;
    if (moved || !monitor->begun || seen->may_stand) {
        monitor->begun = true;
        monitor->still_pq = setpoint_pq;
        monitor->still_tq = torque_tq;
        monitor->still_periods = 0;
        return;
    }
    int32_t way_pq = fixed_difference(setpoint_pq, monitor->still_pq);
    if (way_pq > settings->stuck_pq || way_pq < -settings->stuck_pq) {
        found(monitor, REASON_STUCK, way_pq, settings->stuck_pq);
        return;
    }
    bool pushed = magnitude(torque_tq - monitor->still_tq) >= seen->torque_limit_tq >> 1;
    monitor->still_periods = pushed ? monitor->still_periods + seen->stuck_periods : 0;
    if (monitor->still_periods > settings->stuck_periods)
        found(monitor, REASON_STUCK, (int32_t)monitor->still_periods,
              (int32_t)settings->stuck_periods);
}

// The chopper works whether the bridge is on or not: the bridge's capacitor may be full either way.
static void watch_supply(const struct monitor_settings *settings, struct monitor *monitor,
                         int32_t supply_mV, bool power) {
    int32_t off_mV = settings->chopper_mV - (settings->chopper_mV >> MONITOR_CHOPPER_OFF_SHIFT);
    monitor->chopper = supply_mV > (monitor->chopper ? off_mV : settings->chopper_mV);
    monitor->under = power && supply_mV < settings->supply_min_mV ? monitor->under + 1 : 0;
    monitor->over = power && supply_mV > settings->supply_max_mV ? monitor->over + 1 : 0;
    if (monitor->under >= MONITOR_SUPPLY_PERIODS) {
        monitor->under = 0;
        found(monitor, REASON_UNDERVOLTAGE, supply_mV, settings->supply_min_mV);
    } else if (monitor->over >= MONITOR_SUPPLY_PERIODS) {
        monitor->over = 0;
        found(monitor, REASON_OVERVOLTAGE, supply_mV, settings->supply_max_mV);
    }
}

// The winding's temperature as a first-order lag of the copper loss.
static APART void warm(const struct monitor_settings *settings, struct monitor *monitor) {
    // Of a few periods more, if looks stand for several: no more than there can be.
    int32_t mean_q16 = fixed_clamp64(monitor->heat / MONITOR_HEAT_PERIODS, 1 << 30);
    int64_t change_q32 = fixed_mul_u16(mean_q16 - monitor->rise_q16, settings->heating_q16) +
                         monitor->rise_fraction; // kept: else a slow winding would stay cold
    monitor->rise_q16 += (int32_t)(change_q32 >> 16);
    monitor->rise_fraction = (uint16_t)change_q32;
    monitor->heat = 0;
    monitor->heat_periods = 0;
}

// Two bounds on the motor's heat: what is above the continuous torque for seconds (i2t), and the
// winding's temperature for minutes.
static void watch_heat(const struct monitor_settings *settings, struct monitor *monitor,
                       int32_t effort_tq, int32_t shift) {
    // The mean magnitude stands for all of these periods.
    int32_t torque_tq = effort_tq >> shift, periods = 1 << shift;
    int32_t load_q8 = fixed_clamp(fixed_scale_within(torque_tq, settings->load_q8, 16), 1 << 15);
    int32_t loss_q16 = load_q8 * load_q8;
    int32_t above_q16 = loss_q16 - MONITOR_LOAD_ONE_Q8 * MONITOR_LOAD_ONE_Q8;
    monitor->overload += fixed_mul_u16(above_q16, (uint16_t)periods);
    if (monitor->overload < 0)
        monitor->overload = 0;
    monitor->heat += fixed_mul_u16(loss_q16, (uint16_t)periods);
    monitor->heat_periods += (uint16_t)periods;
    if (monitor->overload >> 16 > (int64_t)settings->overload)
        found(monitor, REASON_I2T, (int32_t)(monitor->overload >> 16), (int32_t)settings->overload);
}

static void watch_winding(const struct monitor_settings *settings, struct monitor *monitor) {
    if (monitor->heat_periods >= MONITOR_HEAT_PERIODS)
        warm(settings, monitor);
    if (monitor->rise_q16 > settings->rise_q16)
        found(monitor, REASON_WINDING, monitor->rise_q16, settings->rise_q16);
}

// v^2 / 2 <= a (limit - position): these two products need 64 bits.
static RARE bool has_room_exactly(uint32_t pace, uint32_t room, uint32_t deceleration_q16) {
    pace = pace > 1 << 22 ? 1 << 22 : pace;
    uint64_t energy_q16 = fixed_mul_u32(pace, pace) << 15; // v^2 / 2
    return energy_q16 <= fixed_mul_u32(room, deceleration_q16);
}

// The same. Where a room and a deceleration rounded down are enough, as nearly always, 32 bits are.
static inline bool has_room(uint32_t pace, uint32_t room, uint32_t deceleration_q16) {
    uint32_t less_q8 = deceleration_q16 >> 8;
    return ((pace | less_q8) >> 16 == 0 && pace * pace >> 9 < (room >> 16) * less_q8) ||
           has_room_exactly(pace, room, deceleration_q16);
}

// In the direction of motion. Past the limit a ramp that began where the axis was found would follow
// it out, again and again: there only the brake ends it. False if there is no room.
static inline bool watch_room(const struct monitor_settings *settings, struct monitor *monitor,
                              int32_t speed, int32_t position_pq) {
    int32_t limit = speed > 0 ? settings->high_pq : settings->low_pq;
    bool outside = speed > 0 ? position_pq > limit : position_pq < limit;
    uint32_t room = (uint32_t)limit - (uint32_t)position_pq;
    if (outside)
        found(monitor, REASON_OUTSIDE, position_pq, limit);
    else if (has_room((uint32_t)magnitude(speed), speed > 0 ? room : 0u - room,
                      (uint32_t)settings->deceleration_q16))
        return true;
    else
        found(monitor, REASON_ROOM, position_pq, limit);
    return false;
}

// The torque of a loop whose encoder counts backwards makes its own error grow: the axis moves away
// from its setpoint against the feedback, and the ramp, which trusts the same encoder, would drive it
// on. An overpowered motor looks alike; there, too, only the brake helps.
static enum fault_reason why_behind(const struct servo *servo, int32_t speed) {
    int32_t away = servo->error_pq > 0 ? -speed : speed;
    bool restoring = (servo->feedback_tq > 0) == (servo->error_pq > 0);
    return restoring && away > 1 << SERVO_COUNT_BITS ? REASON_REVERSED : REASON_FOLLOWING;
}

bool monitor_inside(const struct monitor_settings *settings, int32_t position_pq) {
    return !settings->bounded ||
           (position_pq >= settings->low_pq && position_pq <= settings->high_pq);
}

static inline void watch_motion(const struct monitor_settings *settings, struct monitor *monitor,
                                const struct observation *seen) {
    int32_t speed = monitor_speed_pq(monitor);
    if (speed > settings->speed_pq || speed < -settings->speed_pq) {
        found(monitor, REASON_SPEED, speed, settings->speed_pq);
        return;
    }
    if (settings->bounded && seen->bounded &&
        !watch_room(settings, monitor, speed, seen->position_pq))
        return;
    const struct servo *servo = seen->servo;
    if (magnitude(servo->error_pq) > settings->following_pq) {
        if (++monitor->following > settings->following_periods) {
            found(monitor, why_behind(servo, speed), servo->error_pq, settings->following_pq);
            return;
        }
    } else {
        monitor->following = 0;
    }
    monitor->torque = servo->clipped ? monitor->torque + 1 : 0;
    if (monitor->torque > settings->torque_periods)
        found(monitor, REASON_TORQUE, (int32_t)monitor->torque, (int32_t)settings->torque_periods);
}

static void watch_late(const struct monitor_settings *settings, struct monitor *monitor,
                       const struct observation *seen) {
    if (seen->power && seen->late_us > settings->late_us)
        found(monitor, REASON_LATE, (int32_t)seen->late_us, (int32_t)settings->late_us);
}

// What need not be judged in each period. Called, it would need all that was seen in memory.
static INLINE void watch_slowly(const struct monitor_settings *settings, struct monitor *monitor,
                                const struct observation *seen) {
    if (seen->looks & LOOK_STUCK)
        watch_stuck(settings, monitor, seen);
    if (seen->looks & LOOK_SUPPLY)
        watch_supply(settings, monitor, seen->supply_mV, seen->power);
    if (seen->looks & LOOK_HEAT)
        watch_heat(settings, monitor, seen->power ? seen->servo->effort_tq : 0, seen->heat_shift);
    if (seen->looks & LOOK_WINDING)
        watch_winding(settings, monitor);
}

void monitor_step(const struct monitor_settings *settings, struct monitor *monitor,
                  const struct observation *seen) {
    monitor->breach.reason = REASON_NONE;
    // First: a period that comes late finds the encoder far away, and that is no jump.
    watch_late(settings, monitor, seen);
    watch_count(settings, monitor, seen->count);
    if (seen->looks != 0)
        watch_slowly(settings, monitor, seen);
    if (seen->driven)
        watch_motion(settings, monitor, seen);
}
