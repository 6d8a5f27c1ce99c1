// The oscillator behind a simulated board's microsecond counter: an offset, a skew, and a skew that
// wanders. True time in, count out.
//
// The skew's rate of change is constant for a second of true time, then drawn anew, and reflected
// where it would lead beyond the bound. All of it is whole numbers of ppb, so the count is its exact
// integral, rounded down: it is monotonic, and the same wherever and in whatever order it is read.
#ifndef HEADWAY_SIM_OSCILLATOR_H
#define HEADWAY_SIM_OSCILLATOR_H

#include <stdbool.h>
#include <stdint.h>

#define OSCILLATOR_PPB_MAX 1000000 // of the bound and of the wander: no product overflows

// A second in which the skew changes evenly.
struct oscillator_stretch {
    int64_t since_us; // true time
    int64_t count_us; // at its begin
    int32_t phase;    // of a count at its begin, in 1e-9
    int32_t skew_ppb; // at its begin
    int32_t rate_ppb_per_s;
};

struct oscillator {
    int64_t offset_us; // count at true time 0
    int32_t drift_ppb; // skew until then
    int32_t wander_ppb_per_s, bound_ppb;
    uint64_t seed, random;
    // Where it is: packets arrive slightly before now, so one stretch is kept.
    struct oscillator_stretch last, now;
    // Of several steps only the last is told from what was before it.
    int64_t stepped_at_us;
    int32_t step_us;
};

// Starts at true time 0. False, and nothing is changed, unless |drift| <= bound and bound and wander
// are from 0 to OSCILLATOR_PPB_MAX. Where the bound is less than the wander, it is the wander's.
bool oscillator_begin(struct oscillator *oscillator, int64_t offset_us, int32_t drift_ppb,
                      int32_t wander_ppb_per_s, int32_t bound_ppb, uint64_t seed);

// Moves to a true time; from there a second back and any time ahead are read. It costs nothing
// within a second, nothing without wander, and nanoseconds for each second otherwise.
void oscillator_seek(struct oscillator *oscillator, int64_t true_us);

// The count at any true time, before the wrap.
int64_t oscillator_read(const struct oscillator *oscillator, int64_t true_us);

// The counter jumps, for all that follows.
void oscillator_step(struct oscillator *oscillator, int64_t true_us, int32_t step_us);

// The next of a seeded generator's numbers.
uint64_t splitmix64(uint64_t *state);

#endif
