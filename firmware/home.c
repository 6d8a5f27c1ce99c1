#include "home.h"

static int32_t search_q16(const struct home_settings *settings) {
    return settings->backwards ? -settings->speed_q16 : settings->speed_q16;
}

void home_begin(const struct home_settings *settings, struct home *home, enum task task,
                int32_t position_pq, int32_t count, int32_t speed_q16) {
    home->task = task;
    home->found = false;
    home->leaving = settings->method == HOME_SWITCH; // until the switch is seen off
    home->target_q16 =
        task == TASK_HOME ? search_q16(settings) : fixed_clamp(speed_q16, settings->speed_q16);
    home->velocity_q16 = 0;
    home->position_q16 = (int64_t)position_pq * (1 << 16);
    home->start_count = home->still_count = count;
    home->still_periods = 0;
}

static void look(const struct home_settings *settings, struct home *home,
                 const struct home_marks *marks) {
    if (marks->count != home->still_count || !marks->pushing) {
        home->still_count = marks->count;
        home->still_periods = 0;
    } else {
        home->still_periods++;
    }
    int32_t mark = marks->count;
    switch (settings->method) {
    case HOME_INDEX:
        home->found = marks->indexed;
        mark = marks->index_count;
        break;
    case HOME_SWITCH:
        home->leaving = home->leaving && marks->on_switch;
        home->target_q16 = home->leaving ? -search_q16(settings) : search_q16(settings);
        home->found = marks->on_switch && !home->leaving;
        break;
    default:
        home->found = home->still_periods >= settings->still_periods;
        break;
    }
    if (home->found) {
        home->offset_count = fixed_difference(settings->mark_count, mark);
        home->target_q16 = 0;
    }
}

enum task_result home_step(const struct home_settings *settings, struct home *home,
                           const struct home_marks *marks) {
    if (home->task == TASK_HOME && !home->found) {
        int32_t way = fixed_difference(marks->count, home->start_count);
        if (way > settings->way_counts || way < -settings->way_counts)
            return TASK_FAILED;
        look(settings, home, marks);
    }
    home->velocity_q16 +=
        fixed_clamp(home->target_q16 - home->velocity_q16, settings->acceleration_q16);
    home->position_q16 += home->velocity_q16;
    return home->target_q16 == 0 && home->velocity_q16 == 0 ? TASK_DONE : TASK_RUNS;
}

int32_t home_position_pq(const struct home *home) {
    return (int32_t)(uint32_t)(uint64_t)(home->position_q16 >> 16);
}

int32_t home_velocity_pq(const struct home *home) { return home->velocity_q16 >> 16; }
