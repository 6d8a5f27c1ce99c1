#include "signals.h"
#include "fixed.h" // clamp
#include "near.h"
#include <string.h>

#define ALL_PWM ((1u << BOARD_PWM) - 1)

void signals_take(struct signals *signals, const struct batch *batch, int64_t now_us) {
    signals->used = true;
    readings_seen(&signals->readings, batch->seen);
    for (int32_t i = 0; i < batch->count; i++) {
        const struct batch_piece *sent = &batch->pieces[i];
        int32_t at = sent->track - SOURCE_OF_PIECES;
        struct pieces *track = &signals->tracks[at];
        bool fed = signals->feeds.fed >> at & 1;
        enum piece_result result =
            fed ? PIECE_GAP : pieces_take(track, sent->number, &sent->piece, now_us);
        signals->late += result == PIECE_LATE;
        signals->refused += result != PIECE_LATE && result != PIECE_TAKEN;
        if (track->next != 0)
            signals->begun |= (uint16_t)(1 << at);
    }
}

bool signals_feed(struct signals *signals, const struct peer_feed *frame, int64_t now_us) {
    bool good = true, anew;
    for (int32_t i = 0; i < FEED_TRACKS; i++) {
        if (!(signals->feeds.fed >> i & 1) || signals->feeds.taken[i].feed != frame->number)
            continue;
        good &= feeds_take(&signals->feeds, i, &signals->tracks[i], frame, now_us,
                           &signals->refused, &signals->late, &anew);
        if (anew)
            signals->placed = 0; // its pieces count from 0
        if (signals->tracks[i].next != 0)
            signals->begun |= (uint16_t)(1 << i);
    }
    return good;
}

static uint32_t bit(uint8_t source) { return source < SOURCE_OF_NODES ? 1u << source : 0; }

// Of a few outputs: bit i, output i has a source.
static uint8_t driven(const uint8_t *sources, int32_t count) {
    uint32_t all = 0;
    for (int32_t i = 0; i < count; i++)
        all |= (uint32_t)(sources[i] != SOURCE_UNUSED) << i;
    return (uint8_t)all;
}

static bool is_by_nodes(const struct logic *logic) {
    bool all = driven(logic->pwm, BOARD_PWM) == 0;
    for (int32_t i = 0; i < BOARD_DIGITAL; i++)
        all = all && logic->digital[i] >= SOURCE_OF_NODES;
    return all;
}

static uint32_t reads(const struct logic *logic) {
    uint32_t all = 0;
    for (int32_t i = 0; i < logic->nodes; i++)
        all |= logic->node[i].kind == NODE_PAST ? 1u << SIGNALS_READ_PAST
                                                : bit(logic->node[i].a) | bit(logic->node[i].b);
    for (int32_t i = 0; i < BOARD_DIGITAL; i++)
        all |= bit(logic->digital[i]);
    for (int32_t i = 0; i < BOARD_PWM; i++)
        all |= bit(logic->pwm[i]);
    for (int32_t i = 0; i < logic->triggers; i++)
        all |= bit(logic->trigger[i].source) | bit(logic->trigger[i].condition);
    for (int32_t i = 0; i < logic->feeds; i++)
        all |= bit(logic->feed[i].source);
    return all;
}

// What is true from the start is no edge: bit i, node or trigger i has its input for true.
static uint16_t edge_nodes(const struct logic *logic) {
    uint32_t all = 0;
    for (int32_t i = 0; i < logic->nodes; i++)
        all |= (uint32_t)(logic->node[i].kind == NODE_EDGE) << i;
    return (uint16_t)all;
}

static uint8_t edge_triggers(const struct logic *logic) {
    uint32_t all = 0;
    for (int32_t i = 0; i < logic->triggers; i++)
        all |= (uint32_t)(logic->trigger[i].kind == TRIGGER_EDGE) << i;
    return (uint8_t)all;
}

void signals_rule(struct signals *signals, const struct logic *logic, int32_t knot_shift) {
    int32_t wrong;
    if (signals->used && logic->number == signals->asked)
        return;
    signals->used = true;
    signals->asked = logic->number;
    signals->result = (uint8_t)logic_check(logic, knot_shift, &wrong);
    signals->wrong = (uint8_t)wrong;
    if (signals->result != GRAPH_GOOD)
        return;
    signals->ruled = true;
    signals->stepped = false;
    signals->logic = *logic;
    signals->reads = reads(logic);
    signals->digitals = driven(logic->digital, BOARD_DIGITAL);
    signals->pwms = driven(logic->pwm, BOARD_PWM);
    signals->by_nodes = is_by_nodes(logic); // and there is a logic
    signals->steady = false;
    signals->graph.count = logic->nodes;
    signals->graph.held = edge_nodes(logic);
    memcpy(signals->graph.nodes, logic->node, sizeof logic->node);
    signals->met = edge_triggers(logic);
    signals->placed = 0;
    uint32_t changed = feeds_rule(&signals->feeds, logic);
    signals->values[INPUT_LAG] = logic->feds != 0 ? FEED_UNKNOWN_MS : 0; // until a board is heard
    for (int32_t i = 0; i < FEED_TRACKS; i++) {
        if (!(changed >> i & 1))
            continue;
        memset(&signals->tracks[i], 0, sizeof signals->tracks[i]);
        signals->values[SOURCE_OF_PIECES + i] = 0;
        signals->begun &= (uint16_t)~(1 << i);
    }
}

