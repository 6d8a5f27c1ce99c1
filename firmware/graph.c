#include "graph.h"
#include "fixed.h" // clamp
#include "near.h"
#include "track.h" // its past

static bool reads_two(uint8_t kind) {
    return kind == NODE_ADD || kind == NODE_MULTIPLY || kind == NODE_GATE;
}

bool source_exists(uint8_t source, int32_t nodes) {
    return source < INPUTS_END || (source >= SOURCE_OF_NODES && source < SOURCE_OF_NODES + nodes);
}

static enum graph_result check_source(uint8_t source, int32_t at, int32_t count) {
    if (!source_exists(source, count))
        return GRAPH_MISSING;
    return source >= SOURCE_OF_NODES + at ? GRAPH_CYCLE : GRAPH_GOOD;
}

// Only tracks have one.
static enum graph_result check_past(const struct logic_node *node, int32_t knot_shift) {
    if (node->a >= SOURCE_OF_INPUTS)
        return GRAPH_MISSING;
    bool too_long = node->a < SOURCE_OF_PIECES && node->low > TRACK_PAST_KNOTS << knot_shift;
    return node->low < 0 || too_long ? GRAPH_LIMITS : GRAPH_GOOD;
}

static enum graph_result check_node(const struct logic_node *node, int32_t at, int32_t count,
                                    int32_t knot_shift) {
    if (node->kind >= NODE_KINDS)
        return GRAPH_KIND;
    if (node->kind == NODE_PAST)
        return check_past(node, knot_shift);
    if (node->low > node->high)
        return GRAPH_LIMITS;
    enum graph_result result = check_source(node->a, at, count);
    if (result == GRAPH_GOOD && reads_two(node->kind))
        result = check_source(node->b, at, count);
    return result;
}

enum graph_result graph_check(const struct logic_node *nodes, int32_t count, int32_t knot_shift,
                              int32_t *wrong) {
    for (*wrong = 0; *wrong < count; ++*wrong) {
        enum graph_result result = check_node(&nodes[*wrong], *wrong, count, knot_shift);
        if (result != GRAPH_GOOD)
            return result;
    }
    return GRAPH_GOOD;
}

// Truths of numbers; low is not above high.
static inline bool is_above(const struct logic_node *node, int32_t a, bool was) {
    return a > node->high || (was && a >= node->low);
}

static inline bool is_within(const struct logic_node *node, int32_t a) {
    return a >= node->low && a <= node->high;
}

static int32_t evaluate(const struct logic_node *node, const int32_t *values, bool was) {
    int32_t a = values[node->a];
    switch (node->kind) {
    case NODE_ADD:
        return fixed_clamp64((int64_t)a + values[node->b], INT32_MAX);
    case NODE_MULTIPLY:
        return fixed_clamp64(((int64_t)a * values[node->b]) >> 16, INT32_MAX);
    case NODE_COMPARE:
        return is_above(node, a, was);
    case NODE_WINDOW:
        return is_within(node, a);
    case NODE_GATE:
        return values[node->b] != 0 ? a : 0;
    default: // EDGE
        return a != 0 && !was;
    }
}

static inline uint32_t hold(uint32_t held, uint32_t bit, bool truth) {
    return truth ? held | bit : held & ~bit;
}

// From the first node on that is more than a truth of a number; returns what is held. Apart, and
// called once: what a loop calls would take registers that it needs.
static APART uint32_t go_on(const struct graph *graph, int32_t *values, int32_t first,
                            uint32_t held) {
    for (int32_t i = first; i < graph->count; i++) {
        const struct logic_node *node = &graph->nodes[i];
        int32_t *value = &values[SOURCE_OF_NODES + i];
        uint32_t bit = 1u << i;
        if (node->kind != NODE_PAST) // that stands there already
            *value = evaluate(node, values, held & bit);
        held = hold(held, bit, (node->kind == NODE_EDGE ? values[node->a] : *value) != 0);
    }
    return held;
}

void graph_step(struct graph *graph, int32_t values[GRAPH_VALUES]) {
    const struct logic_node *node = graph->nodes, *end = node + graph->count;
    int32_t *out = values + SOURCE_OF_NODES;
    uint32_t held = graph->held;
    for (uint32_t bit = 1; node != end; node++, bit <<= 1) {
        int32_t a = values[node->a];
        bool truth;
        if (node->kind == NODE_COMPARE) {
            truth = is_above(node, a, held & bit);
        } else if (node->kind == NODE_WINDOW) {
            truth = is_within(node, a);
        } else {
            held = go_on(graph, values, (int32_t)(node - graph->nodes), held);
            break;
        }
        *out++ = truth;
        held = hold(held, bit, truth);
    }
    graph->held = (uint16_t)held;
}
