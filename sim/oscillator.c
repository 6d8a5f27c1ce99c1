#include "oscillator.h"

#define SECOND_US 1000000
#define BILLION 1000000000

uint64_t splitmix64(uint64_t *state) { // Steele, Lea, Flood, OOPSLA 2014
    uint64_t z = *state += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return z ^ z >> 31;
}

static int64_t floor_divide(int64_t a, int64_t b) { return a / b - (a % b < 0); }

// A rate from -most to most that keeps the skew within its bound for a second.
static int32_t draw_rate(struct oscillator *oscillator, int32_t skew_ppb) {
    int32_t most = oscillator->wander_ppb_per_s;
    if (most > oscillator->bound_ppb)
        most = oscillator->bound_ppb;
    int32_t rate = (int32_t)(splitmix64(&oscillator->random) % (uint64_t)(2 * most + 1)) - most;
    int32_t ahead = skew_ppb + rate;
    return ahead > oscillator->bound_ppb || ahead < -oscillator->bound_ppb ? -rate : rate;
}

// To the begin: before it the skew was always what it is there.
static void rewind_all(struct oscillator *oscillator) {
    struct oscillator_stretch begin = {.skew_ppb = oscillator->drift_ppb};
    oscillator->random = oscillator->seed;
    oscillator->last = begin;
    begin.rate_ppb_per_s = draw_rate(oscillator, begin.skew_ppb);
    oscillator->now = begin;
}

bool oscillator_begin(struct oscillator *oscillator, int64_t offset_us, int32_t drift_ppb,
                      int32_t wander_ppb_per_s, int32_t bound_ppb, uint64_t seed) {
    if (bound_ppb < 0 || bound_ppb > OSCILLATOR_PPB_MAX || drift_ppb < -bound_ppb ||
        drift_ppb > bound_ppb || wander_ppb_per_s < 0 || wander_ppb_per_s > OSCILLATOR_PPB_MAX)
        return false;
    struct oscillator begin = {.offset_us = offset_us,
                               .drift_ppb = drift_ppb,
                               .wander_ppb_per_s = wander_ppb_per_s,
                               .bound_ppb = bound_ppb,
                               .seed = seed};
    rewind_all(&begin);
    *oscillator = begin;
    return true;
}

// Time that has passed on the counter since the stretch began [1e-9 us], beyond true time.
static int64_t gained(const struct oscillator_stretch *stretch, int64_t elapsed_us) {
    int64_t square = stretch->rate_ppb_per_s * elapsed_us * elapsed_us;
    return stretch->skew_ppb * elapsed_us + floor_divide(square, 2 * SECOND_US);
}

static int64_t count_in(const struct oscillator_stretch *stretch, int64_t true_us) {
    int64_t elapsed_us = true_us - stretch->since_us;
    int64_t gain;
    if (stretch->rate_ppb_per_s == 0) { // it may be years: in two parts
        int64_t rest = elapsed_us % BILLION * stretch->skew_ppb + stretch->phase;
        gain = elapsed_us / BILLION * stretch->skew_ppb + floor_divide(rest, BILLION);
    } else {
        gain = floor_divide(gained(stretch, elapsed_us) + stretch->phase, BILLION);
    }
    return stretch->count_us + elapsed_us + gain;
}

static void next_stretch(struct oscillator *oscillator) {
    const struct oscillator_stretch *now = &oscillator->now;
    int64_t gain = gained(now, SECOND_US) + now->phase; // exact: a second's square is even
    int64_t whole_us = floor_divide(gain, BILLION);
    struct oscillator_stretch next = {.since_us = now->since_us + SECOND_US,
                                      .count_us = now->count_us + SECOND_US + whole_us,
                                      .phase = (int32_t)(gain - whole_us * BILLION),
                                      .skew_ppb = now->skew_ppb + now->rate_ppb_per_s};
    next.rate_ppb_per_s = draw_rate(oscillator, next.skew_ppb);
    oscillator->last = oscillator->now;
    oscillator->now = next;
}

void oscillator_seek(struct oscillator *oscillator, int64_t true_us) {
    if (oscillator->wander_ppb_per_s == 0 || oscillator->bound_ppb == 0)
        return; // the first stretch is the only one
    if (true_us < oscillator->last.since_us)
        rewind_all(oscillator);
    while (true_us >= oscillator->now.since_us + SECOND_US)
        next_stretch(oscillator);
}

int64_t oscillator_read(const struct oscillator *oscillator, int64_t true_us) {
    struct oscillator there = *oscillator;
    oscillator_seek(&there, true_us);
    const struct oscillator_stretch *stretch =
        true_us < there.now.since_us ? &there.last : &there.now;
    int64_t count_us = count_in(stretch, true_us) + there.offset_us;
    return true_us < there.stepped_at_us ? count_us : count_us + there.step_us;
}

void oscillator_step(struct oscillator *oscillator, int64_t true_us, int32_t step_us) {
    oscillator->offset_us += oscillator->step_us;
    oscillator->stepped_at_us = true_us;
    oscillator->step_us = step_us;
}
