// Replays neighbours*: what a board asks those beside it, and what it answers them.
//
// Stamps end here, where a device would take them for its clock: so this file has a second copy of
// firmware/neighbours.c, under other names, which hands them to it.
#define device_take_stamps judge_take_stamps
#define neighbours_flush judge_flush
#define neighbours_speak judge_speak
#define neighbours_take judge_take
#include "judge.h"
#include "rack.h"
#include <neighbours.c>
#include <string.h>

static struct device device;
static struct board board;

// In place of the device's own: what it is handed.
void device_take_stamps(struct device *of, const struct sync_source *source,
                        const struct stamps *stamps, uint32_t arrived_us, uint32_t count_us) {
    (void)of;
    say_number("source", source->number);
    say_number("to_here_least_us", source->to_here_least_us);
    say_number("to_there_least_us", source->to_there_least_us);
    say_number("least_error_ns", source->least_error_ns);
    say_number("most_error_ns", source->most_error_ns);
    say_number("lineage", source->lineage.id);
    say_number("settled", source->lineage.settled);
    say_number("echo_us", stamps->echo_us);
    say_number("received_us", stamps->received_us);
    say_number("sent_us", stamps->sent_us);
    say_number("arrived_us", arrived_us);
    say_number("count_us", count_us);
}

static void replay_neighbours(void) {
    int32_t size; // 16 bytes
    device = (struct device){
        .clock = {.count_us = (uint32_t)given("count_us"), .rate_q32 = (int32_t)given("rate_q32")}};
    memset(&device.marks, 0xff, sizeof device.marks); // behind the ports, and none of them
    clock_set(&device.clock, given("base_us"), 0);
    sync_restart(&device.sync);
    device.sync.id = (uint32_t)given("id");
    device.settings.neighbours = (uint8_t)given("ports");
    device.settings.ask_us = (uint32_t)given("ask_us");
    device.settings.dither_us = (uint16_t)given("dither_us");
    device.settings.peer_least_us = (uint32_t)given("peer_least_us");
    device.settings.sync.among_boards = is_given("among") && given("among") != 0;
    memcpy(device.settings.peer_key, given_bytes("key", &size), SIPHASH_KEY_BYTES);
}

// A servo period: the clock is advanced, and what is known of it is told.
static void replay_neighbours_period(void) {
    clock_advance(&device.clock, (uint32_t)given("count_us"));
    device.sync.lineage = (uint32_t)given("lineage");
    device.sync.settled = given("settled") != 0;
    device.sync.least_error_ns = (int32_t)given("least_error_ns");
    device.sync.most_error_ns = (int32_t)given("most_error_ns");
    device.sync.told_us = device.clock.ticks_us;
    device.signals.stepped = true;
}

// A host's, and what its servo periods find from now on: sources, and their values.
static void replay_neighbours_logic(void) {
    int32_t size, values[8];
    const uint8_t *payload = given_bytes("payload", &size);
    struct logic logic;
    if (!logic_decode(payload, size, &logic))
        say("malformed");
    device.signals.asked = logic.number - 1; // it is another one
    signals_rule(&device.signals, &logic, 12);
    for (int32_t i = 0; i < given_list("values", values, 8); i += 2)
        device.signals.values[values[i]] = values[i + 1];
}

static void begin_poll(void) {
    board.count_us = (uint32_t)given("count_us");
    board.random = given_word64("random");
}

static void replay_neighbours_speak(void) {
    begin_poll();
    neighbours_speak(&device, &board);
}

static void replay_neighbours_take(void) {
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    begin_poll();
    bool taken = neighbours_take(&device, &board, frame, size, (int32_t)given("port"),
                                 (uint32_t)given("arrived_us"), board.count_us);
    say(taken ? "taken" : "refused");
}

static void replay_neighbours_flush(void) { neighbours_flush(&device); }

const struct word neighbour_words[] = {
    {"neighbours", replay_neighbours},
    {"neighbours-period", replay_neighbours_period},
    {"neighbours-speak", replay_neighbours_speak},
    {"neighbours-take", replay_neighbours_take},
    {"neighbours-flush", replay_neighbours_flush},
    {"neighbours-logic", replay_neighbours_logic},
    {0, 0},
};
