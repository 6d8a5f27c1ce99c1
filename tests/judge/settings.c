// Replays settings-* and store-*: what a board is set up with, and what it remembers.
#include "settings.h"
#include "judge.h"
#include "rack.h" // whose memory alone is here
#include "sinks.h"
#include "store.h"
#include <string.h>

#define NUMBERS(X)                                                                                 \
    X(knot_shift, knot_shift)                                                                      \
    X(servo_period_us, servo_period_us)                                                            \
    X(sample_every, sample_every)                                                                  \
    X(brake_periods, brake_periods)                                                                \
    X(stop_us, stop_us)                                                                            \
    X(sync_lost_us, sync_lost_us)                                                                  \
    X(dither_us, dither_us)                                                                        \
    X(torque_step_tq, torque_step_tq)                                                              \
    X(offset_count, offset_count)                                                                  \
    X(carries_gravity, carries_gravity)                                                            \
    X(torque_limit_tq, servo.torque_limit_tq)                                                      \
    X(integrate_running, servo.integrate_running)                                                  \
    X(ahead_us, servo.ahead_us)                                                                    \
    X(following_pq, monitor.following_pq)                                                          \
    X(following_periods, monitor.following_periods)                                                \
    X(speed_pq, monitor.speed_pq)                                                                  \
    X(bounded, monitor.bounded)                                                                    \
    X(low_pq, monitor.low_pq)                                                                      \
    X(high_pq, monitor.high_pq)                                                                    \
    X(deceleration_q16, monitor.deceleration_q16)                                                  \
    X(torque_periods, monitor.torque_periods)                                                      \
    X(overload, monitor.overload)                                                                  \
    X(heating_q16, monitor.heating_q16)                                                            \
    X(rise_q16, monitor.rise_q16)                                                                  \
    X(stuck_pq, monitor.stuck_pq)                                                                  \
    X(stuck_periods, monitor.stuck_periods)                                                        \
    X(spike_counts, monitor.spike_counts)                                                          \
    X(supply_min_mV, monitor.supply_min_mV)                                                        \
    X(supply_max_mV, monitor.supply_max_mV)                                                        \
    X(chopper_mV, monitor.chopper_mV)                                                              \
    X(late_us, monitor.late_us)                                                                    \
    X(home_method, home.method)                                                                    \
    X(home_backwards, home.backwards)                                                              \
    X(home_mark_count, home.mark_count)                                                            \
    X(home_speed_q16, home.speed_q16)                                                              \
    X(home_acceleration_q16, home.acceleration_q16)                                                \
    X(home_torque_tq, home.torque_tq)                                                              \
    X(home_way_counts, home.way_counts)                                                            \
    X(home_still_periods, home.still_periods)                                                      \
    X(sync_method, sync.method)                                                                    \
    X(among_boards, sync.among_boards)                                                             \
    X(drift_ppm, sync.drift_ppm)                                                                   \
    X(wander_ppb_s, sync.wander_ppb_s)                                                             \
    X(to_device_least_us, sync.to_device_least_us)                                                 \
    X(to_host_least_us, sync.to_host_least_us)                                                     \
    X(limit_us, sync.limit_us)                                                                     \
    X(interval_us, sync.average.interval_us)                                                       \
    X(phase_gain, sync.average.phase_gain)                                                         \
    X(skew_gain_q8, sync.average.skew_gain_q8)                                                     \
    X(neighbours, neighbours)                                                                      \
    X(ask_us, ask_us)                                                                              \
    X(peer_least_us, peer_least_us)                                                                \
    X(step_least_q16, step_least_q16)

#define SCALES(X)                                                                                  \
    X(knot_periods, knot_periods)                                                                  \
    X(kp_tq, servo.kp_tq)                                                                          \
    X(ki_tq, servo.ki_tq)                                                                          \
    X(kd_tq, servo.kd_tq)                                                                          \
    X(velocity_tq, servo.velocity_tq)                                                              \
    X(acceleration_tq, servo.acceleration_tq)                                                      \
    X(resistance_mV, servo.resistance_mV)                                                          \
    X(emf_mV, servo.emf_mV)                                                                        \
    X(emf_tq, servo.emf_tq)                                                                        \
    X(supply_duty, servo.supply_duty)                                                              \
    X(load_q8, monitor.load_q8)

static struct device_settings usual;

static struct scale given_scale(const char *name) {
    int32_t v[2] = {0};
    given_list(name, v, 2);
    return (struct scale){(uint16_t)v[0], (uint8_t)v[1]};
}

