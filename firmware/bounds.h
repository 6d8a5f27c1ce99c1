// What stamps prove about another clock: the set of offsets and skews that none of them contradicts.
//
// Let theta be the other clock's time minus the own ticks. A frame that was sent at the other's time
// s and arrived at the own ticks r proves theta >= s - r at r, since it was under way for no negative
// time; one that was sent at the own ticks s and arrived at the other's time r proves
// theta <= r - s at s. A frame's least delay, where it is known, makes the proof as much tighter.
// Each proof is carried to now by what oscillators may do: theta's slope, the skew, stays within
// `drift`, and moves by no more than `wander`. A proof of age a says, at a skew k that holds now,
//
//     theta >= proof + k a - wander a^2 / 2,
//
// a line in the plane of skew and offset; all lines leave a set (the one-way bounds of Duda et al.,
// "Estimating global time in distributed systems", ICDCS 1987, and Moon, Skelly, Towsley,
// "Estimation and removal of clock skew", INFOCOM 1999; set membership: Schweppe, IEEE Trans. Autom.
// Control 13, 1968). No probability enters, and no delay needs to be symmetric: the truth is in the
// set as long as the three bounds hold. All rounding widens it.
#ifndef HEADWAY_BOUNDS_H
#define HEADWAY_BOUNDS_H

#include <stdbool.h>
#include <stdint.h>

#define BOUNDS_LINES 12          // a side; more gain little
#define BOUNDS_AGE_MAX (1 << 25) // us: an older proof says nothing any more

struct bounds_limits {
    int32_t drift_q32;  // |skew| at most
    int32_t wander_q64; // |change of the skew| per us at most
};

// A proof: theta >= value (of the upper side: -theta >= value).
struct bounds_line {
    int64_t value_q16; // us
    int64_t ticks_us;  // own ticks at which it held
};

struct bounds_side {
    int64_t value_q16; // the side's bound now; without lines far below all
    int64_t skew_q32;  // and of the skew (of the upper side: of its negative)
    int32_t count;
    struct bounds_line lines[BOUNDS_LINES]; // in any order
};

struct bounds {
    int64_t base_us; // offsets are relative to it, so that they stay small
    int64_t ticks_us;
    struct bounds_side lower, upper;
};

// Forgets everything. `base_us` lies within a year of the offset: in Q16 that is below 2^61.
void bounds_clear(struct bounds *bounds, const struct bounds_limits *limits, int64_t base_us,
                  int64_t ticks_us);

// Carries the set on to later ticks.
void bounds_advance(struct bounds *bounds, const struct bounds_limits *limits, int64_t ticks_us);

// Takes a proof that held at `ticks_us`; later than now it says nothing. It is theta >= `value_q16`,
// or, of the upper side, theta <= it. False if it contradicts the set, which then stays as it is.
bool bounds_prove(struct bounds *bounds, const struct bounds_limits *limits, bool upper,
                  int64_t value_q16, int64_t ticks_us);

// Whether there are proofs of both sides. Then:
bool bounds_closed(const struct bounds *bounds);
int64_t bounds_lower_q16(const struct bounds *bounds);
int64_t bounds_upper_q16(const struct bounds *bounds);
// The same at other ticks, some milliseconds before or after.
int64_t bounds_lower_at_q16(const struct bounds *bounds, const struct bounds_limits *limits,
                            int64_t ticks_us);
int64_t bounds_upper_at_q16(const struct bounds *bounds, const struct bounds_limits *limits,
                            int64_t ticks_us);
int64_t bounds_middle_q16(const struct bounds *bounds);
int32_t bounds_skew_q32(const struct bounds *bounds); // the middle of what it may be
int64_t bounds_nearest_q16(const struct bounds *bounds, int64_t offset_q16);    // that it may be
int32_t bounds_nearest_skew_q32(const struct bounds *bounds, int32_t skew_q32); // and of the skew

#endif
