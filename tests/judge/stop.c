// Replays next-state, command-*, fault-response, faults-*, ramp-*, gap*, home-* and monitor*: what
// stops and starts an axis, by itself.
#include "command.h"
#include "fault.h"
#include "gap.h"
#include "home.h"
#include "judge.h"
#include "monitor.h"
#include "ramp.h"
#include "sinks.h"
#include "states.h"

static void replay_next_state(void) {
    say_number("state",
               next_state((enum device_state)given("state"), (enum device_event)given("event")));
}

static void say_payload(const uint8_t *payload, int32_t size) {
    if (size == -1)
        say("refused");
    else
        say_bytes("payload", payload, size);
}

static void replay_command_encode(void) {
    struct command command = {(uint32_t)given("number"), (uint8_t)given("kind"),
                              (int32_t)given("argument"), (uint16_t)given("epoch")};
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    say_payload(payload, command_encode(&command, payload, capacity));
}

static void replay_command_decode(void) {
    int32_t size;
    const uint8_t *payload = given_bytes("payload", &size);
    struct command command;
    if (!command_decode(payload, size, &command)) {
        say("malformed");
        return;
    }
    say_number("number", command.number);
    say_number("kind", command.kind);
    say_number("argument", command.argument);
    say_number("epoch", command.epoch);
}

static void replay_fault_response(void) {
    static const char *const responses[] = {"tail", "fault", "brake"};
    say(responses[fault_response((enum fault_reason)given("reason"))]);
}

static struct fault_log log;

static void replay_faults_blank(void) { log = (struct fault_log){0}; }

static void replay_fault_add(void) {
    struct fault fault = {
        .reason = (uint8_t)given("reason"),
        .state = (uint8_t)given("state"),
        .boots = (uint32_t)given("boots"),
        .time_us = given("time_us"),
        .value = (int32_t)given("value"),
        .limit = (int32_t)given("limit"),
        .position_pq = (int32_t)given("position_pq"),
        .torque_tq = (int32_t)given("torque_tq"),
    };
    fault_log_add(&log, &fault);
}

static void replay_faults_encode(void) {
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    say_payload(payload, fault_log_encode(&log, payload, capacity));
}

static void replay_faults_decode(void) {
    int32_t size;
    const uint8_t *payload = given_bytes("payload", &size);
    struct fault_log read;
    if (!fault_log_decode(payload, size, &read)) {
        say("malformed");
        return;
    }
    say_number("count", read.count);
    for (int32_t i = 0; i < FAULT_LOG; i++) {
        const struct fault *fault = &read.faults[i];
        int32_t numbers[] = {fault->reason, fault->state,       fault->value,
                             fault->limit,  fault->position_pq, fault->torque_tq};
        say_number("boots", fault->boots);
        say_number("time_us", fault->time_us);
        say_list("fault", numbers, sizeof numbers / sizeof *numbers);
    }
}

static struct ramp ramp;

static void say_ramp(void) {
    say_number("position_pq", ramp_position_pq(&ramp));
    say_number("velocity_pq", ramp_velocity_pq(&ramp));
    say_number("torque_tq", ramp.torque_tq);
    say_number("resting", ramp.resting);
}

static void replay_ramp_start(void) {
    ramp_start(&ramp, (int32_t)given("position_pq"), (int32_t)given("velocity_pq"),
               (int32_t)given("torque_tq"), (int32_t)given("end_torque_tq"));
    say_ramp();
}

static void replay_ramp_step(void) {
    for (int64_t i = given("times"); i > 0; i--)
        ramp_step(&ramp, (int32_t)given("deceleration_q16"), (int32_t)given("torque_step_tq"));
    say_ramp();
}

static void replay_gap_policy(void) {
    say_number("valid",
               gap_policy_valid((enum track_sink)given("sink"), (enum gap_policy)given("policy"),
                                given("carries_gravity") != 0));
}

static struct track tracks[TRACK_COUNT];

