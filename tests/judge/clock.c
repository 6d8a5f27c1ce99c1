// Replays clock*, bounds*, sync* and average*: how a board keeps the time.
#include "judge.h"
#include "sync.h"

static struct headway_clock clock_map;

static void say_clock(const struct headway_clock *of) {
    say_number("system_us", of->system_us);
    say_number("fraction_q32", of->fraction_q32);
    say_number("ticks_us", of->ticks_us);
}

static void replay_clock(void) {
    clock_map = (struct headway_clock){.count_us = (uint32_t)given("count_us")};
    clock_set(&clock_map, given("base_us"), given("offset_q16"));
    say_clock(&clock_map);
}

static void replay_clock_rate(void) { clock_map.rate_q32 = (int32_t)given("rate_q32"); }

static void replay_clock_advance(void) {
    clock_advance(&clock_map, (uint32_t)given("count_us"));
    say_clock(&clock_map);
}

static void replay_clock_at(void) {
    uint32_t count_us = (uint32_t)given("count_us");
    say_number("system_us", clock_at(&clock_map, count_us));
    say_number("ticks_us", clock_ticks(&clock_map, count_us));
}

static void replay_clock_offset(void) {
    say_number("offset_q16", clock_offset_q16(&clock_map, given("base_us")));
}

static struct bounds_limits limits;
static struct bounds bounds;

static void say_bounds(void) {
    if (bounds.lower.count > 0)
        say_number("lower_q16", bounds_lower_q16(&bounds));
    if (bounds.upper.count > 0)
        say_number("upper_q16", bounds_upper_q16(&bounds));
    say_number("least_skew_q32", bounds.lower.skew_q32);
    say_number("most_skew_q32", -bounds.upper.skew_q32);
}

static void replay_bounds_clear(void) {
    limits = (struct bounds_limits){(int32_t)given("drift_q32"), (int32_t)given("wander_q64")};
    bounds_clear(&bounds, &limits, 0, given("ticks_us"));
}

static void replay_bounds_advance(void) {
    bounds_advance(&bounds, &limits, given("ticks_us"));
    say_bounds();
}

static void replay_bounds_prove(void) {
    bool upper = is_given("at_most_q16");
    int64_t value_q16 = upper ? given("at_most_q16") : given("at_least_q16");
    say(bounds_prove(&bounds, &limits, upper, value_q16, given("ticks_us")) ? "taken" : "refused");
    say_bounds();
}

// Both bounds at other ticks, and the skew: its middle, and what is nearest to a value.
static void replay_bounds_at(void) {
    int64_t ticks_us = given("ticks_us");
    say_number("lower_q16", bounds_lower_at_q16(&bounds, &limits, ticks_us));
    say_number("upper_q16", bounds_upper_at_q16(&bounds, &limits, ticks_us));
}

static void replay_bounds_nearest(void) {
    say_number("middle_q16", bounds_middle_q16(&bounds));
    say_number("skew_q32", bounds_skew_q32(&bounds));
    say_number("nearest_q32", bounds_nearest_skew_q32(&bounds, (int32_t)given("skew_q32")));
}

static struct sync_settings settings;
static struct headway_clock clock;
static struct sync sync_state;

static void replay_sync(void) {
    settings = (struct sync_settings){
        .method = (uint8_t)given("method"),
        .among_boards = given("among_boards") != 0,
        .drift_ppm = (uint16_t)given("drift_ppm"),
        .wander_ppb_s = (uint16_t)given("wander_ppb_s"),
        .to_device_least_us = (uint32_t)given("to_device_least_us"),
        .to_host_least_us = (uint32_t)given("to_host_least_us"),
        .limit_us = (uint32_t)given("limit_us"),
        .average = {(uint32_t)given("interval_us"), (uint16_t)given("phase_gain"),
                    (uint16_t)given("skew_gain_q8")},
    };
    clock = (struct headway_clock){.count_us = (uint32_t)given("count_us")};
    sync_state = (struct sync){.id = (uint32_t)given("id")};
    sync_restart(&sync_state);
}

