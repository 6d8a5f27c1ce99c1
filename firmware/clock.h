// The clock map: local count (a free-running 32-bit microsecond counter) to system time.
//
// Between two calls it is a straight line, so it is monotonic but for a step.
#ifndef HEADWAY_CLOCK_H
#define HEADWAY_CLOCK_H

#include <stdint.h>

#define CLOCK_RATE_MAX_Q32                                                                         \
    2147484 // 500 ppm: what a clock is slewed by at most, oscillator included

struct headway_clock {
    int64_t system_us; // system time at `count_us` ...
    uint32_t fraction_q32;
    uint32_t count_us;
    int64_t ticks_us; // `count_us` without its wraps
    int32_t rate_q32; // system rate over local rate, minus one
};

// Moves the map's anchor to a later count. Call at least every half hour.
void clock_advance(struct headway_clock *clock, uint32_t count_us);

// System time and ticks of a count within half an hour of the anchor, before or after.
int64_t clock_at(const struct headway_clock *clock, uint32_t count_us);
int64_t clock_ticks(const struct headway_clock *clock, uint32_t count_us);

// System time at the anchor minus `ticks_us`, relative to `base_us` [us Q16].
int64_t clock_offset_q16(const struct headway_clock *clock, int64_t base_us);

// Sets that.
void clock_set(struct headway_clock *clock, int64_t base_us, int64_t offset_q16);

#endif
