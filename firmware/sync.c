#include "sync.h"
#include "fixed.h" // clamp
#include "near.h"
#include <string.h>

#define STAMP_US 1                   // stamps are whole microseconds, rounded down
#define STEER_GAIN 4                 // an offset fades with a time constant of 2^14 us ...
#define MARK_SHIFT 1                 // ... and one from a mark, which is rounded, with 2^17
#define STEER_MAX_Q32 1288490        // and is slewed in at 300 ppm at most
#define NEAR_Q16 (4 * STEER_MAX_Q32) // beyond it either is slewed in as fast as may be
#define SKEW_SHIFT 22                // what is left of it for 2^22 us is the oscillator's skew ...
#define SKEW_SHIFT_FIRST 20          // ... at first, for ...
#define SKEW_FIRST_US 8000000        // ... so long, 2^20 us are enough
#define STEP_Q16 (8 << 16)           // a clock that may step does so beyond it
#define OFFSET_MAX_US (1LL << 44)    // half a year from the first sample: no clock runs so far
#define DATE_US 1000000              // a mark is dated so soon, or not
#define NANOSECOND_Q16 66            // of a microsecond, rounded up

static struct bounds_limits limits_of(const struct sync_settings *settings) {
    // 2^32 / 10^6 and 2^64 / 10^15, rounded up.
    struct bounds_limits limits = {settings->drift_ppm * 4295, settings->wander_ppb_s * 18447};
    return limits;
}

struct sync_source sync_host(const struct sync_settings *settings) {
    struct sync_source host = {.to_here_least_us = settings->to_device_least_us,
                               .to_there_least_us = settings->to_host_least_us};
    return host;
}

void sync_restart(struct sync *sync) {
    uint32_t id = sync->id, excluded = sync->excluded;
    memset(sync, 0, sizeof *sync);
    sync->id = id;
    sync->excluded = excluded;
    sync->least_error_ns = -SYNC_ERROR_OPEN;
    sync->most_error_ns = SYNC_ERROR_OPEN;
}

static void begin(struct sync *sync, const struct sync_settings *settings,
                  const struct headway_clock *clock, uint32_t lineage, int64_t base_us) {
    struct bounds_limits limits = limits_of(settings);
    sync_restart(sync);
    sync->begun = true;
    sync->lineage = lineage;
    sync->wide_us = sync->heard_us = sync->average.began_us = clock->ticks_us;
    bounds_clear(&sync->bounds, &limits, base_us, clock->ticks_us);
}

bool sync_is_reference(const struct sync *sync) {
    return sync->id != 0 && sync->lineage == sync->id;
}

// How far the other clock is ahead of the own one, as two stamps prove it. Of two readings that are
// rounded down, one may be a microsecond more.
struct ahead {
    int64_t least_us, most_us;
};

static struct ahead ahead_of(const struct headway_clock *clock, const struct sync_source *source,
                             const struct stamps *stamps, uint32_t arrived_us) {
    struct ahead ahead = {stamps->sent_us - clock_at(clock, arrived_us) - STAMP_US +
                              source->to_here_least_us,
                          stamps->received_us - clock_at(clock, stamps->echo_us) + STAMP_US -
                              source->to_there_least_us};
    return ahead;
}

// Follows the source from now on, if there is nobody yet or if it is to be joined.
static void join(struct sync *sync, const struct sync_settings *settings,
                 struct headway_clock *clock, const struct sync_source *source,
                 const struct stamps *stamps, uint32_t arrived_us) {
    struct ahead ahead = ahead_of(clock, source, stamps, arrived_us);
    struct lineage own = {sync->lineage, sync->settled};
    if (sync->begun && !(settings->among_boards &&
                         lineage_joins(own, source->lineage, ahead.least_us, ahead.most_us)))
        return;
    begin(sync, settings, clock, source->lineage.id,
          stamps->sent_us - clock_ticks(clock, arrived_us));
    clock_set(clock, sync->bounds.base_us, 0);
    sync->stepped = true;
}

// Whether an offset may be had in Q16.
static bool is_near(int64_t offset_us) {
    return offset_us <= OFFSET_MAX_US && offset_us >= -OFFSET_MAX_US;
}

// Both proofs or none; there may be no upper one.
static bool prove_both(struct bounds *bounds, const struct bounds_limits *limits,
                       struct bounds_line lower, const struct bounds_line *upper) {
    struct bounds before = *bounds;
    if (bounds_prove(bounds, limits, false, lower.value_q16, lower.ticks_us) &&
        (!upper || bounds_prove(bounds, limits, true, upper->value_q16, upper->ticks_us)))
        return true;
    *bounds = before;
    return false;
}

