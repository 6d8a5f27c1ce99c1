#include "track.h"
#include "fixed.h" // products with the 16-bit phase, sums modulo 2^32

#define SIXTH_Q18 43691u // 2^18 / 6

int32_t track_point(const struct track *track, int64_t knot) {
    if (knot > track->end)
        knot = track->end;
    return track->points[(uint32_t)knot % TRACK_POINTS];
}

void track_write(struct track *track, int64_t first_knot, const int32_t *points, int32_t count) {
    if (!track->written) // before its first point a track is at that point
        for (int32_t i = 0; i < TRACK_POINTS; i++)
            track->points[i] = points[0];
    for (int32_t i = 0; i < count; i++)
        track->points[(uint32_t)(first_knot + i) % TRACK_POINTS] = points[i];
    track->end = first_knot + count - 1;
    track->written = true;
}

// x / 6 with two bits more than the quantum, so that rounding stays below one quantum.
static int32_t sixth(int32_t x) { return fixed_mul_q16(x, SIXTH_Q18) >> 2; }

// What the live points make of an interval: the middle of them, and differences.
struct span {
    int32_t base, slope, curve, jerk; // slope: d0 + d1, twice what it is at the knot
};

// Where the end is near. Apart, and called: what it needs of registers would slow the usual case.
static __attribute__((noinline)) void copy_points(const struct track *track, int64_t knot,
                                                  int32_t points[4]) {
    for (int32_t i = 0; i < 4; i++)
        points[i] = track_point(track, knot - 1 + i);
}

static inline struct span live(const struct track *track, int64_t knot) {
    int32_t ends[4], p0, p1, p2, p3;
    if (track->end - knot >= 2) {
        uint32_t first = (uint32_t)knot - 1;
        p0 = track->points[first % TRACK_POINTS];
        p1 = track->points[(first + 1) % TRACK_POINTS];
        p2 = track->points[(first + 2) % TRACK_POINTS];
        p3 = track->points[(first + 3) % TRACK_POINTS];
    } else {
        copy_points(track, knot, ends);
        p0 = ends[0], p1 = ends[1], p2 = ends[2], p3 = ends[3];
    }
    int32_t d0 = fixed_difference(p1, p0), d1 = fixed_difference(p2, p1);
    int32_t d2 = fixed_difference(p3, p2), curve = d1 - d0;
    return (struct span){p1, d0 + d1, curve, d2 - d1 - curve};
}

// Horner on differences: base + curve/6 + u (d0 + d1)/2 + u^2 curve/2 + u^3 jerk/6.
int32_t track_value(const struct track *track, const struct instant *at) {
    struct span span = live(track, at->knot);
    int32_t cubic = fixed_mul_q16(sixth(span.jerk), at->phase);
    int32_t square = fixed_mul_q16((span.curve >> 1) + cubic, at->phase);
    int32_t linear = fixed_mul_q16((span.slope >> 1) + square, at->phase);
    return fixed_sum(span.base, sixth(span.curve) + linear);
}

int32_t track_rate(const struct track *track, const struct instant *at) {
    struct span span = live(track, at->knot);
    int32_t change = fixed_mul_q16(span.jerk, at->phase);
    return (span.slope >> 1) + fixed_mul_q16(span.curve + (change >> 1), at->phase);
}

int32_t track_curve(const struct track *track, const struct instant *at) {
    struct span span = live(track, at->knot);
    return span.curve + fixed_mul_q16(span.jerk, at->phase);
}