void signals_report(struct signals *signals, struct report *report) {
    struct readings *readings = &signals->readings;
    uint32_t count;
    report->logic = signals->asked;
    report->result = signals->result;
    report->wrong = signals->wrong;
    for (int32_t i = 0; i < REPORT_TRACKS; i++)
        report->next[i] = signals->tracks[i].next;
    report->refused = signals->refused;
    report->late = signals->late;
    report->gaps = signals->feeds.gaps;
    report->kept = readings->kept;
    report->first = readings_tell(readings, REPORT_READINGS, &count);
    report->count = (uint8_t)count;
    report->readings[0] = (struct reading){0}; // its time is told, also where there is none
    for (uint32_t i = 0; i < count; i++)
        report->readings[i] = readings->ring[(report->first + i) % READINGS];
}

// The count at a time that is a few servo periods ahead at most, or past.
static uint32_t count_of(const struct headway_clock *clock, int64_t time_us) {
    int64_t ahead_us = time_us - clock->system_us;
    if (ahead_us <= 0)
        return clock->count_us;
    return clock->count_us + (uint32_t)(ahead_us - ((ahead_us * clock->rate_q32) >> 32));
}

// At once: the board forgets what it was told of this output for later.
static void set_digital(struct signals *signals, struct board *board, int32_t output, bool on,
                        uint32_t count_us) {
    uint32_t bit = 1u << output, wanted = (uint32_t)on << output;
    if ((((signals->on ^ wanted) | signals->ahead) & bit) == 0)
        return;
    signals->on = (uint8_t)((signals->on & ~bit) | wanted);
    signals->ahead = (uint8_t)(signals->ahead & ~bit);
    board_set_digital(board, output, on, count_us);
}

// The output as the track has it now; from there on it is told what changes.
static void place(struct signals *signals, struct board *board, int32_t output,
                  const struct pieces *track, const struct headway_clock *clock) {
    bool begun = pieces_begun(track, clock->system_us);
    bool on = begun && track->ring[track->current % PIECES].to != 0;
    set_digital(signals, board, output, on, clock->count_us);
    signals->told[output] = track->current + begun;
    signals->placed |= (uint8_t)(1 << output);
}

// What a track changes until then the board is told ahead, with its count: so the output changes at
// that microsecond, whenever periods are. Of pieces that came too late the one that runs is told.
static void follow_track(struct signals *signals, struct board *board, int32_t output,
                         const struct pieces *track, const struct headway_clock *clock,
                         int64_t until_us) {
    if (!(signals->placed >> output & 1))
        place(signals, board, output, track, clock);
    uint32_t number = signals->told[output];
    if (number < track->current)
        number = track->current;
    for (; number < track->next; number++) {
        const struct piece *piece = &track->ring[number % PIECES];
        bool on = piece->to != 0, was_on = signals->on >> output & 1;
        if (piece->start_us >= until_us)
            break;
        if (on == was_on)
            continue;
        signals->on ^= (uint8_t)(1 << output);
        signals->ahead |= (uint8_t)(1 << output);
        board_set_digital(board, output, on, count_of(clock, piece->start_us));
    }
    signals->told[output] = number;
}

static void set_pwm(struct signals *signals, struct board *board, int32_t output, int32_t duty) {
    uint8_t bit = (uint8_t)(1 << output);
    signals->pwm_off = (uint8_t)(duty == 0 ? signals->pwm_off | bit : signals->pwm_off & ~bit);
    board_set_pwm(board, output, duty);
}

