// Gaps: knots for which nobody sent a point, between a track's end and the beginning of a plan.
#ifndef HEADWAY_GAP_H
#define HEADWAY_GAP_H

#include "plan.h"
#include "track.h"

#define GAP_FILL_MAX 4 // knots that may be filled

// What to do about a sink's missing points.
enum gap_policy {
    GAP_INTERPOLATE, // on a straight line; the gate judges them as if they had been sent
    GAP_RAMP,        // position: come to rest from the measured motion
    GAP_HOLD,        // torque and gains: the last point again
    GAP_ZERO,        // torque: none; not on axes that carry gravity
    GAP_FAULT,
    GAP_POLICIES,
};

// A position is never held in a gap: a last point at speed is not a stop. Torque is never dropped
// where it carries a load.
bool gap_policy_valid(enum track_sink sink, enum gap_policy policy, bool carries_gravity);

// Missing knots of the sink that misses most, 0 if none does.
int64_t gap_knots(const struct track tracks[TRACK_COUNT], const struct plan *plan);

// The sternest policy of the sinks that miss points: GAP_FAULT, GAP_RAMP or GAP_INTERPOLATE, which
// stands for all that fill.
enum gap_policy gap_verdict(const uint8_t policies[TRACK_COUNT],
                            const struct track tracks[TRACK_COUNT], const struct plan *plan);

// Extends a plan by its missing knots (at most GAP_FILL_MAX): each sink by its policy, or by its
// stored points where it has them. False if the plan has no room for them.
bool gap_fill(const uint8_t policies[TRACK_COUNT], const struct track tracks[TRACK_COUNT],
              struct plan *plan);

#endif
