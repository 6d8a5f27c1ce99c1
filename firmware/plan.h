// The payload of a PLAN frame: every track's points from one knot on, for one device; and the SYNC
// payload, which is its head alone.
//
//     echo_us u32, received_us i64, sent_us i64      stamps for the clock, see stamps.h
//     mark u16, width_us u16, least_us i64           see mark.h
//     number u32, epoch u16, first_knot i64, tracks u8, count u8      only in a PLAN
//     for each track in the mask, count zigzag varints: the first point, the first difference, then
//     second differences (a smooth curve's are small: about two bytes a point)
#ifndef HEADWAY_PLAN_H
#define HEADWAY_PLAN_H

#include "stamps.h"
#include <stdbool.h>

#define PLAN_POINTS_MAX 128
#define PLAN_TIME_MAX (1LL << 60) // no stamp beyond: sums and differences of a few cannot overflow

enum track_sink { TRACK_POSITION, TRACK_TORQUE, TRACK_KP, TRACK_KI, TRACK_KD, TRACK_COUNT };

struct plan {
    uint32_t number; // counts up from 1
    uint16_t epoch;  // of the arming or resuming that this plan belongs to
    int64_t first_knot;
    uint8_t tracks; // bit i: sink i is present
    uint8_t count;  // points in each track, 3 .. PLAN_POINTS_MAX
    int32_t points[TRACK_COUNT][PLAN_POINTS_MAX];
};

// Return the payload's size, or -1 if it does not fit or the plan's counts are out of range.
int32_t sync_encode(const struct stamps *stamps, uint8_t *payload, int32_t capacity);
int32_t plan_encode(const struct stamps *stamps, const struct plan *plan, uint8_t *payload,
                    int32_t capacity);

// Return false on a malformed payload (then the output is undefined).
bool sync_decode(const uint8_t *payload, int32_t size, struct stamps *stamps);
bool plan_decode(const uint8_t *payload, int32_t size, struct stamps *stamps, struct plan *plan);

#endif
