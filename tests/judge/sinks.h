// The names of a plan's tracks in vectors, in the order of their bits.
#ifndef HEADWAY_JUDGE_SINKS_H
#define HEADWAY_JUDGE_SINKS_H

#include "judge.h"
#include "plan.h"

static const char *const sink_names[TRACK_COUNT] = {"position", "torque", "kp", "ki", "kd"};

// The points of a plan by sink, with first_knot, tracks and count.
static inline struct plan given_points(void) {
    struct plan plan = {.first_knot = given("first_knot"),
                        .tracks = (uint8_t)given("tracks"),
                        .count = (uint8_t)given("count")};
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (is_given(sink_names[sink]))
            given_list(sink_names[sink], plan.points[sink], PLAN_POINTS_MAX);
    return plan;
}

#endif
