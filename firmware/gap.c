#include "gap.h"
#include "fixed.h" // differences modulo 2^32
#include <string.h>

bool gap_policy_valid(enum track_sink sink, enum gap_policy policy, bool carries_gravity) {
    switch (policy) {
    case GAP_INTERPOLATE:
    case GAP_FAULT:
        return true;
    case GAP_RAMP:
        return sink == TRACK_POSITION;
    case GAP_HOLD:
        return sink != TRACK_POSITION;
    case GAP_ZERO:
        return sink == TRACK_TORQUE && !carries_gravity;
    default:
        return false;
    }
}

static int64_t missing(const struct track *track, const struct plan *plan, int32_t sink) {
    bool open = plan->tracks & 1 << sink && track->written && plan->first_knot > track->end + 1;
    return open ? plan->first_knot - track->end - 1 : 0;
}

int64_t gap_knots(const struct track tracks[TRACK_COUNT], const struct plan *plan) {
    int64_t most = 0;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        int64_t knots = missing(&tracks[sink], plan, sink);
        most = knots > most ? knots : most;
    }
    return most;
}

enum gap_policy gap_verdict(const uint8_t policies[TRACK_COUNT],
                            const struct track tracks[TRACK_COUNT], const struct plan *plan) {
    enum gap_policy verdict = GAP_INTERPOLATE;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        if (missing(&tracks[sink], plan, sink) == 0)
            continue;
        if (policies[sink] == GAP_FAULT)
            return GAP_FAULT;
        if (policies[sink] == GAP_RAMP)
            verdict = GAP_RAMP;
    }
    return verdict;
}

// A missing point between the last stored one and the first sent one.
static int32_t filler(enum gap_policy policy, int32_t last, int32_t next, int32_t step,
                      int32_t steps) {
    if (policy == GAP_ZERO)
        return 0;
    if (policy == GAP_HOLD)
        return last;
    return fixed_sum(last, (int32_t)((int64_t)fixed_difference(next, last) * step / steps));
}

bool gap_fill(const uint8_t policies[TRACK_COUNT], const struct track tracks[TRACK_COUNT],
              struct plan *plan) {
    int32_t added = (int32_t)gap_knots(tracks, plan);
    if (plan->count + added > PLAN_POINTS_MAX)
        return false;
    int64_t first_knot = plan->first_knot - added;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        if (!(plan->tracks & 1 << sink))
            continue;
        const struct track *track = &tracks[sink];
        int32_t *points = plan->points[sink];
        int32_t next = points[0], open = (int32_t)missing(track, plan, sink);
        memmove(points + added, points, plan->count * sizeof *points);
        for (int32_t i = 0; i < added; i++) {
            int32_t step = i - (added - open) + 1; // of open + 1 from the last stored point
            points[i] = !track->written ? next
                        : step < 1 ? track_point(track, first_knot + i)
                                   : filler((enum gap_policy)policies[sink],
                                            track_point(track, track->end), next, step, open + 1);
        }
    }
    plan->first_knot = first_knot;
    plan->count = (uint8_t)(plan->count + added);
    return true;
}
