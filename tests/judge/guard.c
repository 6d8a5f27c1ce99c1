// Replays guard-*: what a board's timer does beside the main loop.
#include "guard.h"
#include "device.h"
#include "judge.h"
#include "rack.h"

static struct device device, usual; // of the latter, the settings
static struct guard *const guard = &device.guard;
static struct board board;

static void take_settings(struct device_settings *settings) {
    if (is_given("servo_period_us"))
        settings->servo_period_us = (uint16_t)given("servo_period_us");
    if (is_given("brake_periods"))
        settings->brake_periods = (uint16_t)given("brake_periods");
    if (is_given("stop_us"))
        settings->stop_us = (uint32_t)given("stop_us");
    if (is_given("late_us"))
        settings->monitor.late_us = (uint32_t)given("late_us");
}

static void replay_guard_usual(void) { take_settings(&usual.settings); }

static void replay_guard(void) {
    device = usual;
    take_settings(&device.settings);
    board = (struct board){0};
}

// As if the main loop had set them just before.
static void set_outputs(void) {
    board.power = true;
    board.brake = false;
    board.duty_q15 = 99;
}

static void say_outputs(void) {
    say_number("power", board.power);
    say_number("brake", board.brake);
    say_number("duty_q15", board.duty_q15);
}

// What a call does not name is as at the one before.
static void replay_guard_call(void) {
    board.count_us = (uint32_t)given("count_us");
    if (is_given("power"))
        device.power = given("power") != 0;
    if (is_given("state"))
        device.state = (enum device_state)given("state");
    if (is_given("next_servo_us"))
        device.next_servo_us = (uint32_t)given("next_servo_us");
    if (is_given("stop_count_us"))
        device.stop_count_us = (uint32_t)given("stop_count_us");
    if (is_given("line_open"))
        board.line_open = given("line_open") != 0;
    take_settings(&device.settings);
    set_outputs();
    device_guard(&device, &board);
    say_number("verdict", guard->verdict);
    say_outputs();
    if (guard->verdict != GUARD_LETS) {
        say_number("overdue_us", guard->overdue_us);
        say_number("limit_us", guard->limit_us);
    }
}

static void replay_guard_assert(void) {
    set_outputs();
    guard_assert(guard, &board);
    say_outputs();
}

static void replay_guard_release(void) { guard->verdict = GUARD_LETS; }

const struct word guard_words[] = {
    {"guard-usual", replay_guard_usual},     {"guard", replay_guard},
    {"guard-call", replay_guard_call},       {"guard-assert", replay_guard_assert},
    {"guard-release", replay_guard_release}, {0, 0},
};
