// Replays stepper-*: windows of pulses along a setpoint.
#include "stepper.h"
#include "judge.h"

static struct stepper stepper;

static void say_stepper(void) {
    say_number("count", stepper.count);
    say_number("target_pq", stepper.target_pq);
    say_number("now_pq", stepper.now_pq);
    say_number("since_q16", stepper.since_q16);
}

static void replay_stepper(void) {
    stepper = (struct stepper){0};
    stepper_begin(&stepper, (int32_t)given("position_pq"));
    say_stepper();
}

static void replay_stepper_shift(void) {
    stepper_shift(&stepper, (int32_t)given("by_count"));
    say_stepper();
}

static void replay_stepper_step(void) {
    struct pulses pulses = stepper_step(&stepper, (uint32_t)given("least_q16"),
                                        (int32_t)given("target_pq"), (uint32_t)given("window_us"));
    say_number("steps", pulses.steps);
    say_number("first_q16", pulses.first_q16);
    say_number("spacing_q16", pulses.spacing_q16);
    say_stepper();
}

const struct word stepper_words[] = {
    {"stepper", replay_stepper},
    {"stepper-shift", replay_stepper_shift},
    {"stepper-step", replay_stepper_step},
    {0, 0},
};