// What the other clock shows as s was at s minus its error.
static bool prove(struct sync *sync, const struct bounds_limits *limits,
                  const struct headway_clock *clock, const struct sync_source *source,
                  const struct stamps *stamps, uint32_t arrived_us) {
    struct bounds *bounds = &sync->bounds;
    int64_t arrived = clock_ticks(clock, arrived_us), echo = clock_ticks(clock, stamps->echo_us);
    int64_t lower_us =
        stamps->sent_us - arrived - bounds->base_us - STAMP_US + source->to_here_least_us;
    int64_t upper_us =
        stamps->received_us - echo - bounds->base_us + STAMP_US - source->to_there_least_us;
    int64_t most_q16 = (int64_t)source->most_error_ns * (1 << 16) / 1000 + 1; // rounded away
    int64_t least_q16 = (int64_t)source->least_error_ns * (1 << 16) / 1000 - 1;
    bool echoes = stamps->received_us != 0 && echo <= arrived;
    if (!is_near(lower_us) || (echoes && !is_near(upper_us)))
        return false;
    struct bounds_line lower = {lower_us * (1 << 16) - most_q16, arrived};
    if (!echoes)
        return prove_both(bounds, limits, lower, 0);
    struct bounds_line upper = {upper_us * (1 << 16) - least_q16, echo};
    return prove_both(bounds, limits, lower, &upper);
}

// Whether every source that is heard, and there is one, contradicts what is known, again and again.
static bool doubts_all(const struct sync *sync) {
    for (int32_t i = 0; i < SYNC_SOURCES; i++)
        if (sync->heard >> i & 1 && sync->doubt[i] < SYNC_DOUBT_MAX)
            return false;
    return true;
}

bool sync_take(struct sync *sync, const struct sync_settings *settings, struct headway_clock *clock,
               const struct sync_source *source, const struct stamps *stamps, uint32_t arrived_us,
               uint32_t now_count_us, bool may_step) {
    struct bounds_limits limits = limits_of(settings);
    if (source->least_error_ns == -SYNC_ERROR_OPEN || source->most_error_ns == SYNC_ERROR_OPEN)
        return false; // it does not know the time itself
    if (may_step)
        join(sync, settings, clock, source, stamps, arrived_us);
    if (!sync->begun || sync_is_reference(sync))
        return false;
    bool same = !settings->among_boards || source->lineage.id == sync->lineage;
    bounds_advance(&sync->bounds, &limits, clock_ticks(clock, now_count_us));
    sync->carried = false;
    uint16_t *doubt = &sync->doubt[source->number];
    sync->heard |= (uint8_t)(1 << source->number);
    bool good = same && prove(sync, &limits, clock, source, stamps, arrived_us);
    if (good)
        *doubt -= *doubt > 0;
    else
        *doubt = *doubt > SYNC_DOUBT_MAX ? *doubt : (uint16_t)(*doubt + SYNC_DOUBT_STEP);
    sync->doubting = doubts_all(sync);
    if (!good) {
        sync->excluded++;
        sync->outcast++;
        return false;
    }
    sync->outcast = 0;
    sync->heard_us = clock_ticks(clock, now_count_us);
    struct ahead ahead = ahead_of(clock, source, stamps, arrived_us);
    if (stamps->received_us != 0)
        average_take(&sync->average, (ahead.least_us + ahead.most_us) / 2);
    return true;
}

struct mark sync_date(const struct sync *sync, const struct sync_settings *settings,
                      const struct headway_clock *clock, uint16_t number, uint32_t count_us) {
    struct bounds_limits limits = limits_of(settings);
    struct mark mark = {number, MARK_OPEN, 0};
    int64_t ticks_us = clock_ticks(clock, count_us), base_us = sync->bounds.base_us + ticks_us;
    int64_t ahead_us = ticks_us - sync->bounds.ticks_us; // of what is known
    if (!sync->begun)
        return mark;
    if (ahead_us > DATE_US || ahead_us < -DATE_US) // as after a counter's jump
        return mark;
    int64_t lower_us = bounds_lower_at_q16(&sync->bounds, &limits, ticks_us) >> 16;
    int64_t upper_us = (bounds_upper_at_q16(&sync->bounds, &limits, ticks_us) >> 16) + 1 + STAMP_US;
    if (upper_us - lower_us < MARK_OPEN) {
        mark.least_us = base_us + lower_us;
        mark.width_us = (uint16_t)(upper_us - lower_us);
    }
    return mark;
}

