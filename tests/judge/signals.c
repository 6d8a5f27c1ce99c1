// Replays piece-*, graph-*, readings-*, and the payloads of SIGNALS, LOGIC and READINGS.
#include "batch.h"
#include "judge.h"
#include "logic.h"
#include "reading.h"
#include "report.h"
#include <string.h>

static struct pieces pieces;
static struct graph graph;
static struct readings readings;

static struct wanted_piece given_piece(void) {
    struct wanted_piece piece = {.has_start = is_given("start_us"),
                                 .has_from = is_given("from"),
                                 .end_us = given("end_us"),
                                 .to = (int32_t)given("to")};
    if (piece.has_start)
        piece.start_us = given("start_us");
    if (piece.has_from)
        piece.from = (int32_t)given("from");
    return piece;
}

// A track without pieces; its next one has a number.
static void replay_pieces(void) { memset(&pieces, 0, sizeof pieces); }

// As after so many: all that it remembers are events at time 0.
static void replay_pieces_after(void) {
    replay_pieces();
    pieces.next = (uint32_t)given("count");
    pieces.current = pieces.next - 1;
}

static void replay_piece_take(void) {
    static const char *const results[] = {"taken", "gap", "late", "order", "full"};
    struct wanted_piece piece = given_piece();
    say(results[pieces_take(&pieces, (uint32_t)given("number"), &piece, given("now_us"))]);
    say_number("next", pieces.next);
}

static void replay_piece_at(void) { say_number("value", pieces_at(&pieces, given("time_us"))); }

static void replay_piece_past(void) {
    int32_t value;
    if (pieces_past(&pieces, given("time_us"), &value))
        say_number("value", value);
    else
        say("gone");
}

static void replay_piece_now(void) { say_number("value", pieces_now(&pieces, given("time_us"))); }

static const char *const graph_results[] = {"good", "kind", "missing", "cycle", "limits"};

static int32_t given_shift(void) {
    return is_given("knot_shift") ? (int32_t)given("knot_shift") : 12;
}

// Five numbers for each node.
static int32_t given_nodes(struct logic_node *nodes) {
    int32_t numbers[5 * GRAPH_NODES], count = given_list("nodes", numbers, 5 * GRAPH_NODES) / 5;
    for (int32_t i = 0; i < count; i++) {
        const int32_t *n = numbers + 5 * i;
        nodes[i] = (struct logic_node){(uint8_t)n[0], (uint8_t)n[1], (uint8_t)n[2], n[3], n[4]};
    }
    return count;
}

static void replay_graph(void) {
    int32_t wrong;
    memset(&graph, 0, sizeof graph);
    graph.count = (uint8_t)given_nodes(graph.nodes);
    enum graph_result result = graph_check(graph.nodes, graph.count, given_shift(), &wrong);
    say(graph_results[result]);
    say_number("wrong", wrong);
    if (result != GRAPH_GOOD)
        graph.count = 0;
}

static void replay_graph_step(void) {
    int32_t values[GRAPH_VALUES] = {0};
    given_list("values", values, SOURCE_OF_NODES);
    if (is_given("past"))
        given_list("past", values + SOURCE_OF_NODES, GRAPH_NODES);
    graph_step(&graph, values);
    say_list("nodes", values + SOURCE_OF_NODES, graph.count);
}

// Nothing taken yet, or so many readings ago.
static void replay_readings(void) {
    memset(&readings, 0, sizeof readings);
    readings.taken = readings.kept = readings.told = (uint32_t)given("taken");
}

static void say_readings(void) {
    say_number("taken", readings.taken);
    say_number("kept", readings.kept);
    const struct reading *first = &readings.ring[readings.kept % READINGS];
    const struct reading *last = &readings.ring[(readings.taken - 1) % READINGS];
    say_number("first_us", first->time_us);
    say_number("last_us", last->time_us);
    say_number("value", last->value);
    say_number("trigger", last->trigger);
}

