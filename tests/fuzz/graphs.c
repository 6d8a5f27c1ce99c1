// Fuzz target: signals of a hostile host. Its bytes are a script: logic of any nodes, batches of any
// pieces, the same as raw payloads, time. What is taken is sound: no node reads itself or one after it,
// outputs are off where nothing rules them and as their tracks have them else, the past of a track is
// what it was or is said not to be there, a hostile board leaves tracks in order, and what is told and
// given can be read.
#include "feed.h"
#include "node.h"
#include "script.h"

static struct node begun;

// Tracks of motion, and of the first one which knot's point each place of its ring was given last.
static struct track tracks[SOURCE_OF_PIECES];
static int64_t placed[TRACK_POINTS];

int LLVMFuzzerInitialize(int *argc, char ***argv) {
    (void)argc, (void)argv;
    begun.board.true_us = 1000000;
    PROMISE(oscillator_begin(&begun.board.oscillator, 0, 0, 0, 1000, 1));
    return 0;
}

static int32_t next_word(struct script *script) {
    static const int32_t edges[] = {0, 1, -1, 65536, INT32_MAX, INT32_MIN};
    uint8_t what = next(script);
    if (what % 8 < 6)
        return edges[what % 8];
    return next_whole(script);
}

static uint8_t next_source(struct script *script) { return (uint8_t)(next(script) % 52); }

static void rule(struct script *script, struct signals *signals) {
    struct logic logic = {.number = next(script),
                          .nodes = next(script) % (GRAPH_NODES + 1),
                          .triggers = next(script) % (LOGIC_TRIGGERS + 1)};
    int32_t wrong;
    for (int32_t i = 0; i < logic.nodes; i++) {
        logic.node[i].kind = next(script) % (NODE_KINDS + 1);
        logic.node[i].a = next_source(script);
        logic.node[i].b = next_source(script);
        logic.node[i].low = next_word(script);
        logic.node[i].high = next_word(script);
    }
    for (int32_t i = 0; i < BOARD_DIGITAL; i++)
        logic.digital[i] = next(script) % 4 ? SOURCE_OF_PIECES + (uint8_t)i : next_source(script);
    for (int32_t i = 0; i < BOARD_PWM; i++)
        logic.pwm[i] = next(script) % 4 ? SOURCE_UNUSED : next_source(script);
    for (int32_t i = 0; i < logic.triggers; i++) {
        logic.trigger[i].kind = next(script) % (TRIGGER_KINDS + 1);
        logic.trigger[i].source = next_source(script);
        logic.trigger[i].condition = next_source(script);
        logic.trigger[i].every = next(script) % 8;
    }
    logic.feeds = next(script) % (LOGIC_FEEDS + 1);
    for (int32_t i = 0; i < logic.feeds; i++)
        logic.feed[i] = (struct feed){.kind = next(script) % (FEED_KINDS + 1),
                                      .source = next_source(script),
                                      .number = (uint16_t)(8 + next(script) % 8),
                                      .every = next(script) % 4,
                                      .after_us = (uint16_t)(next(script) << 8)};
    logic.feds = next(script) % (LOGIC_FEEDS + 1);
    for (int32_t i = 0; i < logic.feds; i++)
        logic.fed[i] =
            (struct fed){(uint8_t)(SOURCE_OF_PIECES + next(script) % 12), next(script) % 9};
    uint8_t payload[1000];
    struct logic again;
    int32_t size = logic_encode(&logic, payload, sizeof payload);
    PROMISE(size > 0 && logic_decode(payload, size, &again));
    PROMISE(logic_check(&again, FUZZ_SHIFT, &wrong) == logic_check(&logic, FUZZ_SHIFT, &wrong));
    PROMISE(logic_encode(&logic, payload, size - 1) == -1);
    signals_rule(signals, &again, FUZZ_SHIFT);
}

