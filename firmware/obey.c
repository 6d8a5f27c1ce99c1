#include "obey.h"
#include "happen.h"
#include "store.h" // the settings
#include <string.h>

// What was planned, and why it stopped, belongs to the past.
static void begin_epoch(struct device *device, uint16_t epoch) {
    memset(&device->status.fault, 0, sizeof device->status.fault);
    device->status.epoch = epoch;
}

static enum command_result arm(struct device *device, const struct board *board,
                               const struct command *command) {
    int32_t limit_tq = device->settings.servo.torque_limit_tq;
    if (device->state != DEVICE_IDLE || board_stop_line(board))
        return COMMAND_NOT_NOW;
    if (command->argument > limit_tq || command->argument < -limit_tq ||
        command->epoch == device->status.epoch) // plans from before could still arrive
        return COMMAND_BAD;
    if (!device->status.homed && device->settings.home.method == HOME_NONE)
        return COMMAND_UNHOMED;
    if (!device_at_rest(device))
        return COMMAND_MOVING;
    if (!device->sync.settled)
        return COMMAND_UNSYNCED;
    device->hold_tq = command->argument;
    begin_epoch(device, command->epoch);
    happen(device, EVENT_ARM);
    return COMMAND_DONE;
}

static enum command_result resume(struct device *device, const struct command *command) {
    if (device->state != DEVICE_HOLD)
        return COMMAND_NOT_NOW;
    if (command->epoch == device->status.epoch) // plans from before could still arrive
        return COMMAND_BAD;
    if (!device->sync.settled)
        return COMMAND_UNSYNCED;
    begin_epoch(device, command->epoch);
    happen(device, EVENT_RESUME);
    return COMMAND_DONE;
}

// Whether it knows where it is once the fault is cleared.
static bool stays_homed(const struct device *device) {
    return device->settings.home.method == HOME_NONE || (device->status.homed && device->trusted);
}

// What can be seen of a fault's cause. Of an encoder's nothing can: it has to be homed again.
static bool cause_remains(const struct device *device, const struct board *board) {
    const struct monitor_settings *settings = &device->settings.monitor;
    int32_t supply_mV = board_supply_mV(board);
    return !settings_valid(&device->settings) || supply_mV < settings->supply_min_mV ||
           supply_mV > settings->supply_max_mV ||
           (stays_homed(device) && !monitor_inside(settings, device->position_pq)) ||
           device->watch.monitor.overload >> 16 > settings->overload / 2 ||
           device->watch.monitor.rise_q16 > settings->rise_q16 / 8 * 7;
}

static enum command_result clear(struct device *device, const struct board *board) {
    if (device->state != DEVICE_FAULT && device->state != DEVICE_ESTOP)
        return COMMAND_NOT_NOW;
    if (device->power || !device_at_rest(device))
        return COMMAND_MOVING;
    if (board_stop_line(board) || cause_remains(device, board))
        return COMMAND_CAUSE;
    device->status.homed = stays_homed(device);
    device->trusted = true;
    device->guard.verdict = GUARD_LETS;
    happen(device, EVENT_CLEAR);
    return COMMAND_DONE;
}

static enum command_result begin_task(struct device *device, struct board *board, enum task task,
                                      int32_t speed_q16) {
    struct home *home = &device->home;
    if (device->state != DEVICE_ARMED)
        return COMMAND_NOT_NOW;
    if (task == TASK_HOME && device->settings.home.method == HOME_NONE)
        return COMMAND_BAD;
    if (home->task == TASK_JOG && task == TASK_JOG) { // on the way: another speed
        home->target_q16 = fixed_clamp(speed_q16, device->settings.home.speed_q16);
        return COMMAND_DONE;
    }
    if (home->task != TASK_NONE)
        return COMMAND_MOVING;
    int32_t passed_count;
    board_index(board, &passed_count); // a pulse from before the search is no mark
    home_begin(&device->settings.home, home, task, device->hold_pq, device->encoder_count,
               speed_q16);
    return COMMAND_DONE;
}

static enum command_result set_zero(struct device *device, int32_t position_count) {
    if (device->state != DEVICE_IDLE && device->state != DEVICE_UNSYNCED)
        return COMMAND_NOT_NOW;
    if (device->power || !device_at_rest(device))
        return COMMAND_MOVING;
    bool continuous = device->settings.limits[TRACK_POSITION].continuous;
    if (servo_position_pq(position_count, continuous) >> SERVO_COUNT_BITS != position_count)
        return COMMAND_BAD; // it could not be told from others
    device->offset_count = fixed_difference(position_count, device->encoder_count);
    device->settings.offset_count = device->offset_count;
    device_locate(device);
    device->status.homed = true;
    return COMMAND_DONE;
}

static enum command_result stop(struct device *device, const struct board *board) {
    struct breach asked = {REASON_HOST, 0, 0};
    enum device_state before = device->state;
    happen_breach(device, asked, board_count_us(board));
    return device->state != before ? COMMAND_DONE : COMMAND_NOT_NOW;
}

static enum command_result save(const struct device *device, struct board *board) {
    if (device->power)
        return COMMAND_NOT_NOW;
    return store_save_settings(board, &device->settings) ? COMMAND_DONE : COMMAND_FAILED;
}

static enum command_result carry_out(struct device *device, struct board *board,
                                     const struct command *command) {
    switch (command->kind) {
    case COMMAND_ARM:
        return arm(device, board, command);
    case COMMAND_DISARM:
        if (device->home.task != TASK_NONE)
            return COMMAND_MOVING;
        return happen(device, EVENT_DISARM) ? COMMAND_DONE : COMMAND_NOT_NOW;
    case COMMAND_RESUME:
        return resume(device, command);
    case COMMAND_STOP:
        return stop(device, board);
    case COMMAND_CLEAR:
        return clear(device, board);
    case COMMAND_HOME:
        return begin_task(device, board, TASK_HOME, 0);
    case COMMAND_JOG:
        return begin_task(device, board, TASK_JOG, command->argument);
    case COMMAND_ZERO:
        return set_zero(device, command->argument);
    case COMMAND_SAVE:
        return save(device, board);
    case COMMAND_FAULTS: // answered by a frame of its own
        return COMMAND_DONE;
    default:
        return COMMAND_BAD;
    }
}

void obey(struct device *device, struct board *board, const struct command *command) {
    if (command->number <= device->status.command_number)
        return;
    device->status.command_number = command->number;
    device->status.command_result = (uint8_t)carry_out(device, board, command);
}

void obey_stop(struct device *device, const struct board *board) { stop(device, board); }
