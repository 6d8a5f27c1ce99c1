// The servo: PID on the following error, velocity and torque feed-forward, torque to PWM duty.
//
// Quanta: positions in 1/1024 of an encoder count (`_pq`), torques in a quantum the host chooses so
// that the limit lies between 2^20 and 2^25 (`_tq`; 1 uNm on small machines), duty in 1/32768.
#ifndef HEADWAY_SERVO_H
#define HEADWAY_SERVO_H

#include "fixed.h"
#include <stdbool.h>
#include <stdint.h>

#define SERVO_COUNT_BITS 10   // 1 count = 2^10 pq
#define SERVO_INTEGRAL_BITS 6 // the integral is held in tq / 2^6
#define SERVO_TORQUE_MAX (1 << 25)
#define SERVO_DUTY_MAX 32767
#define SERVO_FILTER_PERIODS 8
#define SERVO_FEEDBACK_FREE (1 << 30) // a feedback limit that never acts

// In each of these what every period reads comes first, and flags are words: a small core reads words
// within 128 bytes of a pointer at no cost, halfwords within 64, bytes within 32.
struct servo_settings {
    struct scale emf_tq;          // torque that the back-EMF adds per error difference [tq/pq]
    struct scale resistance_mV;   // voltage per torque: R / (Kt gear) [mV/tq]
    struct scale supply_duty;     // duty per voltage: 1 / supply [1/mV]
    int32_t torque_limit_tq;      // output ceiling, <= SERVO_TORQUE_MAX
    struct scale emf_mV;          // voltage per speed of the track: Ke gear [mV knot/pq]
    struct scale velocity_tq;     // torque per speed of the track [tq knot/pq]
    uint16_t ahead_us;            // so far ahead along the tracks feed-forward is taken
    struct scale acceleration_tq; // torque per acceleration of the track [tq knot^2/pq]
    struct scale kp_tq;           // torque per following error [tq/pq]
    struct scale ki_tq;           // torque / 2^6 per error and servo period [tq/pq]
    struct scale kd_tq;           // torque per error difference over one servo period [tq/pq]
    bool integrate_running;       // else the integral rests while a plan runs
};

// What the tracks ask for at this instant.
struct setpoint {
    struct scale kp, ki, kd; // from the gain tracks, or the settings
    int32_t position_pq;
    int32_t velocity_pq; // per knot interval
    int32_t torque_tq;
    int32_t feedback_limit_tq; // of what the gains and the back-EMF add up to
    int32_t integrate;         // or not: 0
};

struct servo {
    int32_t primed;      // `error_pq` is valid, or not: 0
    int32_t velocity_pq; // of the track, as ...
    int32_t forward_tq;  // ... what it asks for ...
    int32_t forward_mV;  // ... was made of it
    int32_t error_pq;
    int32_t integral;       // tq / 2^6
    int32_t difference_sum; // of error differences, a first-order low-pass over 8 periods
    int32_t feedback_tq;    // what the gains make of the error
    int32_t unclipped_tq;   // what is asked for, back-EMF's share included
    int32_t torque_tq;      // after the ceiling
    int32_t clipped;        // torque ceiling reached, or not: 0
    int32_t saturated;      // that, or the voltage, or not: 0
    int32_t effort_tq;      // magnitudes of torques, summed since their heat was judged
};

// Where an encoder count is: exact for counts within +-2^20; beyond, modulo 2^32 pq for an axis that
// turns for ever, else at the end of that range.
int32_t servo_position_pq(int32_t encoder_count, bool continuous);

// One servo period: returns the duty.
int32_t servo_step(const struct servo_settings *settings, struct servo *servo,
                   const struct setpoint *setpoint, int32_t measured_pq);

#endif
