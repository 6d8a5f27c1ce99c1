#include "ramp.h"
#include "fixed.h" // clamp

void ramp_start(struct ramp *ramp, int32_t position_pq, int32_t velocity_pq, int32_t torque_tq,
                int32_t end_torque_tq) {
    ramp->position_q16 = (int64_t)position_pq * (1 << 16);
    ramp->velocity_q16 = (int64_t)velocity_pq * (1 << 16);
    ramp->torque_tq = torque_tq;
    ramp->end_torque_tq = end_torque_tq;
    ramp->begun = true;
    ramp->resting = false;
}

void ramp_step(struct ramp *ramp, int32_t deceleration_q16, int32_t torque_step_tq) {
    int64_t before_q16 = ramp->velocity_q16;
    if (ramp->velocity_q16 > deceleration_q16)
        ramp->velocity_q16 -= deceleration_q16;
    else if (ramp->velocity_q16 < -deceleration_q16)
        ramp->velocity_q16 += deceleration_q16;
    else
        ramp->velocity_q16 = 0;
    ramp->position_q16 += (before_q16 + ramp->velocity_q16) / 2;
    ramp->torque_tq += fixed_clamp(ramp->end_torque_tq - ramp->torque_tq, torque_step_tq);
    ramp->resting = ramp->velocity_q16 == 0 && ramp->torque_tq == ramp->end_torque_tq;
}

int32_t ramp_position_pq(const struct ramp *ramp) {
    return (int32_t)(uint32_t)(uint64_t)(ramp->position_q16 >> 16);
}

int32_t ramp_velocity_pq(const struct ramp *ramp) { return (int32_t)(ramp->velocity_q16 >> 16); }
