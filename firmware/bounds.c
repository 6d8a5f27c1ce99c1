#include "bounds.h"
#include "fixed.h" // products
#include <string.h>

#define SOLVE_ROUNDS 4             // of Newton's method; each ends with a valid bound
#define NOTHING_Q16 (-(1LL << 61)) // lower than all that a proof says

void bounds_clear(struct bounds *bounds, const struct bounds_limits *limits, int64_t base_us,
                  int64_t ticks_us) {
    memset(bounds, 0, sizeof *bounds);
    bounds->base_us = base_us;
    bounds->ticks_us = ticks_us;
    bounds->lower.skew_q32 = bounds->upper.skew_q32 = -limits->drift_q32;
    bounds->lower.value_q16 = bounds->upper.value_q16 = NOTHING_Q16;
}

// wander a^2 / 2, rounded up, for ages of a minute at most: in 1024 us their square has 32 bits.
static int64_t slack_q16(const struct bounds_limits *limits, int64_t age_us) {
    uint32_t age = (uint32_t)(age_us + 1023) >> 10;
    return (int64_t)(fixed_mul_u32(age * age, (uint32_t)limits->wander_q64) >> 29) + 1;
}

// What a line says now if the skew is `skew_q32`, within the drift; rounded down. One that is too old
// says nothing.
static int64_t line_q16(const struct bounds_limits *limits, const struct bounds_line *line,
                        int64_t ticks_us, int64_t skew_q32) {
    int64_t age_us = ticks_us - line->ticks_us;
    if (age_us > BOUNDS_AGE_MAX)
        return NOTHING_Q16;
    return line->value_q16 + (fixed_mul_i32((int32_t)skew_q32, (uint32_t)age_us) >> 16) -
           slack_q16(limits, age_us);
}

// The highest line at a skew.
static const struct bounds_line *highest(const struct bounds_limits *limits,
                                         const struct bounds_side *side, int64_t ticks_us,
                                         int64_t skew_q32, int64_t *value_q16) {
    const struct bounds_line *best = side->lines; // there is one
    *value_q16 = line_q16(limits, best, ticks_us, skew_q32);
    for (int32_t i = 1; i < side->count; i++) {
        int64_t value = line_q16(limits, &side->lines[i], ticks_us, skew_q32);
        if (value > *value_q16) {
            best = &side->lines[i];
            *value_q16 = value;
        }
    }
    return best;
}

// Of a side: its skew may have wandered, and was at least what is left of it all the way.
static void carry(struct bounds_side *side, const struct bounds_limits *limits,
                  int64_t wandered_q32, int64_t elapsed_us) {
    side->skew_q32 -= wandered_q32;
    if (side->skew_q32 < -limits->drift_q32)
        side->skew_q32 = -limits->drift_q32;
    // In two parts: of some months the product would not fit.
    side->value_q16 += side->skew_q32 * (elapsed_us >> 16);
    side->value_q16 += (side->skew_q32 * (int64_t)(uint16_t)elapsed_us) >> 16;
}

// The same from one servo period to the next: 32 bits hold the skew, which is within the drift, and 16
// what elapses.
static inline void carry_briefly(struct bounds_side *side, int32_t drift_q32, int32_t wandered_q32,
                                 uint16_t elapsed_us) {
    int32_t skew_q32 = (int32_t)side->skew_q32;
    skew_q32 = skew_q32 < -drift_q32 + wandered_q32 ? -drift_q32 : skew_q32 - wandered_q32;
    side->skew_q32 = skew_q32;
    side->value_q16 += fixed_mul_q16(skew_q32, elapsed_us);
}

// Apart, and called: what it needs of registers would slow the usual case.
static __attribute__((noinline)) void
carry_far(struct bounds *bounds, const struct bounds_limits *limits, int64_t elapsed_us) {
    // Beyond an hour, which nobody waits, the skew may be anything within the drift.
    int64_t wandered_q32 = elapsed_us < 1LL << 32 ? ((elapsed_us * limits->wander_q64) >> 32) + 1
                                                  : 2 * limits->drift_q32;
    carry(&bounds->lower, limits, wandered_q32, elapsed_us);
    carry(&bounds->upper, limits, wandered_q32, elapsed_us);
}

