// Replays device-*: a whole device on the rack, by what its board sees of it.
#include "device.h"
#include "judge.h"
#include "rack.h"
#include <string.h>

#define KEPT 8     // devices that may be kept
#define TOLD_MAX 4 // packets that a line may tell
#define POLLS_MAX 4096
#define DUTIES 32 // of more polls than this the last duty alone is told

static struct bench {
    struct device device;
    struct board board;
} bench, kept[KEPT];

// What a line's polls did.
static struct {
    int32_t polls, sent, steps;
    int32_t power[POLLS_MAX], brake[POLLS_MAX], duty_q15[POLLS_MAX];
    struct rack_packet told[TOLD_MAX];
    uint64_t hash;
} seen;

// FNV-1a (Fowler, Noll and Vo) of 64 bits: no function of the firmware's.
static void fold_byte(uint8_t byte) { seen.hash = (seen.hash ^ byte) * 0x100000001b3u; }

static void fold(uint32_t value) {
    for (int32_t shift = 0; shift < 32; shift += 8)
        fold_byte((uint8_t)(value >> shift));
}

void rack_sent(int32_t port, const uint8_t *bytes, int32_t size) {
    struct rack_packet *packet = &seen.told[seen.sent++ % TOLD_MAX];
    fold((uint32_t)port);
    fold((uint32_t)size);
    for (int32_t i = 0; i < size; i++)
        fold_byte(bytes[i]);
    packet->port = port;
    packet->size = size;
    if (size > 0 && size <= RACK_PACKET_MAX)
        memcpy(packet->bytes, bytes, (size_t)size);
}

void rack_switched(int32_t output, int32_t value, uint32_t count_us) {
    fold((uint32_t)output);
    fold((uint32_t)value);
    fold(count_us);
}

void rack_stepped(uint32_t count_us, int32_t steps, uint32_t first_q16, uint32_t spacing_q16) {
    fold(count_us);
    fold((uint32_t)steps);
    fold(first_q16);
    fold(spacing_q16);
    seen.steps += steps;
}

void rack_interrupt(struct board *board) {
    board->line_open |= board->interrupt_opens;
    device_guard(&bench.device, board);
}

static void begin_line(void) {
    memset(&seen, 0, sizeof seen);
    seen.hash = 0xcbf29ce484222325u;
}

// The outputs as a poll leaves them.
static void note_outputs(void) {
    const struct board *board = &bench.board;
    seen.power[seen.polls] = board->power;
    seen.brake[seen.polls] = board->brake;
    seen.duty_q15[seen.polls++] = board->duty_q15;
    fold(board->power);
    fold(board->brake);
    fold((uint32_t)board->duty_q15);
    fold(board->chopper);
    for (int32_t i = 0; i < BOARD_PWM; i++)
        fold((uint32_t)board->pwm_q15[i]);
}

static void say_line(int32_t most) {
    const struct board *board = &bench.board;
    say_list("power", seen.power, seen.polls);
    say_list("brake", seen.brake, seen.polls);
    if (seen.polls <= DUTIES)
        say_list("duty_q15", seen.duty_q15, seen.polls);
    else
        say_number("last_q15", board->duty_q15);
    if (seen.steps != 0)
        say_number("steps", seen.steps);
    if (board->chopper)
        say("chopper");
    if (board->digital_outputs != 0)
        say_number("digital", board->digital_outputs);
    if (board->pwm_q15[0] != 0 || board->pwm_q15[1] != 0)
        say_list("pwm_q15", board->pwm_q15, BOARD_PWM);
    say_number("count", board->encoder_count);
    say_number("sent", seen.sent);
    for (int32_t i = most < seen.sent ? seen.sent - most : 0; i < seen.sent; i++) {
        const struct rack_packet *packet = &seen.told[i % TOLD_MAX];
        say_number("port", packet->port);
        say_bytes("packet", packet->bytes, packet->size);
    }
    say_word64("hash", seen.hash);
}

static int32_t told(void) {
    int32_t most = is_given("tell") ? (int32_t)given("tell") : 0;
    return most < TOLD_MAX ? most : TOLD_MAX;
}

// A board whose memory is empty and works, with a supply, on an axis without a wall.
static void replay_device_blank(void) {
    memset(&bench, 0, sizeof bench);
    bench.board.kept = BOARD_RECORD_MAX;
    bench.board.flipped = -1;
    bench.board.supply_mV = 24000;
    bench.board.axis.wall_q16 = INT64_MAX;
    bench.board.axis.floor_q16 = INT64_MIN;
    bench.board.collects = true;
}