// The usual settings, but for those that the line names.
static struct device_settings given_settings(void) {
    struct device_settings settings = usual;
    int32_t size;
    if (is_given("name")) {
        const uint8_t *name = given_bytes("name", &size);
        memset(settings.name, 0, sizeof settings.name);
        memcpy(settings.name, name, (size_t)size);
    }
    if (is_given("key"))
        memcpy(settings.key, given_bytes("key", &size), sizeof settings.key);
    if (is_given("peer_key"))
        memcpy(settings.peer_key, given_bytes("peer_key", &size), sizeof settings.peer_key);
#define SET(field, member)                                                                         \
    if (is_given(#field))                                                                          \
        settings.member = given(#field);
    NUMBERS(SET)
#define SET_SCALE(field, member)                                                                   \
    if (is_given(#field))                                                                          \
        settings.member = given_scale(#field);
    SCALES(SET_SCALE)
    if (is_given("gap_policy")) {
        int32_t policies[TRACK_COUNT] = {0};
        given_list("gap_policy", policies, TRACK_COUNT);
        for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
            settings.gap_policy[sink] = (uint8_t)policies[sink];
    }
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (is_given(sink_names[sink])) {
            int32_t v[6] = {0};
            given_list(sink_names[sink], v, 6);
            settings.limits[sink] = (struct gate_limits){v[0] != 0, v[1], v[2], v[3], v[4], v[5]};
        }
    return settings;
}

static void say_settings(const struct device_settings *settings) {
    say_bytes("name", (const uint8_t *)settings->name, sizeof settings->name);
    say_bytes("key", settings->key, sizeof settings->key);
    say_bytes("peer_key", settings->peer_key, sizeof settings->peer_key);
#define SAY(field, member) say_number(#field, settings->member);
    NUMBERS(SAY)
#define SAY_SCALE(field, member)                                                                   \
    say_list(#field, (int32_t[]){settings->member.mantissa, settings->member.shift}, 2);
    SCALES(SAY_SCALE)
    int32_t policies[TRACK_COUNT];
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        policies[sink] = settings->gap_policy[sink];
    say_list("gap_policy", policies, TRACK_COUNT);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        const struct gate_limits *of = &settings->limits[sink];
        int32_t v[] = {of->continuous,
                       of->point_min,
                       of->point_max,
                       of->difference_max,
                       of->second_difference_max,
                       of->stop_difference};
        say_list(sink_names[sink], v, 6);
    }
}

static void replay_settings_usual(void) { usual = given_settings(); }

static void replay_settings_valid(void) {
    struct device_settings settings = given_settings();
    say_number("valid", settings_valid(&settings));
}

static void replay_settings_encode(void) {
    struct device_settings settings = given_settings();
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *bytes = room(capacity);
    int32_t size = settings_encode(&settings, given("with_key") != 0, bytes, capacity);
    if (size == -1)
        say("refused");
    else
        say_bytes("bytes", bytes, size);
}

static void replay_settings_decode(void) {
    struct device_settings settings = usual;
    int32_t size;
    const uint8_t *bytes = given_bytes("bytes", &size);
    if (settings_decode(bytes, size, given("with_key") != 0, &settings))
        say_settings(&settings);
    else
        say("malformed");
}

static struct board board;

static void replay_store_blank(void) { board = (struct board){0}; }

static void replay_store_record(void) {
    struct memory *memory = &board.memory[given("record")];
    const uint8_t *bytes = given_bytes("bytes", &memory->size);
    memcpy(memory->bytes, bytes, (size_t)memory->size);
}

static void take_kept(void) {
    board.grown = is_given("grown") ? (int32_t)given("grown") : 0;
    board.kept = is_given("kept") ? (int32_t)given("kept") : BOARD_RECORD_MAX;
    board.flipped = is_given("flipped") ? (int32_t)given("flipped") : -1;
}

static void replay_store_boot(void) {
    uint32_t boots = 0;
    take_kept();
    if (store_count_boot(&board, &boots))
        say_number("boots", boots);
    else
        say("failed");
}

static void replay_store_save_settings(void) {
    struct device_settings settings = given_settings();
    take_kept();
    say(store_save_settings(&board, &settings) ? "saved" : "failed");
}

static void replay_store_load_settings(void) {
    struct device_settings settings = {0};
    if (store_load_settings(&board, &settings))
        say_settings(&settings);
    else
        say("none");
}

// A log of `count` faults, of which only the value is not zero: it is the fault's number.
static void replay_store_save_faults(void) {
    struct fault_log log = {0};
    for (int64_t i = given("count"); i > 0; i--)
        fault_log_add(&log, &(struct fault){.value = (int32_t)log.count + 1});
    take_kept();
    say(store_save_faults(&board, &log) ? "saved" : "failed");
}

static void replay_store_load_faults(void) {
    struct fault_log log;
    memset(&log, 0xff, sizeof log);
    store_load_faults(&board, &log);
    say_number("count", log.count);
    int32_t values[FAULT_LOG];
    for (int32_t i = 0; i < FAULT_LOG; i++)
        values[i] = log.faults[i].value;
    say_list("values", values, FAULT_LOG);
}

const struct word settings_words[] = {
    {"settings-usual", replay_settings_usual},
    {"settings-valid", replay_settings_valid},
    {"settings-encode", replay_settings_encode},
    {"settings-decode", replay_settings_decode},
    {"store-blank", replay_store_blank},
    {"store-record", replay_store_record},
    {"store-boot", replay_store_boot},
    {"store-save-settings", replay_store_save_settings},
    {"store-load-settings", replay_store_load_settings},
    {"store-save-faults", replay_store_save_faults},
    {"store-load-faults", replay_store_load_faults},
    {0, 0},
};
