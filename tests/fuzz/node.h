// A device that follows a plan, and the end of its session that the host has: what a fuzz target
// begins with, copied for each input.
#ifndef HEADWAY_FUZZ_NODE_H
#define HEADWAY_FUZZ_NODE_H

#include "board.h"
#include "command.h"
#include "store.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PROMISE(condition)                                                                         \
    do {                                                                                           \
        if (!(condition)) {                                                                        \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition);                \
            abort();                                                                               \
        }                                                                                          \
    } while (0)

#define FUZZ_SHIFT 12
#define FUZZ_POLL_US 250

struct host {
    struct session session;
    struct stamps stamps;
    uint32_t number, commands;
};

static const uint8_t fuzz_key[2][SIPHASH_KEY_BYTES] = {{1, 2, 3}, {4, 5, 6}};

static inline struct device_settings fuzz_settings(void) {
    struct device_settings s = {
        .name = "fuzz",
        .knot_shift = FUZZ_SHIFT,
        .servo_period_us = 1000,
        .sample_every = 2,
        .brake_periods = 5,
        .stop_us = 300000,
        .sync_lost_us = 400000,
        .torque_step_tq = 1 << 18,
        .knot_periods = {4194, 10},
        .carries_gravity = true,
        .servo = {.kp_tq = {1, 2},
                  .ki_tq = {1, 0},
                  .kd_tq = {300, 3},
                  .resistance_mV = {1, 10},
                  .emf_tq = {20, 4},
                  .supply_duty = {1, 0},
                  .velocity_tq = {3, 3},
                  .acceleration_tq = {5, 1},
                  .torque_limit_tq = 1 << 24,
                  .ahead_us = 700},
        .monitor = {.following_pq = 1 << 28,
                    .following_periods = 20,
                    .speed_pq = 1 << 26,
                    .bounded = true,
                    .low_pq = -(1 << 29),
                    .high_pq = 1 << 29,
                    .deceleration_q16 = 1 << 22,
                    .torque_periods = 1000,
                    .load_q8 = {1, 16},
                    .overload = 9000,
                    .heating_q16 = 279,
                    .rise_q16 = 72090,
                    .stuck_pq = 1 << 30,
                    .stuck_periods = 1000,
                    .spike_counts = 100000,
                    .supply_min_mV = 16000,
                    .supply_max_mV = 30000,
                    .chopper_mV = 27000,
                    .late_us = 4000},
        .home = {.speed_q16 = 40 << 16,
                 .acceleration_q16 = 1 << 16,
                 .torque_tq = 1 << 20,
                 .way_counts = 400,
                 .still_periods = 50},
        .sync = {.drift_ppm = 200,
                 .wander_ppb_s = 1000,
                 .limit_us = 40000,
                 .average = {16000, 4000, 10000}},
    };
    s.limits[TRACK_POSITION] = (struct gate_limits){.point_min = -(1 << 27),
                                                    .point_max = 1 << 27,
                                                    .difference_max = 1 << 20,
                                                    .second_difference_max = 1 << 18,
                                                    .stop_difference = 1 << 16};
    s.limits[TRACK_TORQUE] = (struct gate_limits){.point_min = -(1 << 20),
                                                  .point_max = 1 << 20,
                                                  .difference_max = 1 << 21,
                                                  .second_difference_max = 1 << 22};
    for (int32_t sink = TRACK_KP; sink <= TRACK_KD; sink++)
        s.limits[sink] = (struct gate_limits){
            .point_max = 1 << 20, .difference_max = 1 << 18, .second_difference_max = 1 << 18};
    for (int32_t sink = TRACK_TORQUE; sink <= TRACK_KD; sink++)
        s.gap_policy[sink] = GAP_HOLD;
    return s;
}

static inline void fuzz_send(struct host *host, struct board *board, enum frame_type type,
                             uint8_t *frame, int32_t size) {
    uint8_t packet[COBS_BOUND(FRAME_MAX)];
    int32_t sealed = size < 0 ? -1 : frame_seal(&host->session, type, frame, size);
    if (sealed > 0)
        board_deliver(board, BOARD_HOST, board->true_us, packet,
                      cobs_encode(frame, sealed, packet));
}

static inline void fuzz_poll(struct node *node) {
    board_advance(&node->board, node->board.true_us + FUZZ_POLL_US);
    node_run(node);
    for (int32_t i = 0; i < BOARD_OUTBOX; i++)
        node->board.outbox[i].size = 0;
}

