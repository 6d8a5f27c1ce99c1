// Replays servo-*: from setpoint and measured position to duty.
#include "servo.h"
#include "judge.h"

#define SCALES(X)                                                                                  \
    X(settings, kp_tq)                                                                             \
    X(settings, ki_tq)                                                                             \
    X(settings, kd_tq)                                                                             \
    X(settings, velocity_tq)                                                                       \
    X(settings, resistance_mV)                                                                     \
    X(settings, emf_mV)                                                                            \
    X(settings, emf_tq)                                                                            \
    X(settings, supply_duty)                                                                       \
    X(setpoint, kp)                                                                                \
    X(setpoint, ki)                                                                                \
    X(setpoint, kd)

static struct servo_settings usual_settings, settings;
static struct setpoint usual_setpoint, setpoint;
static struct servo servo;
static int32_t measured_pq;

static void take(void) {
#define TAKE_SCALE(of, name)                                                                       \
    if (is_given(#name)) {                                                                         \
        int32_t v[2] = {0};                                                                        \
        given_list(#name, v, 2);                                                                   \
        of.name = (struct scale){(uint16_t)v[0], (uint8_t)v[1]};                                   \
    }
    SCALES(TAKE_SCALE)
    if (is_given("torque_limit_tq"))
        settings.torque_limit_tq = (int32_t)given("torque_limit_tq");
    if (is_given("position_pq"))
        setpoint.position_pq = (int32_t)given("position_pq");
    if (is_given("velocity_pq"))
        setpoint.velocity_pq = (int32_t)given("velocity_pq");
    if (is_given("torque_tq"))
        setpoint.torque_tq = (int32_t)given("torque_tq");
    if (is_given("feedback_limit_tq"))
        setpoint.feedback_limit_tq = (int32_t)given("feedback_limit_tq");
    if (is_given("integrate"))
        setpoint.integrate = given("integrate") != 0;
    if (is_given("measured_pq"))
        measured_pq = (int32_t)given("measured_pq");
}

static void replay_servo_usual(void) {
    take();
    usual_settings = settings;
    usual_setpoint = setpoint;
}

static void replay_servo(void) {
    settings = usual_settings;
    setpoint = usual_setpoint;
    servo = (struct servo){0};
    measured_pq = 0;
    take();
}

static void replay_servo_step(void) {
    take();
    int32_t duty = 0;
    for (int64_t times = is_given("times") ? given("times") : 1; times > 0; times--)
        duty = servo_step(&settings, &servo, &setpoint, measured_pq);
    say_number("duty_q15", duty);
    say_number("torque_tq", servo.torque_tq);
    say_number("unclipped_tq", servo.unclipped_tq);
    say_number("feedback_tq", servo.feedback_tq);
    say_number("error_pq", servo.error_pq);
    say_number("integral", servo.integral);
}

static void replay_servo_position(void) {
    say_number("position_pq", servo_position_pq((int32_t)given("count"), given("continuous") != 0));
}

const struct word servo_words[] = {
    {"servo-usual", replay_servo_usual},
    {"servo", replay_servo},
    {"servo-step", replay_servo_step},
    {"servo-position", replay_servo_position},
    {0, 0},
};