bool sync_take_mark(struct sync *sync, const struct sync_settings *settings,
                    const struct headway_clock *clock, const struct mark *mark, uint32_t count_us,
                    uint32_t now_count_us) {
    struct bounds_limits limits = limits_of(settings);
    int64_t ticks_us = clock_ticks(clock, count_us);
    if (!sync->begun)
        return false;
    bounds_advance(&sync->bounds, &limits, clock_ticks(clock, now_count_us));
    sync->carried = false;
    int64_t least_us = mark->least_us - ticks_us - sync->bounds.base_us;
    bool near = is_near(least_us); // else the products would overflow
    struct bounds_line lower = {near ? (least_us - STAMP_US) * (1 << 16) : 0, ticks_us};
    struct bounds_line upper = {near ? (least_us + mark->width_us) * (1 << 16) : 0, ticks_us};
    if (!near || !prove_both(&sync->bounds, &limits, lower, &upper)) {
        sync->excluded++;
        return false;
    }
    sync->marked = true;
    sync->mark_us = ticks_us;
    sync->mark_q16 = (lower.value_q16 + upper.value_q16) / 2;
    return true;
}

static bool fits_32(int64_t value) { return value == (int32_t)value; }

// Rounded down; `open` beyond a second. Whole microseconds and what is below them apart: no product
// needs 64 bits.
static int32_t nanoseconds(int64_t offset_q16, int32_t open) {
    if (fits_32(offset_q16)) // as nearly always
        return fixed_mul_q16((int32_t)offset_q16, 1000);
    if (offset_q16 >= 1LL << 36 || offset_q16 <= -(1LL << 36))
        return open;
    uint32_t below_q16 = (uint16_t)offset_q16;
    return (int32_t)(offset_q16 >> 16) * 1000 + (int32_t)((below_q16 * 1000) >> 16);
}

// What a steering that has lasted says of the oscillator's skew, rounded down.
static int32_t learnt_q32(int32_t steer_q32, int64_t elapsed_us, bool early) {
    int32_t shift = early ? SKEW_SHIFT_FIRST : SKEW_SHIFT;
    if ((uint64_t)elapsed_us <= UINT16_MAX) // both ways are exact
        return fixed_mul_q16(steer_q32, (uint16_t)elapsed_us) >> (shift - 16);
    return (int32_t)((steer_q32 * elapsed_us) >> shift);
}

static bool is_marked(const struct sync *sync, int64_t ticks_us) {
    return sync->marked && ticks_us - sync->mark_us <= SYNC_MARK_US;
}

static void set_rate(struct sync *sync, const struct sync_settings *settings,
                     struct headway_clock *clock, int64_t behind_q16) {
    if (settings->method == SYNC_AVERAGE && sync->settled) {
        average_rate(&sync->average, &settings->average, clock->ticks_us,
                     limits_of(settings).drift_q32, &clock->rate_q32);
        return;
    }
    // Where the set is wide the middle of its skews says little, but the middle of its offsets moves
    // as the oscillator does: an integral finds the skew, within what is possible.
    bool marked = is_marked(sync, clock->ticks_us);
    int32_t near_q16 = fixed_clamp64(behind_q16, NEAR_Q16);
    int32_t wanted_q32 = marked ? near_q16 >> MARK_SHIFT : near_q16 * STEER_GAIN;
    int32_t steer_q32 = fixed_clamp(wanted_q32, STEER_MAX_Q32);
    int64_t elapsed_us = clock->ticks_us - sync->steered_us;
    bool early = marked || clock->ticks_us - sync->wide_us < SKEW_FIRST_US;
    if (!sync->settled)
        sync->skew_q32 = bounds_skew_q32(&sync->bounds);
    else if (steer_q32 < STEER_MAX_Q32 && steer_q32 > -STEER_MAX_Q32)
        sync->skew_q32 += learnt_q32(steer_q32, elapsed_us, early);
    sync->skew_q32 = bounds_nearest_skew_q32(&sync->bounds, sync->skew_q32);
    sync->steered_us = clock->ticks_us;
    clock->rate_q32 = fixed_clamp(sync->skew_q32 + steer_q32, CLOCK_RATE_MAX_Q32);
}

// Where the clock is steered to: the middle of what is proven here. Or, where there is a mark, the
// middle of what all boards on the bus have proven together: then they agree with each other.
static APART int64_t marked_q16(const struct sync *sync) {
    int64_t age_us = sync->carried_us - sync->mark_us;
    return bounds_nearest_q16(&sync->bounds, sync->mark_q16 + ((sync->skew_q32 * age_us) >> 16));
}