static inline void fuzz_command(struct host *host, struct board *board, enum command_kind kind,
                                int32_t argument, uint16_t epoch) {
    uint8_t frame[FRAME_MAX];
    struct command command = {++host->commands, (uint8_t)kind, argument, epoch};
    fuzz_send(host, board, FRAME_COMMAND, frame,
              command_encode(&command, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX));
}

static inline void fuzz_sync(struct host *host, struct board *board) {
    uint8_t frame[FRAME_MAX];
    struct stamps stamps = {.echo_us = board_count_us(board),
                            .received_us = board->true_us + 1,
                            .sent_us = board->true_us,
                            .mark = {0, MARK_OPEN, 0}};
    fuzz_send(host, board, FRAME_SYNC, frame,
              sync_encode(&stamps, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX));
}

static inline void fuzz_plan(struct host *host, struct node *node, const struct plan *plan) {
    uint8_t frame[FRAME_MAX];
    struct stamps stamps = {.sent_us = node->device.clock.system_us, .mark = {0, MARK_OPEN, 0}};
    fuzz_send(host, &node->board, FRAME_PLAN, frame,
              plan_encode(&stamps, plan, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX));
}

// From power-up to a device in RUNNING, at rest in its first plan.
static inline void fuzz_begin(struct node *node, struct host *host) {
    static struct plan plan;
    struct device_settings settings = fuzz_settings();
    memset(node, 0, sizeof *node);
    memset(host, 0, sizeof *host);
    PROMISE(settings_valid(&settings));
    node->board.true_us = 1000000;
    PROMISE(oscillator_begin(&node->board.oscillator, 77, 0, 0, 1000, 1));
    node->board.supply_V = 24;
    PROMISE(store_save_settings(&node->board, &settings));
    device_boot(&node->device, &node->board, board_count_us(&node->board));
    session_begin(&node->device.session, 5, TO_HOST, fuzz_key[1], fuzz_key[0]);
    session_begin(&host->session, 5, TO_DEVICE, fuzz_key[0], fuzz_key[1]);
    for (int32_t i = 0; i < 8000 && node->device.state != DEVICE_IDLE; i++) {
        if (i % 16 == 0)
            fuzz_sync(host, &node->board);
        fuzz_poll(node);
    }
    PROMISE(node->device.state == DEVICE_IDLE);
    fuzz_command(host, &node->board, COMMAND_ARM, 0, 1);
    fuzz_poll(node);
    PROMISE(node->device.state == DEVICE_ARMED);
    plan = (struct plan){.number = ++host->number, .epoch = 1, .tracks = 31, .count = 40};
    plan.first_knot = (node->device.clock.system_us >> FUZZ_SHIFT) + GATE_LIVE_KNOTS + 1;
    for (int32_t i = 0; i < plan.count; i++)
        for (int32_t sink = TRACK_KP; sink <= TRACK_KD; sink++)
            plan.points[sink][i] = 1 << 15;
    fuzz_plan(host, node, &plan);
    for (int32_t i = 0; i < 80; i++)
        fuzz_poll(node);
    PROMISE(node->device.state == DEVICE_RUNNING);
}

// Whatever came in: what may move is within the limits.
static inline void fuzz_promise(const struct node *node) {
    const struct device *device = &node->device;
    const struct board *board = &node->board;
    PROMISE(device->state < DEVICE_STATES);
    PROMISE(board->duty_q15 <= SERVO_DUTY_MAX && board->duty_q15 >= -SERVO_DUTY_MAX);
    PROMISE(device->power || !board->power);
    PROMISE(device->guard.verdict == GUARD_LETS || (board->brake && board->duty_q15 == 0));
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        const struct track *track = &device->tracks[sink];
        const struct gate_limits *limits = &device->settings.limits[sink];
        if (!track->written)
            continue;
        int64_t before = track_point(track, track->end), step = 0;
        PROMISE(track_point(track, track->end - 1) == before);
        PROMISE(track_point(track, track->end - 2) == before);
        for (int32_t i = 0; i < 100; i++) { // backwards from its end
            int64_t point = track_point(track, track->end - i);
            int64_t change = fixed_difference((int32_t)before, (int32_t)point);
            PROMISE(limits->continuous ||
                    (point >= limits->point_min && point <= limits->point_max));
            PROMISE(llabs(change) <= limits->difference_max || limits->difference_max == 0);
            PROMISE(llabs(change - step) <= limits->second_difference_max);
            step = change;
            before = point;
        }
    }
}

#endif
