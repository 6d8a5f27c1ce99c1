// What devices execute, as a function of system time.
#pragma once

#include <cstddef>
#include <cstdint>

class Along {
  public:
    virtual ~Along() = default;

    virtual size_t width() const = 0; // of a row: 5n

    // Rows [r, r', f, Kp, Kd + c] by axis at system times, close together. `near` (n,): where the axes
    // are at the first of them, give or take some turns.
    virtual void at(const int64_t *times_us, size_t count, const double *near,
                    double *rows) const = 0;
};
