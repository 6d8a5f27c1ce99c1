#include "gate.h"

static bool ends_at_rest(const int32_t *points, int32_t count) {
    return points[count - 1] == points[count - 2] && points[count - 1] == points[count - 3];
}

// The plan follows what is stored, and the two points before it are still in the ring.
static bool continues(const struct track *stored, int64_t first_knot, int64_t knot) {
    return first_knot <= stored->end + 1 && first_knot > knot - TRACK_POINTS / 2 + 1;
}

// Beyond its end a plan repeats its last point: there, too, live points must not change.
static bool cuts_live(const struct track *stored, int64_t next_knot, int32_t last, int64_t knot) {
    for (; next_knot < knot + GATE_LIVE_KNOTS; next_knot++)
        if (track_point(stored, next_knot) != last)
            return true;
    return false;
}

enum gate_result gate_check_track(const struct gate_limits *limits, const struct track *stored,
                                  int64_t first_knot, const int32_t *points, int32_t count,
                                  int64_t knot) {
    if (stored->written && !continues(stored, first_knot, knot))
        return GATE_GAP;
    if (first_knot > knot + TRACK_POINTS / 2 - count)
        return GATE_FAR;
    if (!ends_at_rest(points, count))
        return GATE_REST;
    // A first plan has nothing to continue: the track rests at its first point until it begins.
    int32_t last = stored->written ? track_point(stored, first_knot - 1) : points[0];
    int32_t before = stored->written ? track_point(stored, first_knot - 2) : points[0];
    int32_t difference = last - before; // of stored points, which passed the gate
    for (int32_t i = 0; i < count; i++) {
        bool live = first_knot + i < knot + GATE_LIVE_KNOTS;
        if (live && !(stored->written && points[i] == track_point(stored, first_knot + i)))
            return GATE_LATE;
        if (points[i] > limits->point_max || points[i] < limits->point_min)
            return GATE_RANGE;
        int32_t d = points[i] - last;
        if (d > limits->difference_max || d < -limits->difference_max)
            return GATE_SPEED;
        int32_t d2 = d - difference;
        if (d2 > limits->second_difference_max || d2 < -limits->second_difference_max)
            return GATE_ACCELERATION;
        last = points[i];
        difference = d;
    }
    return cuts_live(stored, first_knot + count, last, knot) ? GATE_LATE : GATE_ACCEPTED;
}

enum gate_result gate_check(const struct gate_limits limits[TRACK_COUNT],
                            const struct track stored[TRACK_COUNT], const struct plan *plan,
                            int64_t knot) {
    if (!(plan->tracks & 1 << TRACK_POSITION))
        return GATE_SINK;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        if (!(plan->tracks & 1 << sink))
            continue;
        if (limits[sink].difference_max <= 0)
            return GATE_SINK;
        enum gate_result result = gate_check_track(&limits[sink], &stored[sink], plan->first_knot,
                                                   plan->points[sink], plan->count, knot);
        if (result != GATE_ACCEPTED)
            return result;
    }
    return GATE_ACCEPTED;
}