void sync_carry(struct sync *sync, const struct sync_settings *settings,
                const struct headway_clock *clock) {
    struct bounds_limits limits = limits_of(settings);
    sync->carried = true;
    sync->carried_us = clock->ticks_us;
    if (sync_is_reference(sync))
        sync->heard_us = clock->ticks_us;
    else
        bounds_advance(&sync->bounds, &limits, clock->ticks_us);
    if (bounds_closed(&sync->bounds)) // else it may be anywhere
        sync->offset_q16 = clock_offset_q16(clock, sync->bounds.base_us);
}

void sync_compare(struct sync *sync, const struct sync_settings *settings,
                  const struct headway_clock *clock) {
    const struct bounds *bounds = &sync->bounds;
    if (!sync->carried && !sync->waited) {
        sync->waited = true;
        return;
    }
    if (!sync->carried)
        sync_carry(sync, settings, clock);
    sync->waited = false;
    if (!bounds_closed(bounds))
        return;
    int64_t offset_q16 = sync->offset_q16;
    sync->above_q16 = offset_q16 - bounds_upper_q16(bounds);
    sync->below_q16 = offset_q16 - bounds_lower_q16(bounds);
    bool marked = is_marked(sync, sync->carried_us);
    sync->behind_q16 = (marked ? marked_q16(sync) : bounds_middle_q16(bounds)) - offset_q16;
}

// To the middle of what is proven, if it is far away; returns whether it was.
static bool step(struct sync *sync, struct headway_clock *clock) {
    int64_t behind_q16 = sync->behind_q16, base_us = sync->bounds.base_us;
    if (behind_q16 <= STEP_Q16 && behind_q16 >= -STEP_Q16)
        return false;
    clock_set(clock, base_us, clock_offset_q16(clock, base_us) + behind_q16);
    sync->behind_q16 = 0;
    sync->above_q16 += behind_q16;
    sync->below_q16 += behind_q16;
    return true;
}

static int32_t worst_ns(const struct sync *sync) {
    int32_t least = -sync->least_error_ns, most = sync->most_error_ns;
    return least > most ? least : most;
}

void sync_tell(struct sync *sync, const struct sync_settings *settings) {
    sync->told_us = sync->carried_us;
    if (sync_is_reference(sync)) {
        sync->least_error_ns = sync->most_error_ns = 0;
    } else if (bounds_closed(&sync->bounds)) {
        sync->least_error_ns = nanoseconds(sync->above_q16, -SYNC_ERROR_OPEN);
        sync->most_error_ns = nanoseconds(sync->below_q16 + NANOSECOND_Q16, SYNC_ERROR_OPEN);
    }
    sync->doubtful |= sync->doubting;
    if (sync->doubtful) {
        sync->least_error_ns = -SYNC_ERROR_OPEN;
        sync->most_error_ns = SYNC_ERROR_OPEN;
    }
    if (worst_ns(sync) > (int32_t)settings->limit_us * 1000) // one second at most
        sync->wide_us = sync->told_us;
    sync->settled = sync->told_us - sync->wide_us >= SYNC_SETTLE_US;
}

void sync_lead(struct sync *sync, const struct sync_settings *settings,
               struct headway_clock *clock) {
    if (sync_is_reference(sync))
        clock->rate_q32 = 0;
    else if (bounds_closed(&sync->bounds))
        set_rate(sync, settings, clock, sync->behind_q16);
}

bool sync_steer(struct sync *sync, const struct sync_settings *settings,
                struct headway_clock *clock, bool may_step) {
    if (!sync->begun && settings->among_boards && may_step) // the own time, until there is better
        begin(sync, settings, clock, sync->id, clock->system_us - clock->ticks_us);
    bool steps = sync->stepped;
    sync->stepped = false;
    sync_carry(sync, settings, clock);
    sync_compare(sync, settings, clock);
    if (may_step && !sync_is_reference(sync) && bounds_closed(&sync->bounds))
        steps |= step(sync, clock);
    sync_lead(sync, settings, clock);
    sync_tell(sync, settings);
    return steps;
}

int32_t sync_error_us(const struct sync *sync) {
    int32_t worst = worst_ns(sync);
    return worst == SYNC_ERROR_OPEN ? SYNC_ERROR_OPEN : worst / 1000 + (worst % 1000 != 0);
}
