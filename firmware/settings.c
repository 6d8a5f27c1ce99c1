#include "settings.h"
#include "board.h" // ports
#include "fields.h"

static bool scale_valid(struct scale scale) { return scale.shift < 32; }

static bool servo_valid(const struct servo_settings *servo) {
    return scale_valid(servo->kp_tq) && scale_valid(servo->ki_tq) && scale_valid(servo->kd_tq) &&
           scale_valid(servo->velocity_tq) && scale_valid(servo->acceleration_tq) &&
           scale_valid(servo->resistance_mV) && scale_valid(servo->emf_mV) &&
           scale_valid(servo->emf_tq) && scale_valid(servo->supply_duty) &&
           servo->torque_limit_tq > 0 && servo->torque_limit_tq <= SERVO_TORQUE_MAX;
}

static bool monitor_valid(const struct monitor_settings *monitor) {
    return monitor->following_pq > 0 && monitor->speed_pq > 0 && monitor->stuck_pq > 0 &&
           monitor->deceleration_q16 > 0 && monitor->spike_counts > 0 &&
           monitor->spike_counts < 1 << 18 && monitor->rise_q16 > 0 &&
           monitor->low_pq <= monitor->high_pq && scale_valid(monitor->load_q8);
}

static bool home_valid(const struct home_settings *home) {
    if (home->method >= HOME_METHODS)
        return false;
    bool searches = home->method == HOME_NONE || // else with some speed, torque and way
                    (home->speed_q16 > 0 && home->torque_tq > 0 && home->way_counts > 0);
    return searches && home->speed_q16 >= 0 && home->speed_q16 < 1 << 30 &&
           home->acceleration_q16 > 0 && home->torque_tq >= 0 && home->way_counts >= 0;
}

// Slewing needs room beside the drift.
static bool sync_valid(const struct sync_settings *sync) {
    return sync->method < SYNC_METHODS && sync->drift_ppm <= SYNC_DRIFT_MAX_PPM &&
           sync->wander_ppb_s <= SYNC_WANDER_MAX_PPB_S && sync->limit_us > 0 &&
           sync->limit_us <= SYNC_LIMIT_MAX_US && sync->to_device_least_us <= SYNC_LIMIT_MAX_US &&
           sync->to_host_least_us <= SYNC_LIMIT_MAX_US;
}

// The host's port has no neighbour.
static bool neighbours_valid(const struct device_settings *settings) {
    bool apart = !(settings->neighbours & 1) && settings->neighbours >> BOARD_PORTS == 0;
    return apart && settings->peer_least_us <= SYNC_LIMIT_MAX_US && settings->ask_us <= 10000000 &&
           (settings->neighbours == 0 || settings->ask_us >= 1000);
}

// What may be asked of a stepper, by a plan or by a search, is within its rate; the setpoint of the
// window after next has been settled; and a curve leaves the straight line through a window by a T^2 / 8,
// a quarter of a step.
static bool stepper_valid(const struct device_settings *settings) {
    uint32_t least_q16 = settings->step_least_q16, period_us = settings->servo_period_us;
    const struct gate_limits *limits = &settings->limits[TRACK_POSITION];
    uint64_t quarters = 2ULL << SERVO_COUNT_BITS;        // 8 times one
    uint64_t step_q26 = 1ULL << (16 + SERVO_COUNT_BITS); // pq in a step, us in 1/65536
    if (least_q16 == 0)
        return true;
    return (settings->home.method == HOME_INDEX || settings->home.method == HOME_SWITCH) &&
           2 * period_us <= 1u << settings->knot_shift &&
           (uint64_t)limits->difference_max * least_q16 <=
               step_q26 / 1024 * 1023 << settings->knot_shift && // a slewed clock runs faster
           (uint64_t)limits->second_difference_max * period_us * period_us <=
               quarters << (2 * settings->knot_shift) &&
           (uint64_t)(uint32_t)settings->home.speed_q16 * least_q16 <= (step_q26 << 16) * period_us;
}

bool settings_valid(const struct device_settings *settings) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        const struct gate_limits *limits = &settings->limits[sink];
        bool takes = limits->difference_max != 0; // a sink without limits takes no track
        enum gap_policy policy = (enum gap_policy)settings->gap_policy[sink];
        if (takes && !gate_limits_valid(limits))
            return false;
        if (takes && !gap_policy_valid((enum track_sink)sink, policy, settings->carries_gravity))
            return false;
    }
    if (settings->monitor.bounded && settings->limits[TRACK_POSITION].continuous)
        return false;
    return settings->knot_shift >= 9 && settings->knot_shift <= 15 &&
           settings->servo_period_us > 0 && settings->sample_every > 0 &&
           settings->servo.ahead_us <= 1 << settings->knot_shift && // what lies beyond may change
           settings->torque_step_tq > 0 && scale_valid(settings->knot_periods) &&
           settings->name[SETTINGS_NAME_MAX] == 0 && servo_valid(&settings->servo) &&
           monitor_valid(&settings->monitor) && home_valid(&settings->home) &&
           sync_valid(&settings->sync) && neighbours_valid(settings) && stepper_valid(settings);
}

