#include "sync.h"
#include "fixed.h" // clamp
#include <string.h>

#define STAMP_US 1                // stamps are whole microseconds, rounded down
#define STEER_SHIFT 1             // an offset fades with a time constant of 2^17 us
#define STEER_MAX_Q32 1288490     // and is slewed in at 300 ppm at most
#define STEP_Q16 (8 << 16)        // a clock that may step does so beyond it
#define OFFSET_MAX_US (1LL << 44) // half a year from the first sample: no clock runs so far

static struct bounds_limits limits_of(const struct sync_settings *settings) {
    // 2^32 / 10^6 and 2^64 / 10^15, rounded up.
    struct bounds_limits limits = {settings->drift_ppm * 4295, settings->wander_ppb_s * 18447};
    return limits;
}

void sync_restart(struct sync *sync) {
    memset(sync, 0, sizeof *sync);
    sync->least_error_ns = -INT32_MAX;
    sync->most_error_ns = INT32_MAX;
}

static void begin(struct sync *sync, const struct bounds_limits *limits,
                  struct headway_clock *clock, int64_t remote_us, int64_t ticks_us) {
    uint32_t excluded = sync->excluded;
    sync_restart(sync);
    sync->excluded = excluded;
    sync->begun = sync->stepped = true;
    sync->wide_us = sync->average.began_us = ticks_us;
    bounds_clear(&sync->bounds, limits, remote_us - ticks_us, ticks_us);
    clock_set(clock, sync->bounds.base_us, 0);
}

// Whether an offset may be had in Q16.
static bool is_near(int64_t offset_us) {
    return offset_us <= OFFSET_MAX_US && offset_us >= -OFFSET_MAX_US;
}

bool sync_take(struct sync *sync, const struct sync_settings *settings, struct headway_clock *clock,
               const struct stamps *stamps, uint32_t arrived_us, uint32_t now_count_us) {
    struct bounds_limits limits = limits_of(settings);
    struct bounds *bounds = &sync->bounds;
    int64_t now_us = clock_ticks(clock, now_count_us);
    int64_t arrived = clock_ticks(clock, arrived_us), echo = clock_ticks(clock, stamps->echo_us);
    if (!sync->begun)
        begin(sync, &limits, clock, stamps->sent_us, arrived);
    bool echoes = stamps->received_us != 0 && echo <= arrived;
    bounds_advance(bounds, &limits, now_us);
    // Of two readings that are rounded down, one may be a microsecond more.
    int64_t lower_us =
        stamps->sent_us - arrived - bounds->base_us - STAMP_US + settings->to_device_least_us;
    int64_t upper_us =
        stamps->received_us - echo - bounds->base_us + STAMP_US - settings->to_host_least_us;
    bool taken = is_near(lower_us) && (!echoes || is_near(upper_us)) &&
                 bounds_prove(bounds, &limits, false, lower_us * (1 << 16), arrived) &&
                 (!echoes || bounds_prove(bounds, &limits, true, upper_us * (1 << 16), echo));
    if (!taken) {
        sync->excluded++;
        sync->outcast++;
        return false;
    }
    sync->outcast = 0;
    sync->heard_us = now_us;
    if (echoes) {
        int64_t ahead_us = (stamps->received_us - clock_at(clock, stamps->echo_us)) +
                           (stamps->sent_us - clock_at(clock, arrived_us));
        average_take(&sync->average, ahead_us / 2);
    }
    return true;
}

static int32_t nanoseconds(int64_t offset_q16) {
    if (offset_q16 >= 1LL << 36 || offset_q16 <= -(1LL << 36))
        return offset_q16 > 0 ? INT32_MAX : -INT32_MAX;
    return fixed_clamp64((offset_q16 * 1000) >> 16, INT32_MAX);
}

static void steer_to_middle(const struct sync *sync, struct headway_clock *clock,
                            int64_t behind_q16) {
    int32_t steer_q32 = fixed_clamp64(behind_q16 >> STEER_SHIFT, STEER_MAX_Q32);
    clock->rate_q32 = fixed_clamp(bounds_skew_q32(&sync->bounds) + steer_q32, CLOCK_RATE_MAX_Q32);
}

bool sync_steer(struct sync *sync, const struct sync_settings *settings,
                struct headway_clock *clock, bool may_step) {
    struct bounds_limits limits = limits_of(settings);
    struct bounds *bounds = &sync->bounds;
    if (!sync->begun)
        return false;
    bool stepped = sync->stepped;
    sync->stepped = false;
    bounds_advance(bounds, &limits, clock->ticks_us);
    if (!bounds_closed(bounds)) {
        sync->wide_us = clock->ticks_us;
        return stepped;
    }
    int64_t offset_q16 = clock_offset_q16(clock, bounds->base_us);
    int64_t behind_q16 = bounds_middle_q16(bounds) - offset_q16;
    bool steps = may_step && (behind_q16 > STEP_Q16 || behind_q16 < -STEP_Q16);
    if (steps) {
        offset_q16 = bounds_middle_q16(bounds);
        clock_set(clock, bounds->base_us, offset_q16);
        behind_q16 = 0;
    }
    if (settings->method == SYNC_BOUNDS || !sync->settled)
        steer_to_middle(sync, clock, behind_q16);
    else
        average_rate(&sync->average, &settings->average, clock->ticks_us, limits.drift_q32,
                     &clock->rate_q32);
    sync->least_error_ns = nanoseconds(offset_q16 - bounds_upper_q16(bounds));
    sync->most_error_ns = nanoseconds(offset_q16 - bounds_lower_q16(bounds) + 65);
    if (sync_error_us(sync) > (int32_t)settings->limit_us)
        sync->wide_us = clock->ticks_us;
    sync->settled = clock->ticks_us - sync->wide_us >= SYNC_SETTLE_US;
    return steps || stepped;
}

int32_t sync_error_us(const struct sync *sync) {
    int32_t least = -sync->least_error_ns, most = sync->most_error_ns;
    int32_t worst = least > most ? least : most;
    return worst == INT32_MAX ? INT32_MAX : worst / 1000 + 1;
}