static void take(struct script *script, struct signals *signals, int64_t now_us) {
    static struct batch batch, again;
    uint8_t payload[3000];
    batch.base_us = now_us;
    batch.seen = signals->readings.taken - next(script);
    batch.count = next(script) % 40;
    uint8_t track = (uint8_t)(SOURCE_OF_PIECES + next(script) % REPORT_TRACKS);
    uint32_t number = signals->tracks[track - SOURCE_OF_PIECES].next - next(script) % 3;
    int64_t at_us = now_us + next(script) % 16 - 4;
    for (int32_t i = 0; i < batch.count; i++) {
        uint8_t form = next(script);
        int64_t took_us = (int64_t)(next(script) % 64) << (form >> 4);
        batch.pieces[i].track = track;
        batch.pieces[i].number = number++;
        batch.pieces[i].piece = (struct wanted_piece){.has_start = form & 1,
                                                      .has_from = form & 2,
                                                      .start_us = at_us,
                                                      .end_us = at_us + took_us - !(form & 12),
                                                      .from = next_word(script),
                                                      .to = next_word(script)};
        at_us += took_us;
    }
    int32_t size = batch_encode(&batch, payload, sizeof payload);
    PROMISE(size > 0 && batch_decode(payload, size, &again));
    PROMISE(batch_encode(&batch, payload, next(script)) <= 255);
    signals_take(signals, &again, now_us);
    batch.base_us =
        next(script) % 2 ? PIECE_TIME_MAX : -PIECE_TIME_MAX; // any time, which is refused
    batch.pieces[0].piece.end_us = next_word(script) * (1LL << 32);
    PROMISE(batch_encode(&batch, payload, sizeof payload) <= (int32_t)sizeof payload);
}

// Another board says anything, often what goes on from before.
static void hear(struct script *script, struct signals *signals, int64_t now_us) {
    static int64_t last_us;
    struct peer_feed feed = {.number = next(script) % 9,
                             .steps = next(script) % 2,
                             .count = (uint8_t)(1 + next(script) % PEER_POINTS)};
    int64_t at_us = next(script) % 2 ? last_us : now_us + 512 * (next(script) - 128);
    for (int32_t i = 0; i < feed.count; i++) {
        feed.points[i] = (struct peer_point){at_us, next_word(script)};
        at_us += 1 + 16 * next(script);
    }
    last_us = feed.points[feed.count - 1].time_us;
    feed.time_us = last_us + next(script);
    uint8_t frame[PEER_FEED_BYTES];
    struct peer_feed again;
    peer_feed_encode(fuzz_key[0], &feed, frame);
    PROMISE(peer_feed_decode(fuzz_key[0], frame, sizeof frame, &again));
    bool fresh = llabs(now_us - again.time_us) <= FEED_FRESH_US, fed = false;
    for (int32_t i = 0; i < FEED_TRACKS; i++)
        fed |= (signals->feeds.fed >> i & 1) && signals->feeds.taken[i].feed == feed.number;
    PROMISE(signals_feed(signals, &again, now_us) == (fresh || !fed));
}

// As neighbours.c does, after each period.
static void give(struct signals *signals, int64_t time_us) {
    const struct logic *logic = &signals->logic;
    uint8_t frame[PEER_FEED_BYTES];
    struct peer_feed again;
    if ((logic->feeds | logic->feds) == 0)
        return;
    signals->values[INPUT_LAG] = feeds_step(&signals->feeds, logic, signals->values, time_us);
    PROMISE(signals->values[INPUT_LAG] >= 0);
    const struct peer_feed *feed = feeds_next(&signals->feeds, logic->feeds);
    if (!feed)
        return;
    peer_feed_encode(fuzz_key[0], feed, frame);
    PROMISE(peer_feed_decode(fuzz_key[0], frame, sizeof frame, &again));
    PROMISE(again.count == feed->count);
    for (int32_t i = 0; i < feed->count; i++)
        PROMISE(again.points[i].time_us == feed->points[i].time_us &&
                again.points[i].value == feed->points[i].value);
}

// Plans that go on from the first track's end, or before it; now and then its first one.
static void plan(struct script *script, int64_t now_us) {
    struct track *track = &tracks[0];
    int32_t points[128], count = next(script) % 126 + 3;
    int64_t first = track->written ? track->end + 1 - next(script) % 4 : now_us >> FUZZ_SHIFT;
    for (int32_t i = 0; i < count; i++)
        points[i] = next(script) << 8;
    if (track->written && first < track->oldest)
        return;
    if (next(script) % 32 == 0)
        track->written = false;
    if (!track->written)
        memset(placed, 0, sizeof placed);
    for (int32_t i = 0; i < count; i++)
        placed[(uint32_t)(first + i) % TRACK_POINTS] = first + i;
    track_write(track, first, points, count);
}

