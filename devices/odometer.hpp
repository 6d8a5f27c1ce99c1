// An encoder's positions without bounds, from the counts modulo 2^32 that a device tells.
#pragma once

#include <cstdint>

#include "sample.hpp"

extern "C" {
#include "status.h"
}

// Of all counts that the told one may stand for it takes the one next to the last, so nothing but a
// jump by 2^31 is mistaken.
class Odometer {
  public:
    Odometer(int64_t axis, double unit_per_count) : axis(axis), unit_per_count(unit_per_count) {}

    // Appends a status' samples. Where the device has just begun to tell, or has found out where it
    // is, its last count is taken as it is.
    void read(const status &told, Samples &samples) {
        const sample *first = told.samples, *end = first + told.sample_count;
        if (first == end)
            return;
        if (!begun || told.homed != homed) {
            last = end[-1].count;
            begun = true, homed = told.homed;
        }
        for (const sample *each = first; each != end; ++each) {
            last += (int32_t)((uint32_t)each->count - (uint32_t)last);
            samples.push_back({each->time_us, axis, (double)last * unit_per_count});
        }
    }

  private:
    int64_t axis;
    double unit_per_count;
    int64_t last = 0;
    bool begun = false, homed = false;
};