static void replay_readings_push(void) {
    int64_t time_us = given("time_us"), times = given("times");
    int32_t value = (int32_t)given("value");
    for (int64_t i = 0; i < times; i++)
        readings_push(&readings, time_us + i, (int32_t)(value + i), (uint8_t)given("trigger"));
    say_readings();
}

static void replay_readings_seen(void) {
    readings_seen(&readings, (uint32_t)given("number"));
    say_readings();
}

static void replay_readings_tell(void) {
    uint32_t count;
    say_number("first", readings_tell(&readings, (uint32_t)given("most"), &count));
    say_number("count", count);
}

static struct batch batch; // built up

static void replay_batch(void) {
    memset(&batch, 0, sizeof batch);
    batch.base_us = given("base_us");
    batch.seen = (uint32_t)given("seen");
}

static void replay_batch_piece(void) {
    struct batch_piece *piece = &batch.pieces[batch.count++];
    piece->track = (uint8_t)given("track");
    piece->number = (uint32_t)given("number");
    piece->piece = given_piece();
}

static void say_payload(const uint8_t *payload, int32_t size) {
    if (size < 0)
        say("refused");
    else
        say_bytes("payload", payload, size);
}

static void replay_batch_encode(void) {
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    if (is_given("count"))
        batch.count = (uint8_t)given("count");
    say_payload(payload, batch_encode(&batch, payload, capacity));
}

static void replay_batch_decode(void) {
    int32_t size;
    uint8_t *payload = given_bytes("payload", &size);
    static struct batch read;
    memset(&read, 0xff, sizeof read);
    if (!batch_decode(payload, size, &read)) {
        say("malformed");
        return;
    }
    say_number("base_us", read.base_us);
    say_number("seen", read.seen);
    for (int32_t i = 0; i < read.count; i++) {
        const struct wanted_piece *piece = &read.pieces[i].piece;
        say_number("track", read.pieces[i].track);
        say_number("number", read.pieces[i].number);
        say_number("flags", piece->has_start + 2 * piece->has_from);
        say_number("start_us", piece->start_us);
        say_number("end_us", piece->end_us);
        say_number("from", piece->from);
        say_number("to", piece->to);
    }
}

static struct logic given_logic(void) {
    struct logic logic;
    int32_t numbers[5 * LOGIC_FEEDS];
    memset(&logic, 0, sizeof logic);
    logic.number = (uint32_t)given("number");
    logic.nodes = (uint8_t)given_nodes(logic.node);
    given_list("digital", numbers, BOARD_DIGITAL);
    for (int32_t i = 0; i < BOARD_DIGITAL; i++)
        logic.digital[i] = (uint8_t)numbers[i];
    given_list("pwm", numbers, BOARD_PWM);
    for (int32_t i = 0; i < BOARD_PWM; i++)
        logic.pwm[i] = (uint8_t)numbers[i];
    logic.triggers = (uint8_t)(given_list("triggers", numbers, 4 * LOGIC_TRIGGERS) / 4);
    for (int32_t i = 0; i < logic.triggers; i++) {
        const int32_t *n = numbers + 4 * i;
        logic.trigger[i] =
            (struct trigger){(uint8_t)n[0], (uint8_t)n[1], (uint8_t)n[2], (uint16_t)n[3]};
    }
    if (is_given("feeds"))
        logic.feeds = (uint8_t)(given_list("feeds", numbers, 5 * LOGIC_FEEDS) / 5);
    for (int32_t i = 0; i < logic.feeds; i++) {
        const int32_t *n = numbers + 5 * i;
        logic.feed[i] = (struct feed){(uint8_t)n[0], (uint8_t)n[1], (uint16_t)n[2], (uint16_t)n[3],
                                      (uint16_t)n[4]};
    }
    if (is_given("fed"))
        logic.feds = (uint8_t)(given_list("fed", numbers, 2 * LOGIC_FEEDS) / 2);
    for (int32_t i = 0; i < logic.feds; i++)
        logic.fed[i] = (struct fed){(uint8_t)numbers[2 * i], (uint16_t)numbers[2 * i + 1]};
    return logic;
}

