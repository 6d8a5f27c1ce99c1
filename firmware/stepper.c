#include "stepper.h"
#include "fixed.h"
#include "servo.h" // SERVO_COUNT_BITS

#define STEP_PQ (1 << SERVO_COUNT_BITS)
#define HALF_PQ (STEP_PQ / 2)
#define AWAY_MAX_PQ (1 << 29) // nothing overflows, and no window has as many steps

static int32_t away_pq(const struct stepper *stepper, int32_t position_pq) {
    int32_t count_pq = servo_position_pq(stepper->count, true);
    return fixed_clamp(fixed_difference(position_pq, count_pq), AWAY_MAX_PQ);
}

// Until the setpoint has made `part_pq` of the `way_pq` that it makes in a window.
static uint32_t time_q16(uint32_t window_q16, int32_t part_pq, int32_t way_pq) {
    if (part_pq <= 0)
        return 0;
    uint64_t time = (uint64_t)window_q16 * (uint32_t)part_pq / (uint32_t)way_pq;
    return time > UINT32_MAX ? UINT32_MAX : (uint32_t)time;
}

void stepper_begin(struct stepper *stepper, int32_t position_pq) {
    stepper->count = fixed_sum(position_pq, HALF_PQ) >> SERVO_COUNT_BITS;
    stepper->target_pq = stepper->now_pq = position_pq;
    stepper->since_q16 = UINT32_MAX;
}

void stepper_shift(struct stepper *stepper, int32_t by_count) {
    int32_t by_pq = servo_position_pq(by_count, true);
    stepper->count = fixed_sum(stepper->count, by_count);
    stepper->target_pq = fixed_sum(stepper->target_pq, by_pq);
    stepper->now_pq = fixed_sum(stepper->now_pq, by_pq);
}

struct pulses stepper_step(struct stepper *stepper, uint32_t least_q16, int32_t target_pq,
                           uint32_t window_us) {
    uint32_t window_q16 = window_us << 16;
    int32_t steps = (away_pq(stepper, target_pq) + HALF_PQ) >> SERVO_COUNT_BITS;
    int32_t sign = steps < 0 ? -1 : 1;
    int32_t way_pq =
        sign * fixed_clamp(fixed_difference(target_pq, stepper->target_pq), AWAY_MAX_PQ);
    int32_t begun_pq = sign * away_pq(stepper, stepper->target_pq);
    uint32_t count = (uint32_t)(sign * steps);
    struct pulses pulses = {.first_q16 = 0, .spacing_q16 = least_q16};
    if (way_pq > 0) { // else what was left over is made up for, as fast as may be
        pulses.first_q16 = time_q16(window_q16, HALF_PQ - begun_pq, way_pq);
        pulses.spacing_q16 = time_q16(window_q16, STEP_PQ, way_pq);
    }
    uint32_t wait_q16 = stepper->since_q16 < least_q16 ? least_q16 - stepper->since_q16 : 0;
    if (pulses.first_q16 < wait_q16)
        pulses.first_q16 = wait_q16;
    if (pulses.spacing_q16 < least_q16)
        pulses.spacing_q16 = least_q16;
    uint32_t fit = pulses.first_q16 < window_q16
                       ? (window_q16 - 1 - pulses.first_q16) / pulses.spacing_q16 + 1
                       : 0;
    if (count > fit) // the others come later
        count = fit;
    stepper->since_q16 += window_q16;
    if (stepper->since_q16 < window_q16)
        stepper->since_q16 = UINT32_MAX;
    if (count > 0)
        stepper->since_q16 = window_q16 - (pulses.first_q16 + (count - 1) * pulses.spacing_q16);
    pulses.steps = sign * (int32_t)count;
    stepper->count = fixed_sum(stepper->count, pulses.steps);
    stepper->now_pq = stepper->target_pq;
    stepper->target_pq = target_pq;
    return pulses;
}