// What nothing drives is told once that it is off.
static APART void drive_outputs(struct signals *signals, struct board *board,
                                const struct headway_clock *clock, int64_t until_us) {
    const struct logic *logic = &signals->logic;
    uint32_t left = signals->digitals | signals->on | signals->ahead;
    for (int32_t i = 0; left != 0; i++, left >>= 1) {
        uint8_t source = logic->digital[i];
        if (!(left & 1))
            continue;
        uint32_t track = (uint32_t)source - SOURCE_OF_PIECES;
        if (track < REPORT_TRACKS) {
            follow_track(signals, board, i, &signals->tracks[track], clock, until_us);
        } else {
            bool on = source != SOURCE_UNUSED && signals->values[source] != 0;
            set_digital(signals, board, i, on, clock->count_us);
        }
    }
    left = signals->pwms | (ALL_PWM & ~signals->pwm_off);
    for (int32_t i = 0; left != 0; i++, left >>= 1) {
        int32_t duty = logic->pwm[i] == SOURCE_UNUSED ? 0 : signals->values[logic->pwm[i]];
        if (left & 1)
            set_pwm(signals, board, i, duty < 0 ? 0 : duty > INT16_MAX ? INT16_MAX : duty);
    }
}

static bool is_due(struct signals *signals, int32_t i) {
    const struct trigger *trigger = &signals->logic.trigger[i];
    bool met = trigger->kind == TRIGGER_INTERVAL || signals->values[trigger->condition] != 0;
    bool before = signals->met >> i & 1;
    signals->met = (uint8_t)((signals->met & ~(1u << i)) | (uint32_t)met << i);
    if (!met || (trigger->kind == TRIGGER_EDGE && before))
        return false;
    if (before && --signals->wait[i] != 0)
        return false;
    signals->wait[i] = trigger->every;
    return true;
}

static APART void take_readings(struct signals *signals, int64_t time_us) {
    for (int32_t i = 0; i < signals->logic.triggers; i++)
        if (is_due(signals, i))
            readings_push(&signals->readings, time_us,
                          signals->values[signals->logic.trigger[i].source], (uint8_t)i);
}

static APART void switch_off(struct signals *signals, struct board *board,
                             const struct headway_clock *clock) {
    for (int32_t i = 0; i < BOARD_DIGITAL; i++)
        set_digital(signals, board, i, false, clock->count_us);
    for (int32_t i = 0; i < BOARD_PWM; i++)
        set_pwm(signals, board, i, 0);
    signals->placed = 0; // later they take the place that they should have
}

bool signals_idle(const struct signals *signals) {
    return !signals->used && signals->on == 0 && signals->ahead == 0 && signals->pwm_off == ALL_PWM;
}

void signals_recall(struct signals *signals, const struct track *tracks, int64_t time_us,
                    int32_t knot_shift) {
    for (int32_t i = 0; i < signals->graph.count; i++) {
        const struct logic_node *node = &signals->graph.nodes[i];
        int64_t then_us = time_us - node->low;
        int32_t value = node->high;
        if (node->kind != NODE_PAST)
            continue;
        if (node->a < SOURCE_OF_PIECES) {
            struct instant then = instant_at(then_us, knot_shift);
            track_past(&tracks[node->a], &then, &value);
        } else {
            pieces_past(&signals->tracks[node->a - SOURCE_OF_PIECES], then_us, &value);
        }
        signals->values[SOURCE_OF_NODES + i] = value;
    }
}

static APART void follow_pieces(struct signals *signals, int64_t time_us) {
    uint32_t left = signals->begun;
    for (int32_t i = 0; left != 0; i++, left >>= 1)
        if (left & 1)
            signals->values[SOURCE_OF_PIECES + i] = pieces_now(&signals->tracks[i], time_us);
}

// Apart, and called: while no node changes there is nothing to do.
static APART void settle(struct signals *signals, struct board *board,
                         const struct headway_clock *clock, uint16_t period_us, bool live) {
    if (signals->ruled && live)
        drive_outputs(signals, board, clock, clock->system_us + SIGNALS_AHEAD * period_us);
    else
        switch_off(signals, board, clock);
}

void signals_step(struct signals *signals, struct board *board, const struct headway_clock *clock,
                  uint16_t period_us, bool live) {
    if (signals->begun != 0)
        follow_pieces(signals, clock->system_us);
    uint32_t held = signals->graph.held;
    graph_step(&signals->graph, signals->values);
    // Whether a node is true changes with what it holds, or, of an edge, in the period after.
    bool same = held == signals->graph.held;
    signals->stepped = true;
    if (!(same && signals->steady && live)) {
        settle(signals, board, clock, period_us, live);
        signals->steady = same && live && signals->by_nodes;
    }
    if (signals->logic.triggers != 0)
        take_readings(signals, clock->system_us);
}

void signals_restart(struct signals *signals) {
    uint8_t on = signals->on, ahead = signals->ahead, pwm_off = signals->pwm_off;
    memset(signals, 0, sizeof *signals);
    signals->on = on;
    signals->ahead = ahead;
    signals->pwm_off = pwm_off;
}
