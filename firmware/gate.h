// The gate: an integer test that a whole plan passes before any of it can move anything.
//
// The curve stays inside the hull of its control points, its speed inside the hull of their first
// differences and its acceleration inside the hull of their second ones (de Boor), so bounds on the
// points bound the motion. The tests run in an order in which nothing can overflow: range first,
// then differences, then differences of differences, then the room to stop: wherever the axis is, it
// can come to rest before its limit at the stop ramp's deceleration.
#ifndef HEADWAY_GATE_H
#define HEADWAY_GATE_H

#include "plan.h"
#include "track.h"

#define GATE_POINT_MAX ((1 << 30) - 1)
#define GATE_DIFFERENCE_MAX (1 << 25)
#define GATE_LIVE_KNOTS 3 // in [k, k+1) a changed point is taken only from k + 3 on

// Limits of one sink's control points. Differences are per knot interval.
struct gate_limits {
    bool continuous; // no range: points are positions modulo 2^32
    int32_t point_min, point_max;
    int32_t difference_max;        // 0 < difference_max <= GATE_DIFFERENCE_MAX
    int32_t second_difference_max; // > 0
    int32_t stop_difference;       // second difference of the stop ramp, 0: no room is asked for
};

enum gate_result {
    GATE_ACCEPTED,
    GATE_LATE,         // a point that is live or past differs from the stored one
    GATE_GAP,          // the plan begins beyond what is stored, or before what is remembered
    GATE_FAR,          // the plan reaches further than the ring holds
    GATE_RANGE,        // a control point outside its limits
    GATE_SPEED,        // a first difference too large
    GATE_ACCELERATION, // a second difference too large
    GATE_REST,         // the last three points of a track are not equal
    GATE_START,        // a first plan that does not start at rest where the axis is; a later one
                       // with a track that the first one had not
    GATE_STALE,        // sent too long ago, or plan number not above the last accepted one
    GATE_STATE,        // the device takes no plan in its state
    GATE_SINK,         // a track without limits here, or no position track
    GATE_ROOM,         // too fast to stop before the limit
    GATE_EPOCH,        // of another epoch than the device's
};

// Whether limits are such that the gate's arithmetic cannot overflow.
bool gate_limits_valid(const struct gate_limits *limits);

// One track of a plan against the track that is stored. `knot` is the knot whose interval runs now.
enum gate_result gate_check_track(const struct gate_limits *limits, const struct track *stored,
                                  int64_t first_knot, const int32_t *points, int32_t count,
                                  int64_t knot);

// The whole plan: every track passes, or the first reason why not.
enum gate_result gate_check(const struct gate_limits limits[TRACK_COUNT],
                            const struct track stored[TRACK_COUNT], const struct plan *plan,
                            int64_t knot);

#endif
