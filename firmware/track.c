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

struct track_value track_evaluate(const struct track *track, int64_t time_us, int32_t knot_shift) {
    int64_t knot = time_us >> knot_shift;
    uint16_t u = (uint16_t)((uint32_t)time_us << (16 - knot_shift)); // Q16, knot_shift <= 15
    int32_t base = track_point(track, knot);
    int32_t d0 = fixed_difference(base, track_point(track, knot - 1));
    int32_t d1 = fixed_difference(track_point(track, knot + 1), base);
    int32_t d2 = fixed_difference(track_point(track, knot + 2), track_point(track, knot + 1));
    int32_t curve0 = d1 - d0, jerk = d2 - d1 - curve0;
    // Horner on differences: base + curve0/6 + u (d0 + d1)/2 + u^2 curve0/2 + u^3 jerk/6.
    int32_t cubic = fixed_mul_q16(sixth(jerk), u);
    int32_t square = fixed_mul_q16((curve0 >> 1) + cubic, u);
    int32_t linear = fixed_mul_q16(((d0 + d1) >> 1) + square, u);
    int32_t curve = fixed_mul_q16(jerk, u);
    struct track_value result;
    result.value = fixed_sum(base, sixth(curve0) + linear);
    result.rate = ((d0 + d1) >> 1) + fixed_mul_q16(curve0 + (curve >> 1), u);
    result.curve = curve0 + curve;
    return result;
}