void bounds_advance(struct bounds *bounds, const struct bounds_limits *limits, int64_t ticks_us) {
    int64_t elapsed_us = ticks_us - bounds->ticks_us;
    if (elapsed_us <= 0)
        return;
    bounds->ticks_us = ticks_us;
    if (elapsed_us > UINT16_MAX) {
        carry_far(bounds, limits, elapsed_us);
        return;
    }
    uint16_t brief_us = (uint16_t)elapsed_us;
    int32_t wandered_q32 = (fixed_mul_q16(limits->wander_q64, brief_us) >> 16) + 1;
    carry_briefly(&bounds->lower, limits->drift_q32, wandered_q32, brief_us);
    carry_briefly(&bounds->upper, limits->drift_q32, wandered_q32, brief_us);
}

// The least skew, seen from `side`, at which its lines and those of the other side leave room, by
// Newton's method on the gap between the two convex outlines: as it is concave, no step goes too far.
// False if there is no such skew.
static bool bound_skew(const struct bounds_limits *limits, struct bounds_side *side,
                       const struct bounds_side *other, int64_t ticks_us) {
    for (int32_t round = 0; round < SOLVE_ROUNDS; round++) {
        int64_t mine_q16, its_q16;
        const struct bounds_line *mine = highest(limits, side, ticks_us, side->skew_q32, &mine_q16);
        const struct bounds_line *its = highest(limits, other, ticks_us, -side->skew_q32, &its_q16);
        int64_t overlap_q16 = mine_q16 + its_q16;
        if (overlap_q16 <= 0)
            return true;
        int64_t slope_us = mine->ticks_us - its->ticks_us; // by which the overlap shrinks
        if (slope_us <= 0)
            return false;
        int64_t step_q32 = (overlap_q16 << 16) / slope_us; // it is below a second: see bounds_prove
        side->skew_q32 += step_q32;
        if (side->skew_q32 > limits->drift_q32)
            return false;
    }
    return true;
}

static bool solve(struct bounds *bounds, const struct bounds_limits *limits) {
    struct bounds_side *lower = &bounds->lower, *upper = &bounds->upper;
    if (!bounds_closed(bounds))
        return true;
    if (!bound_skew(limits, lower, upper, bounds->ticks_us) ||
        !bound_skew(limits, upper, lower, bounds->ticks_us) || lower->skew_q32 > -upper->skew_q32)
        return false;
    struct bounds_side *sides[] = {lower, upper};
    for (int32_t i = 0; i < 2; i++) {
        int64_t value_q16;
        highest(limits, sides[i], bounds->ticks_us, sides[i]->skew_q32, &value_q16);
        if (value_q16 > sides[i]->value_q16)
            sides[i]->value_q16 = value_q16;
    }
    return lower->value_q16 <= -upper->value_q16;
}

// Where there is room for a line: at the end, or in place of the one that is furthest below the
// outline of the others; one that is too old is below all.
static struct bounds_line *room(struct bounds_side *side, const struct bounds_limits *limits,
                                int64_t ticks_us, int64_t skew_most_q32) {
    enum { PROBES = 5 };
    if (side->count < BOUNDS_LINES)
        return &side->lines[side->count++];
    int64_t top_q16[PROBES], deficit_q16 = 0;
    struct bounds_line *least = side->lines;
    int64_t range_q32 = skew_most_q32 - side->skew_q32;
    for (int32_t k = 0; k < PROBES; k++)
        highest(limits, side, ticks_us, side->skew_q32 + range_q32 * k / (PROBES - 1), &top_q16[k]);
    for (int32_t i = 0; i < BOUNDS_LINES; i++) {
        int64_t nearest_q16 = INT64_MAX;
        for (int32_t k = 0; k < PROBES; k++) {
            int64_t skew_q32 = side->skew_q32 + range_q32 * k / (PROBES - 1);
            int64_t below = top_q16[k] - line_q16(limits, &side->lines[i], ticks_us, skew_q32);
            nearest_q16 = below < nearest_q16 ? below : nearest_q16;
        }
        if (nearest_q16 > deficit_q16) {
            deficit_q16 = nearest_q16;
            least = &side->lines[i];
        }
    }
    return least;
}

