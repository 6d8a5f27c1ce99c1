#include "guard.h"
#include "device.h"

// Nothing that flows: brake on, no duty. Which comes first is no matter, both take their time.
static void stop(struct board *board, bool off) {
    board_set_duty(board, 0);
    board_set_brake(board, true);
    if (off)
        board_set_power(board, false);
}

void guard_assert(const struct guard *guard, struct board *board) {
    enum guard_verdict verdict = guard->verdict;
    if (verdict != GUARD_LETS)
        stop(board, verdict == GUARD_OFF);
}

static uint32_t brake_us(const struct device_settings *settings) {
    return (uint32_t)settings->brake_periods * settings->servo_period_us;
}

// From a fault or the emergency line to the output off. The servo begins to brake in the first period
// that is not before stop_us, which may be polled a little late.
static int64_t stop_limit_us(const struct device_settings *settings) {
    return (int64_t)settings->stop_us + brake_us(settings) + 2 * settings->servo_period_us;
}

// Trips if it has been longer than the limit. A time that is yet to come is negative.
static void judge(struct guard *guard, uint32_t count_us, uint32_t since_count_us,
                  int64_t limit_us) {
    int32_t elapsed_us = (int32_t)(count_us - since_count_us);
    if (elapsed_us <= limit_us)
        return;
    guard->trip_count_us = count_us;
    guard->overdue_us = elapsed_us;
    guard->limit_us = (int32_t)limit_us; // below the time elapsed
    guard->verdict = GUARD_BRAKES;
}

static void judge_all(struct guard *guard, const struct device *device, uint32_t count_us) {
    const struct device_settings *settings = &device->settings;
    int64_t limit_us = stop_limit_us(settings);
    guard->brake_us = brake_us(settings);
    // The servo sees the line up to a period after the guard.
    judge(guard, count_us, guard->closed_count_us, limit_us + settings->servo_period_us);
    if (device->state >= DEVICE_FAULT)
        judge(guard, count_us, device->stop_count_us, limit_us);
    judge(guard, count_us, device->next_servo_us, settings->monitor.late_us);
}

void device_guard(struct device *device, struct board *board) {
    struct guard *guard = &device->guard;
    uint32_t count_us = board_count_us(board);
    if (!device->power) { // what is off stays off, also if the main loop hung before it said so
        guard->closed_count_us = count_us;
        stop(board, true);
        return;
    }
    if (!board_stop_line(board))
        guard->closed_count_us = count_us;
    if (guard->verdict == GUARD_LETS)
        judge_all(guard, device, count_us);
    if (guard->verdict == GUARD_BRAKES && count_us - guard->trip_count_us >= guard->brake_us)
        guard->verdict = GUARD_OFF;
    guard_assert(guard, board);
}
