#include "logic.h"
#include "fields.h"
#include <string.h>

static enum graph_result check_trigger(const struct trigger *trigger, int32_t nodes) {
    bool asks = trigger->kind != TRIGGER_INTERVAL;
    if (trigger->kind >= TRIGGER_KINDS)
        return GRAPH_KIND;
    if (!source_exists(trigger->source, nodes))
        return GRAPH_MISSING;
    if (asks && !source_exists(trigger->condition, nodes))
        return GRAPH_MISSING;
    return trigger->kind != TRIGGER_EDGE && trigger->every == 0 ? GRAPH_LIMITS : GRAPH_GOOD;
}

// Its number is its own.
static enum graph_result check_feed(const struct logic *logic, int32_t at) {
    const struct feed *feed = &logic->feed[at];
    if (feed->kind >= FEED_KINDS)
        return GRAPH_KIND;
    if (!source_exists(feed->source, logic->nodes))
        return GRAPH_MISSING;
    for (int32_t i = 0; i < at; i++)
        if (logic->feed[i].number == feed->number)
            return GRAPH_LIMITS;
    return feed->every == 0 ? GRAPH_LIMITS : GRAPH_GOOD;
}

// A track has one producer, which is another board.
static enum graph_result check_fed(const struct logic *logic, int32_t at) {
    const struct fed *fed = &logic->fed[at];
    if (fed->track < SOURCE_OF_PIECES || fed->track >= SOURCE_OF_INPUTS)
        return GRAPH_MISSING;
    for (int32_t i = 0; i < at; i++)
        if (logic->fed[i].track == fed->track)
            return GRAPH_LIMITS;
    for (int32_t i = 0; i < logic->feeds; i++)
        if (logic->feed[i].number == fed->feed)
            return GRAPH_CYCLE;
    return GRAPH_GOOD;
}

enum graph_result logic_check(const struct logic *logic, int32_t knot_shift, int32_t *wrong) {
    enum graph_result result = graph_check(logic->node, logic->nodes, knot_shift, wrong);
    for (int32_t i = 0; i < BOARD_DIGITAL + BOARD_PWM && result == GRAPH_GOOD; i++) {
        uint8_t source = i < BOARD_DIGITAL ? logic->digital[i] : logic->pwm[i - BOARD_DIGITAL];
        if (source != SOURCE_UNUSED && !source_exists(source, logic->nodes))
            return GRAPH_MISSING;
        ++*wrong;
    }
    for (int32_t i = 0; i < logic->triggers && result == GRAPH_GOOD; i++) {
        result = check_trigger(&logic->trigger[i], logic->nodes);
        *wrong += result == GRAPH_GOOD;
    }
    for (int32_t i = 0; i < logic->feeds && result == GRAPH_GOOD; i++) {
        result = check_feed(logic, i);
        *wrong += result == GRAPH_GOOD;
    }
    for (int32_t i = 0; i < logic->feds && result == GRAPH_GOOD; i++) {
        result = check_fed(logic, i);
        *wrong += result == GRAPH_GOOD;
    }
    return result;
}

static void visit(struct fields *f, struct logic *logic) {
    field_u32(f, &logic->number);
    field_u8(f, &logic->nodes);
    f->failed |= logic->nodes > GRAPH_NODES;
    for (int32_t i = 0; i < logic->nodes && !f->failed; i++) {
        field_u8(f, &logic->node[i].kind);
        field_u8(f, &logic->node[i].a);
        field_u8(f, &logic->node[i].b);
        field_i32(f, &logic->node[i].low);
        field_i32(f, &logic->node[i].high);
    }
    field_bytes(f, logic->digital, BOARD_DIGITAL);
    field_bytes(f, logic->pwm, BOARD_PWM);
    field_u8(f, &logic->triggers);
    f->failed |= logic->triggers > LOGIC_TRIGGERS;
    for (int32_t i = 0; i < logic->triggers && !f->failed; i++) {
        field_u8(f, &logic->trigger[i].kind);
        field_u8(f, &logic->trigger[i].source);
        field_u8(f, &logic->trigger[i].condition);
        field_u16(f, &logic->trigger[i].every);
    }
    field_u8(f, &logic->feeds);
    f->failed |= logic->feeds > LOGIC_FEEDS;
    for (int32_t i = 0; i < logic->feeds && !f->failed; i++) {
        field_u8(f, &logic->feed[i].kind);
        field_u8(f, &logic->feed[i].source);
        field_u16(f, &logic->feed[i].number);
        field_u16(f, &logic->feed[i].every);
        field_u16(f, &logic->feed[i].after_us);
    }
    field_u8(f, &logic->feds);
    f->failed |= logic->feds > LOGIC_FEEDS;
    for (int32_t i = 0; i < logic->feds && !f->failed; i++) {
        field_u8(f, &logic->fed[i].track);
        field_u16(f, &logic->fed[i].feed);
    }
}

int32_t logic_encode(const struct logic *logic, uint8_t *payload, int32_t capacity) {
    struct fields f = {.out = {payload, capacity, 0, false}};
    struct logic copy = *logic; // visited, so not const
    visit(&f, &copy);
    return f.failed || f.out.failed ? -1 : f.out.size;
}

bool logic_decode(const uint8_t *payload, int32_t size, struct logic *logic) {
    struct fields f = {.in = {payload, size, 0, false}, .reading = true};
    memset(logic, 0, sizeof *logic);
    visit(&f, logic);
    return !f.failed && !f.in.failed && f.in.at == size;
}
