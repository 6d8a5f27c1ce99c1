// A track: a uniform cubic B-spline on the knot grid.
//
// Knot k lies at system time k * 2^shift microseconds. In [k, k+1) the points k-1 .. k+2 are live;
// at knot k the value is (c[k-1] + 4 c[k] + c[k+1]) / 6 (de Boor, A Practical Guide to Splines).
// Beyond the last point that was written a track repeats it, so a plan that ends in three equal
// points stays at rest. Positions of an axis that turns for ever are modulo 2^32.
#ifndef HEADWAY_TRACK_H
#define HEADWAY_TRACK_H

#include <stdbool.h>
#include <stdint.h>

#define TRACK_POINTS 256 // a power of two: 1.05 s of past and future at 4096 us

struct track {
    bool written;
    int64_t end; // knot of the last point
    int32_t points[TRACK_POINTS];
};

struct track_value {
    int32_t value; // in the track's quantum
    int32_t rate;  // quantum per knot interval
    int32_t curve; // quantum per knot interval squared
};

int32_t track_point(const struct track *track, int64_t knot);
void track_write(struct track *track, int64_t first_knot, const int32_t *points, int32_t count);

// Value and derivatives at a system time, for points whose differences stay below 2^26. All are
// rounded down: by less than 6 quanta the value (by less than 1 at a knot), by less than 2.5 the
// rate, by less than 1 the curve. The value is off besides by the curve's 2^-19.6: 1/3 of a quantum
// for second differences of 2^18, 85 at the most. At rest all three are exact.
struct track_value track_evaluate(const struct track *track, int64_t time_us, int32_t knot_shift);

#endif