static void replay_logic_check(void) {
    struct logic logic = given_logic();
    int32_t wrong;
    say(graph_results[logic_check(&logic, given_shift(), &wrong)]);
    say_number("wrong", wrong);
}

static void replay_logic_encode(void) {
    struct logic logic = given_logic();
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    say_payload(payload, logic_encode(&logic, payload, capacity));
}

// What is read is written again: the same bytes.
static void replay_logic_decode(void) {
    int32_t size;
    uint8_t *payload = given_bytes("payload", &size), *again = room(1000);
    struct logic logic;
    if (!logic_decode(payload, size, &logic)) {
        say("malformed");
        return;
    }
    say_number("nodes", logic.nodes);
    say_number("triggers", logic.triggers);
    say_number("feeds", logic.feeds);
    say_number("fed", logic.feds);
    say_bytes("again", again, logic_encode(&logic, again, 1000));
}

static struct report given_report(void) {
    struct report report;
    int32_t numbers[3 * REPORT_READINGS];
    memset(&report, 0, sizeof report);
    report.logic = (uint32_t)given("logic");
    report.result = (uint8_t)given("result");
    report.wrong = (uint8_t)given("wrong");
    given_list("next", numbers, REPORT_TRACKS);
    for (int32_t i = 0; i < REPORT_TRACKS; i++)
        report.next[i] = (uint32_t)numbers[i];
    report.refused = (uint32_t)given("refused");
    report.late = (uint32_t)given("late");
    report.gaps = (uint32_t)given("gaps");
    report.kept = (uint32_t)given("kept");
    report.first = (uint32_t)given("first");
    report.count = (uint8_t)(given_list("readings", numbers, 3 * REPORT_READINGS) / 3);
    for (int32_t i = 0; i < report.count; i++) // trigger, time since the base, value
        report.readings[i] = (struct reading){given("base_us") + numbers[3 * i + 1],
                                              numbers[3 * i + 2], (uint8_t)numbers[3 * i]};
    return report;
}

static void replay_report_encode(void) {
    struct report report = given_report();
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    if (is_given("count"))
        report.count = (uint8_t)given("count");
    say_payload(payload, report_encode(&report, payload, capacity));
}

static void replay_report_decode(void) {
    int32_t size;
    uint8_t *payload = given_bytes("payload", &size);
    static struct report report;
    memset(&report, 0xff, sizeof report);
    if (!report_decode(payload, size, &report)) {
        say("malformed");
        return;
    }
    say_number("logic", report.logic);
    say_number("result", report.result);
    say_number("wrong", report.wrong);
    for (int32_t i = 0; i < REPORT_TRACKS; i++)
        say_number("next", report.next[i]);
    say_number("refused", report.refused);
    say_number("late", report.late);
    say_number("gaps", report.gaps);
    say_number("kept", report.kept);
    say_number("first", report.first);
    for (int32_t i = 0; i < report.count; i++) {
        say_number("trigger", report.readings[i].trigger);
        say_number("time_us", report.readings[i].time_us);
        say_number("value", report.readings[i].value);
    }
}

const struct word signal_words[] = {
    {"pieces", replay_pieces},
    {"pieces-after", replay_pieces_after},
    {"piece-take", replay_piece_take},
    {"piece-at", replay_piece_at},
    {"piece-past", replay_piece_past},
    {"piece-now", replay_piece_now},
    {"graph", replay_graph},
    {"graph-step", replay_graph_step},
    {"readings", replay_readings},
    {"readings-push", replay_readings_push},
    {"readings-seen", replay_readings_seen},
    {"readings-tell", replay_readings_tell},
    {"batch", replay_batch},
    {"batch-piece", replay_batch_piece},
    {"batch-encode", replay_batch_encode},
    {"batch-decode", replay_batch_decode},
    {"logic-check", replay_logic_check},
    {"logic-encode", replay_logic_encode},
    {"logic-decode", replay_logic_decode},
    {"report-encode", replay_report_encode},
    {"report-decode", replay_report_decode},
    {0, 0},
};
