#include "clock.h"
#include "fixed.h" // clamp

static int64_t skewed_q32(const struct headway_clock *clock, int32_t elapsed_us) {
    return (int64_t)elapsed_us * clock->skew_q32;
}

int64_t clock_at(const struct headway_clock *clock, uint32_t count_us) {
    int32_t elapsed_us = (int32_t)(count_us - clock->count_us);
    return clock->system_us + elapsed_us +
           ((skewed_q32(clock, elapsed_us) + (int64_t)clock->fraction_q32) >> 32);
}

void clock_advance(struct headway_clock *clock, uint32_t count_us) {
    int32_t elapsed_us = (int32_t)(count_us - clock->count_us);
    int32_t most_q16 = fixed_clamp(elapsed_us, 1 << 24) * (1 << (16 - CLOCK_SLEW_SHIFT));
    int32_t slew_q16 = fixed_clamp(clock->pending_q16, most_q16);
    clock->pending_q16 -= slew_q16;
    int64_t fraction = (int64_t)clock->fraction_q32 + skewed_q32(clock, elapsed_us) +
                       (int64_t)slew_q16 * (1 << 16);
    clock->system_us += elapsed_us + (fraction >> 32);
    clock->fraction_q32 = (uint32_t)fraction;
    clock->count_us = count_us;
}

static void step(struct headway_clock *clock, int64_t offset_us) {
    clock->system_us += offset_us;
    clock->stepped_us = clock->system_us;
}

static void settle(struct headway_clock *clock, int64_t offset_us) {
    if (clock->settle_count == 0) { // far off: take the first sample whole, then average the rest
        step(clock, offset_us);
        clock->settle_count = 1;
        return;
    }
    clock->settle_sum_us += fixed_clamp64(offset_us, 1 << 20);
    if (++clock->settle_count > CLOCK_SETTLE_SAMPLES) {
        step(clock, clock->settle_sum_us / CLOCK_SETTLE_SAMPLES);
        clock->synced = true;
    }
}

void clock_sample(struct headway_clock *clock, int64_t offset_us) {
    if (!clock->synced) {
        settle(clock, offset_us);
        return;
    }
    int32_t offset = fixed_clamp64(offset_us, 4096);
    clock->pending_q16 = offset * (1 << (16 - CLOCK_PHASE_SHIFT));
    clock->skew_q32 =
        fixed_clamp(clock->skew_q32 + offset * (1 << CLOCK_SKEW_SHIFT_Q32), CLOCK_SKEW_MAX_Q32);
}

void clock_restart(struct headway_clock *clock) {
    clock->synced = false;
    clock->settle_count = 0;
    clock->settle_sum_us = 0;
}