static void take(const struct sync_source *source) {
    struct stamps stamps = {.echo_us = (uint32_t)given("echo_us"),
                            .received_us = given("received_us"),
                            .sent_us = given("sent_us")};
    uint32_t before = sync_state.excluded;
    bool taken =
        sync_take(&sync_state, &settings, &clock, source, &stamps, (uint32_t)given("arrived_us"),
                  (uint32_t)given("count_us"), given("may_step") != 0);
    say(taken ? "taken" : sync_state.excluded == before ? "ignored" : "excluded");
    say_number("excluded", sync_state.excluded);
    say_number("outcast", sync_state.outcast);
    say_number("lineage", sync_state.lineage);
}

static void replay_sync_take(void) {
    struct sync_source host = sync_host(&settings);
    take(&host);
}

// Of a neighbour.
static void replay_sync_hear(void) {
    struct sync_source source = {
        .number = (uint8_t)given("source"),
        .to_here_least_us = (uint32_t)given("peer_least_us"),
        .to_there_least_us = (uint32_t)given("peer_least_us"),
        .least_error_ns = (int32_t)given("least_error_ns"),
        .most_error_ns = (int32_t)given("most_error_ns"),
        .lineage = {(uint32_t)given("lineage"), given("settled") != 0},
    };
    take(&source);
}

static void replay_sync_date(void) {
    struct mark mark = sync_date(&sync_state, &settings, &clock, (uint16_t)given("mark_number"),
                                 (uint32_t)given("at_us"));
    say_number("mark_number", mark.number);
    say_number("mark_width_us", mark.width_us);
    say_number("mark_least_us", mark.least_us);
}

static void replay_sync_mark(void) {
    struct mark mark = {0, (uint16_t)given("mark_width_us"), given("mark_least_us")};
    bool taken = sync_take_mark(&sync_state, &settings, &clock, &mark, (uint32_t)given("at_us"),
                                (uint32_t)given("count_us"));
    say(taken ? "taken" : "excluded");
    say_number("excluded", sync_state.excluded);
    say_number("outcast", sync_state.outcast);
}

static void replay_sync_steer(void) {
    clock_advance(&clock, (uint32_t)given("count_us"));
    bool stepped = sync_steer(&sync_state, &settings, &clock, given("may_step") != 0);
    say_clock(&clock);
    say_number("rate_q32", clock.rate_q32);
    say_number("least_error_ns", sync_state.least_error_ns);
    say_number("most_error_ns", sync_state.most_error_ns);
    say_number("error_us", sync_error_us(&sync_state));
    say_number("heard_us", sync_state.heard_us);
    say_number("settled", sync_state.settled);
    say_number("stepped", stepped);
    say_number("lineage", sync_state.lineage);
}

static struct average average;

static void replay_average(void) { average = (struct average){.began_us = given("ticks_us")}; }

static void replay_average_take(void) {
    for (int64_t i = is_given("times") ? given("times") : 1; i > 0; i--)
        average_take(&average, given("offset_us"));
}

static void replay_average_rate(void) {
    struct average_settings of = {(uint32_t)given("interval_us"), (uint16_t)given("phase_gain"),
                                  (uint16_t)given("skew_gain_q8")};
    int32_t rate_q32 = 0;
    if (average_rate(&average, &of, given("ticks_us"), (int32_t)given("drift_q32"), &rate_q32))
        say_number("rate_q32", rate_q32);
    else
        say("none");
}

const struct word clock_words[] = {
    {"clock", replay_clock},
    {"clock-rate", replay_clock_rate},
    {"clock-advance", replay_clock_advance},
    {"clock-at", replay_clock_at},
    {"clock-offset", replay_clock_offset},
    {"bounds-clear", replay_bounds_clear},
    {"bounds-advance", replay_bounds_advance},
    {"bounds-prove", replay_bounds_prove},
    {"bounds-at", replay_bounds_at},
    {"bounds-nearest", replay_bounds_nearest},
    {"sync", replay_sync},
    {"sync-take", replay_sync_take},
    {"sync-hear", replay_sync_hear},
    {"sync-date", replay_sync_date},
    {"sync-mark", replay_sync_mark},
    {"sync-steer", replay_sync_steer},
    {"average", replay_average},
    {"average-take", replay_average_take},
    {"average-rate", replay_average_rate},
    {0, 0},
};
