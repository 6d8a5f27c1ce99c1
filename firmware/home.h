// Homing and jogging: local tasks of an armed device, with low limits of their own.
//
// An axis whose encoder does not know where it is at power-up looks for a mark: it moves slowly in
// one direction until the index pulse, the home switch, or a stop that it pushes against with little
// torque. There the mark's position is taken for its own, and it comes to rest. The switch's mark is
// where it goes on: an axis that begins on it backs off first.
#ifndef HEADWAY_HOME_H
#define HEADWAY_HOME_H

#include "fixed.h"
#include <stdbool.h>
#include <stdint.h>

enum home_method {
    HOME_NONE,   // the encoder knows where it is
    HOME_INDEX,  // the encoder's index pulse
    HOME_SWITCH, // the home switch goes on
    HOME_STOP,   // a mechanical stop: no way at the task's torque
    HOME_METHODS,
};

struct home_settings {
    uint8_t method;           // enum home_method
    bool backwards;           // the direction of the search
    int32_t mark_count;       // the position of the mark
    int32_t speed_q16;        // of homing and jogging at most, 1/65536 pq per servo period
    int32_t acceleration_q16; // 1/65536 pq per period squared
    int32_t torque_tq;        // of homing and jogging, beyond the holding torque
    int32_t way_counts;       // of a search at most
    uint16_t still_periods;   // at the torque without a count: the stop is reached
};

enum task { TASK_NONE, TASK_HOME, TASK_JOG };
enum task_result { TASK_RUNS, TASK_DONE, TASK_FAILED };

struct home {
    uint8_t task;         // enum task
    bool found;           // the mark; what is left is to come to rest
    bool leaving;         // backs off the switch that it began on
    int32_t target_q16;   // speed asked for
    int32_t velocity_q16; // and as it is
    int64_t position_q16; // of the setpoint
    int32_t start_count, still_count;
    uint16_t still_periods;
    int32_t offset_count; // what the mark adds to the encoder's count
};

// Begins a task at rest. `speed_q16` of a jog is clamped to the settings' speed.
void home_begin(const struct home_settings *settings, struct home *home, enum task task,
                int32_t position_pq, int32_t count, int32_t speed_q16);

// What a servo period saw.
struct home_marks {
    int32_t count; // of the encoder
    bool indexed;  // an index pulse came, at `index_count`
    int32_t index_count;
    bool on_switch;
    bool pushing; // the torque is at the task's limit
};

// One servo period: moves the setpoint, looks for the mark.
enum task_result home_step(const struct home_settings *settings, struct home *home,
                           const struct home_marks *marks);

int32_t home_position_pq(const struct home *home);
int32_t home_velocity_pq(const struct home *home);

#endif