bool bounds_prove(struct bounds *bounds, const struct bounds_limits *limits, bool is_upper,
                  int64_t value_q16, int64_t ticks_us) {
    struct bounds_side *side = is_upper ? &bounds->upper : &bounds->lower;
    const struct bounds_side *other = is_upper ? &bounds->lower : &bounds->upper;
    struct bounds_line line = {is_upper ? -value_q16 : value_q16, ticks_us};
    if (ticks_us > bounds->ticks_us || bounds->ticks_us - ticks_us > BOUNDS_AGE_MAX)
        return true; // too old to say anything; or, if a counter has jumped back, too young
    // What contradicts the set at any skew is refused at once. What is left overlaps the other side by
    // no more than the skew's range makes of a line's age.
    int64_t least_q16 = line_q16(limits, &line, bounds->ticks_us, side->skew_q32);
    int64_t most_q16 = line_q16(limits, &line, bounds->ticks_us, -other->skew_q32);
    if (least_q16 > -other->value_q16)
        return false;
    if (most_q16 <= side->value_q16)
        return true; // known
    struct bounds before = *bounds;
    if (least_q16 > side->value_q16)
        side->value_q16 = least_q16;
    *room(side, limits, bounds->ticks_us, -other->skew_q32) = line;
    if (solve(bounds, limits))
        return true;
    *bounds = before;
    return false;
}

bool bounds_closed(const struct bounds *bounds) {
    return bounds->lower.count > 0 && bounds->upper.count > 0;
}

int64_t bounds_lower_q16(const struct bounds *bounds) { return bounds->lower.value_q16; }

int64_t bounds_upper_q16(const struct bounds *bounds) { return -bounds->upper.value_q16; }

// A side's bound at other ticks: by the least of what the skew may have made of it, and wandered to.
static int64_t side_at_q16(const struct bounds_limits *limits, const struct bounds_side *side,
                           const struct bounds_side *other, int64_t elapsed_us) {
    int64_t least_q16 = (side->skew_q32 * elapsed_us) >> 16;
    int64_t most_q16 = (-other->skew_q32 * elapsed_us) >> 16;
    int64_t slack = slack_q16(limits, elapsed_us > 0 ? elapsed_us : -elapsed_us);
    return side->value_q16 + (least_q16 < most_q16 ? least_q16 : most_q16) - slack;
}

int64_t bounds_lower_at_q16(const struct bounds *bounds, const struct bounds_limits *limits,
                            int64_t ticks_us) {
    return side_at_q16(limits, &bounds->lower, &bounds->upper, ticks_us - bounds->ticks_us);
}

int64_t bounds_upper_at_q16(const struct bounds *bounds, const struct bounds_limits *limits,
                            int64_t ticks_us) {
    return -side_at_q16(limits, &bounds->upper, &bounds->lower, ticks_us - bounds->ticks_us);
}

int64_t bounds_middle_q16(const struct bounds *bounds) {
    return (bounds->lower.value_q16 - bounds->upper.value_q16) >> 1;
}

static int64_t within(int64_t value, int64_t least, int64_t most) {
    return value < least ? least : value > most ? most : value;
}

int64_t bounds_nearest_q16(const struct bounds *bounds, int64_t offset_q16) {
    return within(offset_q16, bounds->lower.value_q16, -bounds->upper.value_q16);
}

int32_t bounds_nearest_skew_q32(const struct bounds *bounds, int32_t skew_q32) {
    int32_t least_q32 = (int32_t)bounds->lower.skew_q32; // within the drift
    int32_t most_q32 = -(int32_t)bounds->upper.skew_q32;
    return skew_q32 < least_q32 ? least_q32 : skew_q32 > most_q32 ? most_q32 : skew_q32;
}

int32_t bounds_skew_q32(const struct bounds *bounds) {
    return (int32_t)((bounds->lower.skew_q32 - bounds->upper.skew_q32) >> 1);
}
