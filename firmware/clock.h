// The clock map: local count (a free-running 32-bit microsecond counter) to system time, and the
// filter that keeps it there.
//
// Every sample of the offset comes from four stamps: a status leaves the device at t0 and reaches
// the host at t1; a frame leaves the host at t2 and reaches the device at t3. With equal mean delays
// the host is ahead by ((t1 - t0) + (t2 - t3)) / 2: remote minus local, with half the round trip
// taken off. The clock first steps, by the first sample and by the mean of those that settle it
// (only while unsynced), then is slewed by at most 2^-CLOCK_SLEW_SHIFT.
#ifndef HEADWAY_CLOCK_H
#define HEADWAY_CLOCK_H

#include <stdbool.h>
#include <stdint.h>

#define CLOCK_SETTLE_SAMPLES 64   // offsets averaged before the second of the two initial steps
#define CLOCK_SLEW_SHIFT 11       // slewing at most 2^-11 = 488 ppm
#define CLOCK_SKEW_MAX_Q32 858993 // 200 ppm
#define CLOCK_PHASE_SHIFT 8       // each offset moves the phase by 1/256 of itself
#define CLOCK_SKEW_SHIFT_Q32 3    // and the skew by 2^3 / 2^32 = 1.9e-9 per microsecond

struct headway_clock {
    int64_t system_us; // system time at `count_us` ...
    uint32_t fraction_q32;
    uint32_t count_us;
    int32_t skew_q32;    // system rate over local rate, minus one
    int32_t pending_q16; // phase still to be slewed in, microseconds
    int64_t stepped_us;  // system time after the last step: older stamps are of another time
    int32_t settle_sum_us;
    int32_t settle_count;
    bool synced;
};

// Moves the map's anchor to a later count. Call at least every second.
void clock_advance(struct headway_clock *clock, uint32_t count_us);

// System time of a count within half a minute of the anchor, before or after.
int64_t clock_at(const struct headway_clock *clock, uint32_t count_us);

// One offset sample, remote minus local.
void clock_sample(struct headway_clock *clock, int64_t offset_us);

// Settles anew, with steps.
void clock_restart(struct headway_clock *clock);

#endif
