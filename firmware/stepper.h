// The stepper: step and direction pulses that take an axis along its setpoint, without feedback.
//
// One encoder count is one step. Each servo period gives the pulses of a window, which begins where the
// last one ended: the setpoint goes straight through it, and a pulse comes where it passes half-way
// between two steps. So what has been given is within half a step of that line at all times, within a
// step of the curve, and what one window leaves over the next one has. From a pulse to the next, whatever
// the directions, there is never less than the settings' time.
#ifndef HEADWAY_STEPPER_H
#define HEADWAY_STEPPER_H

#include <stdint.h>

struct stepper {
    int32_t count;      // steps that were given, modulo 2^32
    int32_t target_pq;  // setpoint at the end of the last window ...
    int32_t now_pq;     // ... and at its begin
    uint32_t since_q16; // from the last pulse to the end of that window [1/65536 us], or more
};

// Of a window: the first comes so long after its begin [1/65536 us], then one each `spacing_q16`.
struct pulses {
    int32_t steps; // below 0: backwards
    uint32_t first_q16, spacing_q16;
};

// Stands still at a position.
void stepper_begin(struct stepper *stepper, int32_t position_pq);

// The same place has another number.
void stepper_shift(struct stepper *stepper, int32_t by_count);

// One window, at whose end the setpoint is `target_pq`. `least_q16` > 0; `window_us` below 2^15.
struct pulses stepper_step(struct stepper *stepper, uint32_t least_q16, int32_t target_pq,
                           uint32_t window_us);

#endif
