// Positions of a continuous axis come modulo 2^32 quanta; on the host they have no bounds.
#pragma once

#include <cmath>
#include <cstdint>

// Follows values that are less than half of the 2^32 apart. Of all that the first may stand for it is
// the one next to `near`.
class Unwrap {
  public:
    Unwrap(int32_t first, double near)
        : last(first), way(first), again(std::nearbyint((near - first) / TURN) * TURN) {}

    double operator()(int32_t value) {
        way += (int32_t)((uint32_t)value - (uint32_t)last);
        last = value;
        return (double)way + again;
    }

  private:
    static constexpr double TURN = 4294967296.0;
    int32_t last;
    int64_t way;
    double again;
};
