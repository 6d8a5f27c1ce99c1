#include "average.h"
#include "clock.h" // the largest rate
#include "fixed.h" // clamp

#define COUNT_MAX (1 << 20)     // of offsets; beyond it, older ones weigh half
#define OFFSET_MAX_US (1 << 14) // of a mean: what is beyond slews no faster

void average_take(struct average *average, int64_t offset_us) {
    if (average->count == COUNT_MAX) { // nobody asks for a rate
        average->sum_us /= 2;
        average->count /= 2;
    }
    average->sum_us += fixed_clamp64(offset_us, 1 << 30);
    average->count++;
}

bool average_rate(struct average *average, const struct average_settings *settings,
                  int64_t ticks_us, int32_t drift_q32, int32_t *rate_q32) {
    if (ticks_us - average->began_us < settings->interval_us || !average->count)
        return false;
    int32_t mean_us = fixed_clamp64(average->sum_us / average->count, OFFSET_MAX_US);
    average->began_us = ticks_us;
    average->sum_us = 0;
    average->count = 0;
    int32_t skew_q32 = (mean_us * settings->skew_gain_q8) >> AVERAGE_GAIN_BITS;
    int32_t phase_q32 = mean_us * settings->phase_gain;
    average->skew_q32 = fixed_clamp(average->skew_q32 + skew_q32, drift_q32);
    *rate_q32 = fixed_clamp(average->skew_q32 + phase_q32, CLOCK_RATE_MAX_Q32);
    return true;
}