static void replay_gap_store(void) { // sinks that are not given stay as they were
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        int32_t points[PLAN_POINTS_MAX];
        if (is_given(sink_names[sink]))
            track_write(&tracks[sink], given("first_knot"), points,
                        given_list(sink_names[sink], points, PLAN_POINTS_MAX));
    }
}

static void replay_gap_blank(void) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        tracks[sink] = (struct track){0};
}

static void replay_gap(void) {
    int32_t numbers[TRACK_COUNT] = {0};
    uint8_t policies[TRACK_COUNT];
    given_list("policies", numbers, TRACK_COUNT);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        policies[sink] = (uint8_t)numbers[sink];
    struct plan plan = given_points();
    say_number("missing", gap_knots(tracks, &plan));
    say_number("verdict", gap_verdict(policies, tracks, &plan));
    if (gap_knots(tracks, &plan) > PLAN_POINTS_MAX) // the device asks for no more than it may fill
        return;
    if (!gap_fill(policies, tracks, &plan)) {
        say("no-room");
        return;
    }
    say_number("first_knot", plan.first_knot);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan.tracks & 1 << sink)
            say_list(sink_names[sink], plan.points[sink], plan.count);
}

static struct home_settings home_settings;
static struct home home;

static void replay_home_begin(void) {
    home_settings = (struct home_settings){
        .method = (uint8_t)given("method"),
        .backwards = given("backwards") != 0,
        .mark_count = (int32_t)given("mark_count"),
        .speed_q16 = (int32_t)given("speed_q16"),
        .acceleration_q16 = (int32_t)given("acceleration_q16"),
        .way_counts = (int32_t)given("way_counts"),
        .still_periods = (uint16_t)given("still_periods"),
    };
    home_begin(&home_settings, &home, (enum task)given("task"), (int32_t)given("position_pq"),
               (int32_t)given("count"), (int32_t)given("jog_q16"));
    say_number("position_pq", home_position_pq(&home));
    say_number("velocity_pq", home_velocity_pq(&home));
}

static void replay_home_step(void) {
    static const char *const results[] = {"runs", "done", "failed"};
    struct home_marks marks = {
        .count = (int32_t)given("count"),
        .indexed = given("indexed") != 0,
        .index_count = (int32_t)given("index_count"),
        .on_switch = given("on_switch") != 0,
        .pushing = given("pushing") != 0,
    };
    enum task_result result = home_step(&home_settings, &home, &marks);
    say(results[result]);
    say_number("position_pq", home_position_pq(&home));
    say_number("velocity_pq", home_velocity_pq(&home));
    if (home.found)
        say_number("offset_count", home.offset_count);
}

static struct monitor_settings monitor_settings;
static struct monitor monitor;

#define MONITOR_SETTINGS(X)                                                                        \
    X(following_pq)                                                                                \
    X(following_periods)                                                                           \
    X(speed_pq)                                                                                    \
    X(bounded)                                                                                     \
    X(low_pq)                                                                                      \
    X(high_pq)                                                                                     \
    X(deceleration_q16)                                                                            \
    X(torque_periods)                                                                              \
    X(overload)                                                                                    \
    X(heating_q16)                                                                                 \
    X(rise_q16)                                                                                    \
    X(stuck_pq)                                                                                    \
    X(stuck_periods)                                                                               \
    X(spike_counts)                                                                                \
    X(supply_min_mV)                                                                               \
    X(supply_max_mV)                                                                               \
    X(chopper_mV)                                                                                  \
    X(late_us)

#define OBSERVATION(X)                                                                             \
    X(count)                                                                                       \
    X(position_pq)                                                                                 \
    X(setpoint_pq)                                                                                 \
    X(torque_limit_tq)                                                                             \
    X(supply_mV)                                                                                   \
    X(late_us)                                                                                     \
    X(power)                                                                                       \
    X(driven)                                                                                      \
    X(bounded)                                                                                     \
    X(may_stand)                                                                                   \
    X(heat_shift)                                                                                  \
    X(looks)                                                                                       \
    X(stuck_periods)

