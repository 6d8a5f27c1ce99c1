// A track: a uniform cubic B-spline on the knot grid.
//
// Knot k lies at system time k * 2^shift microseconds. In [k, k+1) the points k-1 .. k+2 are live;
// at knot k the value is (c[k-1] + 4 c[k] + c[k+1]) / 6 (de Boor, A Practical Guide to Splines).
// Beyond the last point that was written a track repeats it, so a plan that ends in three equal
// points stays at rest. Positions of an axis that turns for ever are modulo 2^32.
#ifndef HEADWAY_TRACK_H
#define HEADWAY_TRACK_H

#include "near.h"
#include "span.h"
#include <stdbool.h>
#include <stdint.h>

#define TRACK_POINTS 256                    // a power of two: 1.05 s of past and future at 4096 us
#define TRACK_PAST_KNOTS (TRACK_POINTS - 2) // from a past time to the end, at most

struct track {
    struct span spans[2]; // of two knots, an even one and an odd one
    bool written;
    int64_t end; // knot of the last point
    int32_t points[TRACK_POINTS];
    int64_t oldest; // knot of the oldest point that is left of what was written
};

// A time on the grid: the knot whose interval it is in, and how far in, in 1/65536 of it.
struct instant {
    int64_t knot;
    uint32_t phase; // below 2^16
};

// `knot_shift` is 9 .. 15. No shift or sum of 64 bits: on a small core that is many.
static inline struct instant instant_at(int64_t time_us, int32_t knot_shift) {
    uint32_t low = (uint32_t)time_us, high = (uint32_t)((uint64_t)time_us >> 32);
    uint32_t knot = low >> knot_shift | high << (32 - knot_shift);
    uint32_t above = (uint32_t)((int32_t)high >> knot_shift);
    return (struct instant){(int64_t)((uint64_t)above << 32 | knot),
                            low << (16 - knot_shift) & 0xffff};
}

// Ahead of an instant: how many intervals, and how far in it is there.
struct ahead {
    uint32_t knots, phase;
};

// By so many 1/65536 of an interval, below 2^31.
static inline struct ahead instant_ahead(const struct instant *now, uint32_t by) {
    return (struct ahead){(now->phase + by) >> 16, (now->phase + by) & 0xffff};
}

int32_t track_point(const struct track *track, int64_t knot);
void track_write(struct track *track, int64_t first_knot, const int32_t *points, int32_t count);

// Makes the span of a knot, in place of another one's.
void track_load(struct track *track, int64_t knot);

// The span of a knot: nearly always it has been made before. Two knots a multiple of 2^32 apart would
// be mistaken for each other: ask for one in between.
static inline const struct span *track_span(struct track *track, int64_t knot) {
    struct span *span = &track->spans[(uint32_t)knot & 1];
    NEAR(span);
    if ((uint32_t)span->knot != (uint32_t)knot)
        track_load(track, knot);
    return span;
}

// The same of the interval that is `ahead` of an instant. Of what is 64 bits long only the last half is
// made, unless the span is.
static inline const struct span *track_span_ahead(struct track *track, const struct instant *now,
                                                  const struct ahead *ahead) {
    uint32_t knot = (uint32_t)now->knot + ahead->knots;
    struct span *span = &track->spans[knot & 1];
    NEAR(span);
    if ((uint32_t)span->knot != knot)
        track_load(track, now->knot + ahead->knots);
    return span;
}

// Value, rate [quantum per knot interval] and curve [quantum per its square] at an instant,
// for points whose differences stay below 2^26. All are rounded down: by less than 6 quanta
// the value (by less than 1 at a knot), by less than 2.5 the rate, by less than 1 the curve. The value
// is off besides by the curve's 2^-19.6: 1/3 of a quantum for second differences of 2^18, 85 at the
// most. At rest all three are exact.
int32_t track_value(const struct track *track, const struct instant *at);
int32_t track_rate(const struct track *track, const struct instant *at);
int32_t track_curve(const struct track *track, const struct instant *at);

// The value at a past instant; false, and nothing is found, if it is not there any more or never was:
// before the second of its points that are left, or after its last one. What was live then has not
// changed since (gate.h), so it is what was executed.
bool track_past(const struct track *track, const struct instant *at, int32_t *value);

#endif
