#include "clock.h"
#include "fixed.h" // products
#include "near.h"

#define BRIEF_US 1000 // in less the rate makes less than 2^31 of it

static int64_t skewed_q32(const struct headway_clock *clock, int32_t elapsed_us) {
    if ((uint32_t)elapsed_us < BRIEF_US) // as from one servo period to the next; all ways are exact
        return elapsed_us * clock->rate_q32;
    if ((uint32_t)elapsed_us <= UINT16_MAX)
        return fixed_mul_u16(clock->rate_q32, (uint16_t)elapsed_us);
    return (int64_t)elapsed_us * clock->rate_q32;
}

static int32_t elapsed(const struct headway_clock *clock, uint32_t count_us) {
    return (int32_t)(count_us - clock->count_us);
}

int64_t clock_ticks(const struct headway_clock *clock, uint32_t count_us) {
    return clock->ticks_us + elapsed(clock, count_us);
}

int64_t clock_at(const struct headway_clock *clock, uint32_t count_us) {
    int32_t elapsed_us = elapsed(clock, count_us);
    return clock->system_us + elapsed_us +
           ((skewed_q32(clock, elapsed_us) + (int64_t)clock->fraction_q32) >> 32);
}

// After a while. Apart, and called: from one servo period to the next it is brief.
static RARE void advance_far(struct headway_clock *clock, int32_t elapsed_us) {
    int64_t fraction = (int64_t)clock->fraction_q32 + skewed_q32(clock, elapsed_us);
    clock->system_us += elapsed_us + (fraction >> 32);
    clock->fraction_q32 = (uint32_t)fraction;
    clock->ticks_us += elapsed_us;
}

void clock_advance(struct headway_clock *clock, uint32_t count_us) {
    int32_t elapsed_us = elapsed(clock, count_us);
    clock->count_us = count_us;
    if ((uint32_t)elapsed_us >= BRIEF_US) {
        advance_far(clock, elapsed_us);
        return;
    }
    int32_t skewed = elapsed_us * clock->rate_q32; // the same, in 32 bits
    uint32_t fraction = clock->fraction_q32 + (uint32_t)skewed;
    int32_t passed_us = elapsed_us + (skewed >> 31) + (fraction < (uint32_t)skewed);
    clock->fraction_q32 = fraction;
    clock->system_us += passed_us;
    clock->ticks_us += (uint32_t)elapsed_us;
}

int64_t clock_offset_q16(const struct headway_clock *clock, int64_t base_us) {
    return (clock->system_us - clock->ticks_us - base_us) * (1 << 16) + (clock->fraction_q32 >> 16);
}

void clock_set(struct headway_clock *clock, int64_t base_us, int64_t offset_q16) {
    clock->system_us = clock->ticks_us + base_us + (offset_q16 >> 16);
    clock->fraction_q32 = (uint32_t)(uint64_t)offset_q16 << 16;
}
