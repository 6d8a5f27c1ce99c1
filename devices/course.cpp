#include "course.hpp"

#include <algorithm>

#include "unwrap.hpp"

constexpr int GAIN_BITS = 8; // of a gain's control point after the point of the mantissa
constexpr int32_t MANTISSA_MAX = UINT16_MAX;

// As the servo takes it.
static int32_t mantissa(const track *gain, const instant *at) {
    return std::clamp(track_value(gain, at) >> GAIN_BITS, 0, MANTISSA_MAX);
}

void Course::at(const int64_t *times_us, size_t count, const double *near, double *rows) const {
    const size_t n = axes();
    const double knot_s = (double)(1 << knot_shift) * 1e-6;
    for (size_t i = 0; i < count; ++i)
        std::copy(still.begin(), still.end(), rows + i * width());
    for (const Driven &d : driven) {
        const double unit = 1 / d.pq_per_unit, unit_s = unit / knot_s, effort = 1 / d.tq_per_effort;
        double *row = rows + d.axis;
        instant at = instant_at(times_us[0], knot_shift);
        Unwrap unwrap(track_value(d.position, &at), near[d.axis] * d.pq_per_unit);
        for (size_t i = 0; i < count; ++i, row += width()) {
            at = instant_at(times_us[i], knot_shift);
            const int32_t value = track_value(d.position, &at);
            row[0] = (d.continuous ? unwrap(value) : value) * unit;
            row[n] = track_rate(d.position, &at) * unit_s;
            row[2 * n] = track_value(d.torque, &at) * effort;
            if (d.kp) {
                row[3 * n] = mantissa(d.kp, &at) * d.kp_per_mantissa;
                row[4 * n] = mantissa(d.kd, &at) * d.kd_per_mantissa + d.emf;
            }
        }
    }
}

void Course::points(int64_t first_knot, size_t count, const double *near, double *position,
                    double *torque) const {
    for (const Driven &d : driven) {
        Unwrap unwrap(track_point(d.position, first_knot), near[d.axis] * d.pq_per_unit);
        for (size_t i = 0; i < count; ++i) {
            const int64_t knot = first_knot + (int64_t)i;
            const int32_t point = track_point(d.position, knot);
            position[i * moved()] = (d.continuous ? unwrap(point) : point) / d.pq_per_unit;
            torque[i * moved()] = track_point(d.torque, knot) / d.tq_per_effort;
        }
        ++position, ++torque;
    }
}