static void visit_limits(struct fields *f, struct gate_limits *limits) {
    field_bool(f, &limits->continuous);
    field_i32(f, &limits->point_min);
    field_i32(f, &limits->point_max);
    field_i32(f, &limits->difference_max);
    field_i32(f, &limits->second_difference_max);
    field_i32(f, &limits->stop_difference);
}

static void visit_servo(struct fields *f, struct servo_settings *servo) {
    field_scale(f, &servo->kp_tq);
    field_scale(f, &servo->ki_tq);
    field_scale(f, &servo->kd_tq);
    field_scale(f, &servo->velocity_tq);
    field_scale(f, &servo->acceleration_tq);
    field_scale(f, &servo->resistance_mV);
    field_scale(f, &servo->emf_mV);
    field_scale(f, &servo->emf_tq);
    field_scale(f, &servo->supply_duty);
    field_i32(f, &servo->torque_limit_tq);
    field_bool(f, &servo->integrate_running);
    field_u16(f, &servo->ahead_us);
}

static void visit_monitor(struct fields *f, struct monitor_settings *monitor) {
    field_i32(f, &monitor->following_pq);
    field_u16(f, &monitor->following_periods);
    field_i32(f, &monitor->speed_pq);
    field_bool(f, &monitor->bounded);
    field_i32(f, &monitor->low_pq);
    field_i32(f, &monitor->high_pq);
    field_i32(f, &monitor->deceleration_q16);
    field_u32(f, &monitor->torque_periods);
    field_scale(f, &monitor->load_q8);
    field_u32(f, &monitor->overload);
    field_u16(f, &monitor->heating_q16);
    field_i32(f, &monitor->rise_q16);
    field_i32(f, &monitor->stuck_pq);
    field_u32(f, &monitor->stuck_periods);
    field_i32(f, &monitor->spike_counts);
    field_i32(f, &monitor->supply_min_mV);
    field_i32(f, &monitor->supply_max_mV);
    field_i32(f, &monitor->chopper_mV);
    field_u32(f, &monitor->late_us);
}

static void visit_home(struct fields *f, struct home_settings *home) {
    field_u8(f, &home->method);
    field_bool(f, &home->backwards);
    field_i32(f, &home->mark_count);
    field_i32(f, &home->speed_q16);
    field_i32(f, &home->acceleration_q16);
    field_i32(f, &home->torque_tq);
    field_i32(f, &home->way_counts);
    field_u16(f, &home->still_periods);
}

static void visit_sync(struct fields *f, struct sync_settings *sync) {
    field_u8(f, &sync->method);
    field_bool(f, &sync->among_boards);
    field_u16(f, &sync->drift_ppm);
    field_u16(f, &sync->wander_ppb_s);
    field_u32(f, &sync->to_device_least_us);
    field_u32(f, &sync->to_host_least_us);
    field_u32(f, &sync->limit_us);
    field_u32(f, &sync->average.interval_us);
    field_u16(f, &sync->average.phase_gain);
    field_u16(f, &sync->average.skew_gain_q8);
}

static void visit_keys(struct fields *f, struct device_settings *settings) {
    field_bytes(f, settings->key, SIPHASH_KEY_BYTES);
    field_bytes(f, settings->peer_key, SIPHASH_KEY_BYTES);
}

static void visit(struct fields *f, struct device_settings *settings, bool with_key) {
    uint8_t format = SETTINGS_FORMAT;
    field_u8(f, &format);
    f->failed |= format != SETTINGS_FORMAT;
    if (with_key)
        visit_keys(f, settings);
    field_bytes(f, (uint8_t *)settings->name, sizeof settings->name);
    field_u8(f, &settings->knot_shift);
    field_u16(f, &settings->servo_period_us);
    field_u16(f, &settings->sample_every);
    field_u16(f, &settings->brake_periods);
    field_u32(f, &settings->stop_us);
    field_u32(f, &settings->sync_lost_us);
    field_u16(f, &settings->dither_us);
    field_i32(f, &settings->torque_step_tq);
    field_scale(f, &settings->knot_periods);
    field_i32(f, &settings->offset_count);
    field_bool(f, &settings->carries_gravity);
    field_bytes(f, settings->gap_policy, TRACK_COUNT);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        visit_limits(f, &settings->limits[sink]);
    visit_servo(f, &settings->servo);
    visit_monitor(f, &settings->monitor);
    visit_home(f, &settings->home);
    visit_sync(f, &settings->sync);
    field_u8(f, &settings->neighbours);
    field_u32(f, &settings->ask_us);
    field_u32(f, &settings->peer_least_us);
    field_u32(f, &settings->step_least_q16);
}

int32_t settings_encode(const struct device_settings *settings, bool with_key, uint8_t *bytes,
                        int32_t capacity) {
    struct fields f = {.out = {bytes, capacity, 0, false}};
    struct device_settings copy = *settings; // visited, so not const
    visit(&f, &copy, with_key);
    return f.out.failed ? -1 : f.out.size;
}

bool settings_decode(const uint8_t *bytes, int32_t size, bool with_key,
                     struct device_settings *settings) {
    struct fields f = {.in = {bytes, size, 0, false}, .reading = true};
    visit(&f, settings, with_key);
    return !f.failed && !f.in.failed && f.in.at == size;
}