static bool is_left(int64_t knot) {
    return knot > tracks[0].end || placed[(uint32_t)knot % TRACK_POINTS] == knot;
}

// By hand, one piece after the other, or by which points the ring still has.
static int32_t past_of(const struct signals *signals, const struct logic_node *node,
                       int64_t then_us) {
    int64_t knot = then_us >> FUZZ_SHIFT;
    struct instant at = {knot, (uint16_t)(then_us << (16 - FUZZ_SHIFT))};
    if (node->a < SOURCE_OF_PIECES) {
        bool left = node->a == 0 && tracks[0].written && knot <= tracks[0].end;
        for (int32_t i = -1; i < 3; i++)
            left = left && is_left(knot + i);
        return left ? track_value(&tracks[0], &at) : node->high;
    }
    const struct pieces *track = &signals->tracks[node->a - SOURCE_OF_PIECES];
    for (uint32_t i = 1; i <= PIECES && i <= track->next; i++) {
        const struct piece *piece = &track->ring[(track->next - i) % PIECES];
        if (piece->start_us <= then_us) {
            struct pieces alone = {.next = 1, .ring[0] = *piece};
            return pieces_now(&alone, then_us);
        }
    }
    return node->high;
}

static void promise_past(const struct signals *signals, int64_t time_us) {
    for (int32_t i = 0; i < signals->graph.count; i++) {
        const struct logic_node *node = &signals->graph.nodes[i];
        if (node->kind == NODE_PAST)
            PROMISE(signals->values[SOURCE_OF_NODES + i] ==
                    past_of(signals, node, time_us - node->low));
    }
}

static void take_raw(struct script *script, struct signals *signals, int64_t now_us) {
    static struct batch batch;
    static struct report report;
    struct logic logic;
    uint8_t bytes[256];
    int32_t what = next(script) % 3, size = next(script);
    for (int32_t i = 0; i < size; i++)
        bytes[i] = next(script);
    if (what == 0 && batch_decode(bytes, size, &batch))
        signals_take(signals, &batch, now_us);
    if (what == 1 && logic_decode(bytes, size, &logic))
        signals_rule(signals, &logic, FUZZ_SHIFT);
    if (what == 2)
        report_decode(bytes, size, &report);
}

// Whether a piece begins so near that the board's counter may have it on the other side.
static bool begins_near(const struct pieces *track, int64_t time_us) {
    for (uint32_t number = track->next > PIECES ? track->next - PIECES : 0; number < track->next;
         number++)
        if (llabs(track->ring[number % PIECES].start_us - time_us) < 20)
            return true;
    return false;
}

// What the pin shows: the last change that was told, of those that are not to come.
static int32_t shown(const struct board *board, int32_t output) {
    for (uint32_t i = board->flips; i > 0 && board->flips - i < BOARD_FLIPS; i--) {
        const struct flip *flip = &board->flip[(i - 1) % BOARD_FLIPS];
        if (flip->output == output && flip->time_us <= board->true_us)
            return flip->on;
    }
    return board->flips < BOARD_FLIPS ? 0 : -1; // -1: it is no longer known
}

static void promise_outputs(const struct signals *signals, const struct board *board,
                            int64_t time_us) {
    for (int32_t i = 0; i < BOARD_DIGITAL; i++) {
        uint8_t source = signals->logic.digital[i];
        int32_t on = shown(board, i), wanted = 0;
        if (source < SOURCE_OF_PIECES || source >= SOURCE_OF_INPUTS || on < 0)
            continue;
        const struct pieces *track = &signals->tracks[source - SOURCE_OF_PIECES];
        for (uint32_t number = track->next > PIECES ? track->next - PIECES : 0;
             number < track->next; number++)
            if (track->ring[number % PIECES].start_us <= time_us)
                wanted = track->ring[number % PIECES].to != 0;
        PROMISE(on == wanted || begins_near(track, time_us));
    }
}

