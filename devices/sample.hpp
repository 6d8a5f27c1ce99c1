// What the estimator hears of the machine: one encoder reading.
#pragma once

#include <cstdint>
#include <vector>

struct Sample {
    int64_t time_us; // system time
    int64_t axis;
    double position; // [rad or m]
};

using Samples = std::vector<Sample>;
