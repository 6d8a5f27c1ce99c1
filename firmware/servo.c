#include "servo.h"

// A sum of a few saturated terms, each clamped so that the sum cannot overflow.
static int32_t bounded(int32_t torque_tq) { return fixed_clamp(torque_tq, 1 << 27); }

// Integration stops while the output is saturated in the error's direction (conditional
// integration: Astrom and Hagglund, Advanced PID Control, 2006, section 3.5).
static void integrate(struct servo *servo, const struct setpoint *setpoint, int32_t error_pq,
                      int32_t limit_tq) {
    bool pushes = (error_pq > 0) == (servo->unclipped_tq > 0);
    if (servo->saturated && pushes)
        return;
    int32_t limit =
        limit_tq >= SERVO_TORQUE_MAX ? INT32_MAX : limit_tq * (1 << SERVO_INTEGRAL_BITS);
    int32_t step = fixed_clamp(fixed_scale(error_pq, setpoint->ki), 1 << 28);
    int64_t sum = (int64_t)servo->integral + step;
    servo->integral = sum > limit ? limit : sum < -limit ? -limit : (int32_t)sum;
}

int32_t servo_position_pq(int32_t encoder_count, bool continuous) {
    if (!continuous)
        encoder_count = fixed_clamp(encoder_count, (1 << (30 - SERVO_COUNT_BITS)) - 1);
    return (int32_t)((uint32_t)encoder_count << SERVO_COUNT_BITS);
}

int32_t servo_step(const struct servo_settings *settings, struct servo *servo,
                   const struct setpoint *setpoint, int32_t measured_pq) {
    int32_t error_pq = fixed_difference(setpoint->position_pq, measured_pq);
    error_pq = fixed_clamp(error_pq, (1 << 29) - 1); // so that no sum of differences overflows
    int32_t difference_pq = servo->primed ? error_pq - servo->error_pq : 0;
    servo->error_pq = error_pq;
    servo->primed = true;
    if (setpoint->integrate)
        integrate(servo, setpoint, error_pq, settings->torque_limit_tq);

    // The voltage is set for the track's speed, so a speed error meets the back-EMF: a torque of its
    // own, which counts against the ceiling.
    servo->difference_sum += difference_pq - servo->difference_sum / SERVO_FILTER_PERIODS;
    int32_t emf_tq =
        bounded(fixed_scale(servo->difference_sum / SERVO_FILTER_PERIODS, settings->emf_tq));
    int32_t feedback_tq = bounded(fixed_scale(error_pq, setpoint->kp)) +
                          bounded(fixed_scale(difference_pq, setpoint->kd)) +
                          (servo->integral >> SERVO_INTEGRAL_BITS);
    servo->feedback_tq = fixed_clamp(feedback_tq + emf_tq, setpoint->feedback_limit_tq) - emf_tq;
    servo->unclipped_tq = servo->feedback_tq +
                          bounded(fixed_scale(setpoint->velocity_pq, settings->velocity_tq)) +
                          bounded(setpoint->torque_tq) + emf_tq;
    servo->torque_tq = fixed_clamp(servo->unclipped_tq, settings->torque_limit_tq);

    int32_t voltage_mV =
        fixed_clamp(fixed_scale(servo->torque_tq - emf_tq, settings->resistance_mV), 1 << 20) +
        fixed_clamp(fixed_scale(setpoint->velocity_pq, settings->emf_mV), 1 << 20);
    int32_t duty = fixed_scale(voltage_mV, settings->supply_duty);
    servo->saturated =
        servo->torque_tq != servo->unclipped_tq || duty > SERVO_DUTY_MAX || duty < -SERVO_DUTY_MAX;
    return fixed_clamp(duty, SERVO_DUTY_MAX);
}
