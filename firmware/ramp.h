// The stop ramp: from any measured motion to rest at a constant deceleration.
#ifndef HEADWAY_RAMP_H
#define HEADWAY_RAMP_H

#include <stdbool.h>
#include <stdint.h>

// Positions are continued in 1/65536 pq, so that slow ramps do not stall on rounding.
struct ramp {
    int64_t position_q16;
    int64_t velocity_q16; // per servo period
    int32_t torque_tq, end_torque_tq;
    bool begun, resting;
};

// `velocity_pq` per servo period; the torque goes from `torque_tq` to `end_torque_tq`.
void ramp_start(struct ramp *ramp, int32_t position_pq, int32_t velocity_pq, int32_t torque_tq,
                int32_t end_torque_tq);

// One servo period, in the middle of which it has the mean speed: slows down by `deceleration_q16` (1/65536 pq per period squared, > 0) and takes
// the torque on by at most `torque_step_tq`. Rests when both have arrived.
void ramp_step(struct ramp *ramp, int32_t deceleration_q16, int32_t torque_step_tq);

// Position modulo 2^32 pq, as a track's points are.
int32_t ramp_position_pq(const struct ramp *ramp);
int32_t ramp_velocity_pq(const struct ramp *ramp);

#endif
