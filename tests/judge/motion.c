// Replays fixed-*; the words that build up tracks and limits; track-at, track-point and gate.
#include "fixed.h"
#include "gate.h"
#include "sinks.h"
#include <string.h>

static struct track tracks[TRACK_COUNT];
static struct gate_limits limits[TRACK_COUNT];

static int32_t given_sink(void) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (is_word("sink", sink_names[sink]))
            return sink;
    return TRACK_COUNT; // a sanitizer sees it
}

static void replay_blank(void) { // nothing stored, no limits
    memset(tracks, 0, sizeof tracks);
    memset(limits, 0, sizeof limits);
}

static void replay_store(void) {
    int32_t points[PLAN_POINTS_MAX];
    int32_t count = given_list("points", points, PLAN_POINTS_MAX);
    struct track *track = &tracks[given_sink()];
    int64_t first_knot = given("first_knot");
    for (int32_t i = 0; i < 2; i++) // kept from before
        track_span(track, first_knot + i);
    track_write(track, first_knot, points, count);
    for (int32_t i = 0; i < 2; i++) {
        struct instant at = {first_knot + i, 1 << 15};
        if (span_value(track_span(track, at.knot), at.phase) != track_value(track, &at))
            say("another by the span that is kept");
    }
}

static void replay_limits(void) {
    limits[given_sink()] =
        (struct gate_limits){.continuous = given("continuous") != 0,
                             .point_min = (int32_t)given("point_min"),
                             .point_max = (int32_t)given("point_max"),
                             .difference_max = (int32_t)given("difference_max"),
                             .second_difference_max = (int32_t)given("second_max"),
                             .stop_difference = (int32_t)given("stop")};
}

static void replay_track_point(void) {
    say_number("point", track_point(&tracks[given_sink()], given("knot")));
}

static void replay_track_at(void) {
    struct track *track = &tracks[given_sink()];
    struct instant at = instant_at(given("time_us"), (int32_t)given("knot_shift"));
    say_number("value", track_value(track, &at));
    say_number("rate", track_rate(track, &at));
    say_number("curve", track_curve(track, &at));
    const struct span *span = track_span(track, at.knot); // kept since the last one, maybe
    if (span_value(span, at.phase) != track_value(track, &at) ||
        span_rate(span, at.phase) != track_rate(track, &at))
        say("another by the span that is kept");
}

static void replay_track_past(void) {
    struct instant at = instant_at(given("time_us"), (int32_t)given("knot_shift"));
    int32_t value;
    if (track_past(&tracks[given_sink()], &at, &value))
        say_number("value", value);
    else
        say("gone");
}

static void replay_limits_valid(void) {
    replay_limits();
    say_number("valid", gate_limits_valid(&limits[given_sink()]));
}

static void replay_gate(void) {
    static const char *const results[] = {"accepted", "late",         "gap",  "far",   "range",
                                          "speed",    "acceleration", "rest", "start", "stale",
                                          "state",    "sink",         "room", "epoch"};
    struct plan plan = given_points();
    say(results[gate_check(limits, tracks, &plan, given("knot"))]);
}

static void replay_fixed_clamp(void) {
    say_number("clamped", fixed_clamp((int32_t)given("value"), (int32_t)given("limit")));
}

static void replay_fixed_clamp64(void) {
    say_number("clamped", fixed_clamp64(given("value"), (int32_t)given("limit")));
}

static void replay_fixed_sum(void) {
    int32_t a = (int32_t)given("a"), b = (int32_t)given("b");
    say_number("sum", fixed_sum(a, b));
    say_number("difference", fixed_difference(a, b));
}

static void replay_fixed_mul_u16(void) {
    say_number("product", fixed_mul_u16((int32_t)given("a"), (uint16_t)given("b")));
}

static void replay_fixed_mul_u32(void) {
    say_word64("product", fixed_mul_u32((uint32_t)given("a"), (uint32_t)given("b")));
}

static void replay_fixed_scale(void) {
    struct scale scale = {(uint16_t)given("mantissa"), (uint8_t)given("shift")};
    say_number("product", fixed_scale((int32_t)given("value"), scale));
}

const struct word motion_words[] = {
    {"fixed-clamp", replay_fixed_clamp},
    {"fixed-clamp64", replay_fixed_clamp64},
    {"fixed-sum", replay_fixed_sum},
    {"fixed-scale", replay_fixed_scale},
    {"fixed-mul-u16", replay_fixed_mul_u16},
    {"fixed-mul-u32", replay_fixed_mul_u32},
    {"blank", replay_blank},
    {"store", replay_store},
    {"limits", replay_limits},
    {"track-point", replay_track_point},
    {"track-at", replay_track_at},
    {"track-past", replay_track_past},
    {"limits-valid", replay_limits_valid},
    {"gate", replay_gate},
    {0, 0},
};
