#include "gate.h"
#include "fixed.h" // difference modulo 2^32

bool gate_limits_valid(const struct gate_limits *limits) {
    return limits->point_min <= limits->point_max && limits->point_min >= -GATE_POINT_MAX &&
           limits->point_max <= GATE_POINT_MAX && limits->difference_max > 0 &&
           limits->difference_max <= GATE_DIFFERENCE_MAX && limits->second_difference_max > 0 &&
           limits->stop_difference >= 0 && limits->stop_difference <= 2 * GATE_DIFFERENCE_MAX;
}

static bool ends_at_rest(const int32_t *points, int32_t count) {
    return points[count - 1] == points[count - 2] && points[count - 1] == points[count - 3];
}

// The plan follows what is stored, and the three points before it are still in the ring.
static bool continues(const struct track *stored, int64_t first_knot, int64_t knot) {
    return first_knot <= stored->end + 1 && first_knot > knot - TRACK_POINTS / 2 + 2;
}

// Beyond its end a plan repeats its last point: there, too, live points must not change.
static bool cuts_live(const struct track *stored, int64_t next_knot, int32_t last, int64_t knot) {
    for (; next_knot < knot + GATE_LIVE_KNOTS; next_knot++)
        if (track_point(stored, next_knot) != last)
            return true;
    return false;
}

static int32_t larger(int32_t a, int32_t b) { return a > b ? a : b; }

// d^2 <= 2 a (limit - farthest point) for the four points of a span, towards one end: its speed is
// at most its largest difference in that direction, its position within its points.
static bool span_has_room(int32_t a, int32_t b, int32_t c, int32_t d, int32_t limit, int32_t stop) {
    uint32_t fastest = (uint32_t)larger(larger(b - a, c - b), larger(d - c, 0));
    int32_t farthest = larger(larger(a, b), larger(c, d));
    uint32_t room = (uint32_t)limit - (uint32_t)farthest;
    return farthest <= limit &&
           fixed_mul_u32(fastest, fastest) <= 2 * fixed_mul_u32(room, (uint32_t)stop);
}

// Towards both ends, for the span that a new point completes.
static bool has_room(const struct gate_limits *limits, const int32_t span[4]) {
    int32_t stop = limits->stop_difference;
    return limits->continuous || stop == 0 ||
           (span_has_room(span[0], span[1], span[2], span[3], limits->point_max, stop) &&
            span_has_room(-span[0], -span[1], -span[2], -span[3], -limits->point_min, stop));
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
    int32_t span[4];
    for (int32_t i = 1; i < 4; i++)
        span[i] = stored->written ? track_point(stored, first_knot - 4 + i) : points[0];
    int32_t difference = fixed_difference(span[3], span[2]); // of points that passed the gate
    // How many of the points are live or past: all, if even a whole ring would be past.
    int32_t live = first_knot + TRACK_POINTS <= knot
                       ? TRACK_POINTS
                       : (int32_t)(knot + GATE_LIVE_KNOTS - first_knot);
    for (int32_t i = 0; i < count; i++) {
        if (i < live && !(stored->written && points[i] == track_point(stored, first_knot + i)))
            return GATE_LATE;
        if (!limits->continuous && (points[i] > limits->point_max || points[i] < limits->point_min))
            return GATE_RANGE;
        int32_t d = fixed_difference(points[i], span[3]);
        if (d > limits->difference_max || d < -limits->difference_max)
            return GATE_SPEED;
        int32_t d2 = d - difference;
        if (d2 > limits->second_difference_max || d2 < -limits->second_difference_max)
            return GATE_ACCELERATION;
        for (int32_t k = 0; k < 3; k++)
            span[k] = span[k + 1];
        span[3] = points[i];
        difference = d;
        if (!has_room(limits, span))
            return GATE_ROOM;
    }
    return cuts_live(stored, first_knot + count, span[3], knot) ? GATE_LATE : GATE_ACCEPTED;
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
