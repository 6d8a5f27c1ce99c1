// What the devices execute, as far as the host knows, in SI.
#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "along.hpp"

extern "C" {
#include "track.h"
}

// A driven axis' tracks and quanta.
struct Driven {
    size_t axis; // among all
    const track *position, *torque;
    double pq_per_unit, tq_per_effort;
    bool continuous;
    const track *kp, *kd; // none: constant gains
    double kp_per_mantissa, kd_per_mantissa, emf;
};

class Course : public Along {
  public:
    // `still`: a row [r, r', f, Kp, Kd + c] by axis (5n), of which `at` replaces what tracks tell.
    Course(std::vector<Driven> driven, int32_t knot_shift, std::vector<double> still)
        : driven(std::move(driven)), knot_shift(knot_shift), still(std::move(still)) {}

    size_t width() const override { return still.size(); }
    size_t axes() const { return still.size() / 5; }
    size_t moved() const { return driven.size(); }

    void at(const int64_t *times_us, size_t count, const double *near, double *rows) const override;

    // `count` control points from a knot on, the first positions near `near`: by columns, a row a
    // driven axis.
    void points(int64_t first_knot, size_t count, const double *near, double *position,
                double *torque) const;

  private:
    std::vector<Driven> driven;
    int32_t knot_shift;
    std::vector<double> still;
};