static void replay_device_record(void) {
    struct memory *memory = &bench.board.memory[given("record")];
    const uint8_t *bytes = given_bytes("bytes", &memory->size);
    memcpy(memory->bytes, bytes, (size_t)memory->size);
}

// What the board sees from here on; what is not named stays.
static void replay_device_set(void) {
    struct board *board = &bench.board;
    struct rack_axis *axis = &board->axis;
#define SET(name, member, factor)                                                                  \
    if (is_given(#name))                                                                           \
        member = given(#name) * (factor);
    SET(kept, board->kept, 1)
    SET(flipped, board->flipped, 1)
    SET(power, board->power, 1)
    SET(brake, board->brake, 1)
    SET(duty_q15, board->duty_q15, 1)
    SET(line_open, board->line_open, 1)
    SET(on_switch, board->on_switch, 1)
    SET(supply_mV, board->supply_mV, 1)
    SET(inputs, board->digital_inputs, 1)
    SET(interrupt_at, board->interrupt_at, 1)
    SET(interrupt_opens, board->interrupt_opens, 1)
    SET(speed_q16, axis->speed_q16, 1)
    SET(pull_q16, axis->pull_q16, 1)
    SET(turn_q16, axis->turn_q16, 1)
    SET(wall, axis->wall_q16, 1 << 16)
    SET(floor, axis->floor_q16, 1 << 16)
    SET(position, axis->position_q16, 1 << 16)
#undef SET
    if (is_given("random"))
        board->random = given_word64("random");
    if (is_given("index_count")) {
        board->indexed = true;
        board->index_count = (int32_t)given("index_count");
    }
    if (is_given("frame_number")) {
        board->on_bus = true;
        board->frame_number = (uint16_t)given("frame_number");
        board->frame_us = board->count_us - (uint32_t)given("frame_age_us");
    }
    board->encoder_count = (int32_t)(uint32_t)(uint64_t)(axis->position_q16 >> 16);
}

static void replay_device_boot(void) {
    begin_line();
    bench.board.count_us = (uint32_t)given("count_us");
    device_boot(&bench.device, &bench.board, bench.board.count_us);
}

// A packet that arrived so long ago, and waits.
static void replay_device_give(void) {
    struct board *board = &bench.board;
    struct rack_packet *packet = &board->waiting[board->packets];
    int32_t size;
    const uint8_t *bytes = given_bytes("packet", &size);
    uint32_t ago_us = is_given("ago_us") ? (uint32_t)given("ago_us") : 0;
    packet->port = is_given("port") ? (int32_t)given("port") : BOARD_HOST;
    packet->arrived_us = board->count_us - ago_us;
    packet->size = size < RACK_PACKET_MAX ? size : RACK_PACKET_MAX;
    memcpy(packet->bytes, bytes, (size_t)packet->size);
    board->packets += board->packets < RACK_PACKETS - 1;
}

// Each time after so many us: the guard, if it is asked for, and then a poll.
static void replay_device_run(void) {
    int64_t polls = given("polls");
    uint32_t step_us = (uint32_t)given("step_us");
    bool guarded = is_given("guard") && given("guard") != 0;
    int32_t most = told();
    begin_line();
    for (int64_t i = 0; i < polls && i < POLLS_MAX; i++) {
        rack_advance(&bench.board, step_us);
        if (guarded)
            device_guard(&bench.device, &bench.board);
        device_poll(&bench.device, &bench.board);
        note_outputs();
    }
    say_line(most);
}

// Between two polls: what waits for its moment is sent.
static void replay_device_report(void) {
    int32_t most = told();
    begin_line();
    rack_advance(&bench.board, (uint32_t)given("step_us"));
    device_report(&bench.device, &bench.board);
    note_outputs();
    say_line(most);
}

// The timer alone: the main loop hangs.
static void replay_device_hang(void) {
    int64_t calls = given("calls");
    uint32_t step_us = (uint32_t)given("step_us");
    begin_line();
    for (int64_t i = 0; i < calls && i < POLLS_MAX; i++) {
        rack_advance(&bench.board, step_us);
        device_guard(&bench.device, &bench.board);
        note_outputs();
    }
    say_line(0);
}

static void replay_device_keep(void) { kept[given("slot") % KEPT] = bench; }

static void replay_device_recall(void) { bench = kept[given("slot") % KEPT]; }

const struct word device_words[] = {
    {"device-blank", replay_device_blank},
    {"device-record", replay_device_record},
    {"device-set", replay_device_set},
    {"device-boot", replay_device_boot},
    {"device-give", replay_device_give},
    {"device-run", replay_device_run},
    {"device-report", replay_device_report},
    {"device-hang", replay_device_hang},
    {"device-keep", replay_device_keep},
    {"device-recall", replay_device_recall},
    {0, 0},
};