#define OBSERVED_SERVO(X)                                                                          \
    X(error_pq)                                                                                    \
    X(torque_tq)                                                                                   \
    X(feedback_tq)                                                                                 \
    X(clipped)

static struct monitor_settings usual_settings;
static struct observation usual, seen;
static struct servo usual_servo, seen_servo;

#define SET(name)                                                                                  \
    if (is_given(#name))                                                                           \
        monitor_settings.name = given(#name);
#define SEE(name)                                                                                  \
    if (is_given(#name))                                                                           \
        seen.name = given(#name);
#define SEE_SERVO(name)                                                                            \
    if (is_given(#name))                                                                           \
        seen_servo.name = given(#name);

static void set_monitor(void) {
    MONITOR_SETTINGS(SET)
    if (is_given("load_q8")) {
        int32_t load[2] = {0};
        given_list("load_q8", load, 2);
        monitor_settings.load_q8 = (struct scale){(uint16_t)load[0], (uint8_t)load[1]};
    }
}

// Settings, and a period, from which the lines below differ only where they say so.
static void replay_monitor_usual(void) {
    set_monitor();
    usual_settings = monitor_settings;
}

static void replay_monitor_quiet(void) {
    OBSERVATION(SEE)
    OBSERVED_SERVO(SEE_SERVO)
    usual = seen;
    usual_servo = seen_servo;
}

// A monitor begins anew.
static void replay_monitor(void) {
    monitor = (struct monitor){0};
    monitor_settings = usual_settings;
    seen = usual;
    seen_servo = usual_servo;
    set_monitor();
}

// What is not given is as in the last period. Told is the last of `times` periods, or the first
// with a breach.
static void replay_monitor_step(void) {
    OBSERVATION(SEE)
    OBSERVED_SERVO(SEE_SERVO)
    seen.servo = &seen_servo;
    int32_t torque_tq = seen_servo.torque_tq;
    seen_servo.effort_tq = (torque_tq < 0 ? -torque_tq : torque_tq) * (1 << seen.heat_shift);
    int64_t times = is_given("times") ? given("times") : 1;
    int32_t step = is_given("count_step") ? (int32_t)given("count_step") : 0;
    struct breach breach = {0};
    int64_t periods = 0;
    while (periods < times && breach.reason == REASON_NONE) {
        monitor_step(&monitor_settings, &monitor, &seen);
        breach = monitor.breach;
        seen.count = fixed_sum(seen.count, step);
        periods++;
    }
    say_number("periods", periods);
    say_number("reason", breach.reason);
    if (breach.reason != REASON_NONE) {
        say_number("value", breach.value);
        say_number("limit", breach.limit);
    }
    say_number("speed_pq", monitor_speed_pq(&monitor));
    say_number("chopper", monitor.chopper);
}

static void replay_monitor_inside(void) {
    say_number("inside", monitor_inside(&monitor_settings, (int32_t)given("position_pq")));
}

static void replay_monitor_begin(void) { monitor_begin(&monitor); }

const struct word stop_words[] = {
    {"next-state", replay_next_state},
    {"command-encode", replay_command_encode},
    {"command-decode", replay_command_decode},
    {"fault-response", replay_fault_response},
    {"faults-blank", replay_faults_blank},
    {"fault-add", replay_fault_add},
    {"faults-encode", replay_faults_encode},
    {"faults-decode", replay_faults_decode},
    {"ramp-start", replay_ramp_start},
    {"ramp-step", replay_ramp_step},
    {"gap-policy", replay_gap_policy},
    {"gap-blank", replay_gap_blank},
    {"gap-store", replay_gap_store},
    {"gap", replay_gap},
    {"home-begin", replay_home_begin},
    {"home-step", replay_home_step},
    {"monitor-usual", replay_monitor_usual},
    {"monitor-quiet", replay_monitor_quiet},
    {"monitor", replay_monitor},
    {"monitor-step", replay_monitor_step},
    {"monitor-begin", replay_monitor_begin},
    {"monitor-inside", replay_monitor_inside},
    {0, 0},
};
