// One knot interval of a track: the polynomial that its four live points make.
//
// At u of the interval, 0 <= u < 1, Horner's way: value + u (rate + u (curve / 2 + u jerk / 6)).
#ifndef HEADWAY_SPAN_H
#define HEADWAY_SPAN_H

#include "fixed.h"

#define SPAN_SIXTH_Q18 43691u // 2^18 / 6

struct span {
    int64_t knot;
    int32_t value, rate; // at the knot
    int32_t curve, jerk; // second difference at the knot, and the third
    int32_t cube;        // jerk / 6
};

// x / 6 with two bits more than the quantum, so that rounding stays below one quantum.
static inline int32_t span_sixth(int32_t x) { return fixed_mul_q16(x, SPAN_SIXTH_Q18) >> 2; }

// Also of points that no gate has seen: nobody evaluates it then, but it is made.
static inline void span_set(struct span *span, int64_t knot, int32_t p0, int32_t p1, int32_t p2,
                            int32_t p3) {
    int32_t d0 = fixed_difference(p1, p0), d1 = fixed_difference(p2, p1);
    int32_t d2 = fixed_difference(p3, p2), curve = fixed_difference(d1, d0);
    int32_t jerk = fixed_difference(fixed_difference(d2, d1), curve);
    span->knot = knot;
    span->value = fixed_sum(p1, span_sixth(curve));
    span->rate = fixed_sum(d0, d1) >> 1;
    span->curve = curve;
    span->jerk = jerk;
    span->cube = span_sixth(jerk);
}

static inline int32_t span_value(const struct span *span, uint32_t phase) {
    int32_t square = (span->curve >> 1) + fixed_mul_q16(span->cube, phase);
    int32_t linear = span->rate + fixed_mul_q16(square, phase);
    return fixed_sum(span->value, fixed_mul_q16(linear, phase));
}

static inline int32_t span_rate(const struct span *span, uint32_t phase) {
    int32_t change = fixed_mul_q16(span->jerk, phase);
    return span->rate + fixed_mul_q16(span->curve + (change >> 1), phase);
}

static inline int32_t span_curve(const struct span *span, uint32_t phase) {
    return span->curve + fixed_mul_q16(span->jerk, phase);
}

#endif