static void promise(struct signals *signals) {
    static struct report report, again;
    uint8_t payload[1000];
    signals_report(signals, &report);
    int32_t size = report_encode(&report, payload, sizeof payload);
    PROMISE(size > 0 && report_decode(payload, size, &again));
    PROMISE(report.count == again.count);
    for (int32_t i = 0; i < report.count; i++)
        PROMISE(report.readings[i].time_us == again.readings[i].time_us &&
                report.readings[i].value == again.readings[i].value);
    PROMISE(report_encode(&report, payload, size - 1) == -1);
    PROMISE(signals->readings.taken - signals->readings.kept <= READINGS);
    PROMISE(signals->readings.told - signals->readings.kept <= READINGS);
    for (int32_t i = 0; i < signals->graph.count; i++)
        PROMISE(signals->graph.nodes[i].a < SOURCE_OF_NODES + i);
    for (int32_t i = 0; i < signals->graph.count; i++)
        PROMISE(signals->graph.nodes[i].kind != NODE_PAST ||
                (signals->graph.nodes[i].a < SOURCE_OF_INPUTS && signals->graph.nodes[i].low >= 0));
    for (int32_t i = 0; i < REPORT_TRACKS; i++) {
        const struct pieces *track = &signals->tracks[i];
        PROMISE(track->next == 0 || track->current < track->next);
        for (uint32_t back = 2; back <= PIECES && back <= track->next; back++)
            PROMISE(track->ring[(track->next - back) % PIECES].start_us <=
                    track->ring[(track->next - back + 1) % PIECES].start_us);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length) {
    static struct signals signals;
    static struct board board;
    struct script script = {data, length, 0};
    struct headway_clock clock = {.system_us = 1700000000000000, .count_us = 1000000};
    if (length > 3000)
        return 0;
    memset(&signals, 0, sizeof signals);
    board = begun.board;
    memset(tracks, 0, sizeof tracks);
    while (script.at < script.size) {
        uint8_t what = next(&script) % 16;
        if (what < 3) {
            rule(&script, &signals);
        } else if (what < 6) {
            take(&script, &signals, clock.system_us);
        } else if (what < 7) {
            take_raw(&script, &signals, clock.system_us);
            plan(&script, clock.system_us);
        } else if (what < 8 && next(&script) % 4 != 0) {
            hear(&script, &signals, clock.system_us);
        } else if (what < 8 &&
                   next(&script) % 2) { // the clock steps, which no output lives through
            clock.system_us -= 64 * next(&script);
            signals_step(&signals, &board, &clock, 1000, false);
        } else if (what < 8) {
            clock.rate_q32 = next_word(&script) % CLOCK_RATE_MAX_Q32;
        } else if (what < 9) {
            signals_restart(&signals);
        } else {
            for (int32_t i = 0; i < SOURCE_OF_PIECES; i++)
                signals.values[i] = next_word(&script);
            signals.values[INPUT_STATE] = next_word(&script);
            for (int32_t periods = next(&script) % 32; periods >= 0; periods--) {
                int64_t since_us = 1000 + (what == 10 ? 16 * next(&script) : 0); // a late period
                clock.system_us += since_us;
                clock.count_us += (uint32_t)since_us;
                board_advance(&board, board.true_us + since_us);
                signals_recall(&signals, tracks, clock.system_us, FUZZ_SHIFT);
                signals_step(&signals, &board, &clock, 1000, what != 9);
                promise_past(&signals, clock.system_us);
                give(&signals, clock.system_us);
                for (int32_t i = 0; i < REPORT_TRACKS; i++)
                    PROMISE(signals.values[SOURCE_OF_PIECES + i] ==
                            pieces_at(&signals.tracks[i], clock.system_us));
                if (signals.ruled && what != 9)
                    promise_outputs(&signals, &board, clock.system_us);
                PROMISE(what != 9 || signals_idle(&signals) == !signals.used);
                PROMISE((signals.ruled && what != 9) || (signals.on == 0 && board.pwm_q15[0] == 0));
            }
        }
        promise(&signals);
    }
    return 0;
}
