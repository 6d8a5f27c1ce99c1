#include "servo.h"
#include "near.h"

#define TERM_BITS 27 // each of a few terms is within it, so that their sum cannot overflow
#define STEP_BITS 28
#define VOLTAGE_BITS 20
#define DUTY_BITS 17 // beyond all that a duty can be

// Integration stops while the output is saturated in the error's direction (conditional
// integration: Astrom and Hagglund, Advanced PID Control, 2006, section 3.5).
static void integrate(struct servo *servo, const struct setpoint *setpoint, int32_t error_pq,
                      int32_t limit_tq) {
    bool pushes = (error_pq > 0) == (servo->unclipped_tq > 0);
    if (servo->saturated && pushes)
        return;
    int32_t limit =
        limit_tq >= SERVO_TORQUE_MAX ? INT32_MAX : limit_tq * (1 << SERVO_INTEGRAL_BITS);
    int32_t step = fixed_scale_small(error_pq, setpoint->ki, STEP_BITS);
    servo->integral = fixed_add(servo->integral, step, limit);
}

// What the track's speed asks for. Of no speed it is nothing, as of a servo that begins.
static APART void lead(const struct servo_settings *settings, struct servo *servo,
                       int32_t velocity_pq) {
    servo->velocity_pq = velocity_pq;
    servo->forward_tq = 0;
    if (settings->velocity_tq.mantissa != 0)
        servo->forward_tq = fixed_scale_less(velocity_pq, settings->velocity_tq, TERM_BITS);
    servo->forward_mV = fixed_scale_less(velocity_pq, settings->emf_mV, VOLTAGE_BITS);
}

int32_t servo_position_pq(int32_t encoder_count, bool continuous) {
    if (!continuous)
        encoder_count = fixed_clamp(encoder_count, (1 << (30 - SERVO_COUNT_BITS)) - 1);
    return (int32_t)((uint32_t)encoder_count << SERVO_COUNT_BITS);
}

int32_t servo_step(const struct servo_settings *settings, struct servo *servo,
                   const struct setpoint *setpoint, int32_t measured_pq) {
    int32_t error_pq = fixed_difference(setpoint->position_pq, measured_pq);
    if (error_pq != (int16_t)error_pq) // so that no sum of differences overflows
        error_pq = fixed_clamp(error_pq, (1 << 29) - 1);
    int32_t difference_pq = servo->primed ? error_pq - servo->error_pq : 0;
    servo->error_pq = error_pq;
    servo->primed = true;
    if (setpoint->integrate)
        integrate(servo, setpoint, error_pq, settings->torque_limit_tq);

    // The voltage is set for the track's speed, so a speed error meets the back-EMF: a torque of its
    // own, which counts against the ceiling.
    servo->difference_sum += difference_pq - servo->difference_sum / SERVO_FILTER_PERIODS;
    int32_t emf_tq = fixed_scale_small(servo->difference_sum / SERVO_FILTER_PERIODS,
                                       settings->emf_tq, TERM_BITS);
    int32_t feedback_tq = fixed_scale_small(error_pq, setpoint->kp, TERM_BITS) +
                          fixed_scale_small(difference_pq, setpoint->kd, TERM_BITS) +
                          (servo->integral >> SERVO_INTEGRAL_BITS);
    servo->feedback_tq = fixed_clamp(feedback_tq + emf_tq, setpoint->feedback_limit_tq) - emf_tq;
    if (setpoint->velocity_pq != servo->velocity_pq)
        lead(settings, servo, setpoint->velocity_pq);
    servo->unclipped_tq = servo->feedback_tq + servo->forward_tq +
                          fixed_within(setpoint->torque_tq, TERM_BITS) + emf_tq;
    servo->torque_tq = fixed_clamp(servo->unclipped_tq, settings->torque_limit_tq);

    int32_t voltage_mV =
        fixed_scale_less(servo->torque_tq - emf_tq, settings->resistance_mV, VOLTAGE_BITS) +
        servo->forward_mV;
    int32_t duty = fixed_scale_small(voltage_mV, settings->supply_duty, DUTY_BITS);
    servo->clipped = servo->torque_tq != servo->unclipped_tq;
    int32_t limited = fixed_clamp(duty, SERVO_DUTY_MAX);
    servo->saturated = servo->clipped || limited != duty;
    return limited;
}
