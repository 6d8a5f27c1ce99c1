// Synchronization: stamps in, a disciplined clock out, and how far it may be off.
//
// What stamps prove is in bounds.h. The clock is steered to the middle of the set that they leave,
// and the interval of its possible error is what is left to either side. Whoever lies about his time
// contradicts the set, and is excluded.
#ifndef HEADWAY_SYNC_H
#define HEADWAY_SYNC_H

#include "average.h"
#include "bounds.h"
#include "clock.h"
#include "stamps.h"

#define SYNC_SETTLE_US 1000000 // for so long the error is within its limit before the clock is used
#define SYNC_DRIFT_MAX_PPM 300
#define SYNC_WANDER_MAX_PPB_S 60000
#define SYNC_LIMIT_MAX_US 1000000
#define SYNC_OUTCAST 64 // samples excluded in a row: then it is us who are wrong

enum sync_method {
    SYNC_BOUNDS,  // to the middle of what the stamps allow
    SYNC_AVERAGE, // by the mean offset and half the round trip, see average.h
    SYNC_METHODS,
};

struct sync_settings {
    uint8_t method;              // enum sync_method
    uint16_t drift_ppm;          // of the own oscillator against the other clock, at most
    uint16_t wander_ppb_s;       // change of that drift, at most, per second
    uint32_t to_device_least_us; // no frame takes less time to get here ...
    uint32_t to_host_least_us;   // ... and none of ours to get there
    uint32_t limit_us;           // largest error with which the axis may move
    struct average_settings average;
};

struct sync {
    bool begun; // there is a base
    bool settled;
    bool stepped;      // the first sample set the clock
    int64_t wide_us;   // ticks when the error was last not known to be within the limit
    int64_t heard_us;  // ticks of the last sample that was taken
    uint32_t excluded; // samples that contradicted the set, ever
    uint32_t outcast;  // and in a row
    int32_t least_error_ns, most_error_ns; // own clock minus the other one; at the ends: unknown
    struct bounds bounds;
    struct average average;
};

// Forgets everything: the next sample begins anew.
void sync_restart(struct sync *sync);

// A frame with stamps that arrived at a count, not later than `now_count_us`. A clock that may not
// step is then only slewed. Returns whether the sample was taken.
bool sync_take(struct sync *sync, const struct sync_settings *settings, struct headway_clock *clock,
               const struct stamps *stamps, uint32_t arrived_us, uint32_t now_count_us);

// To be called after each clock_advance, at least every second. Returns whether the clock stepped, now
// or by a first sample.
bool sync_steer(struct sync *sync, const struct sync_settings *settings,
                struct headway_clock *clock, bool may_step);

// The error's bound, either way, in us; INT32_MAX: none.
int32_t sync_error_us(const struct sync *sync);

#endif
