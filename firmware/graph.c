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

// Of what makes numbers, or looks at edges. Apart, and called: most nodes compare.
static APART int32_t evaluate(const struct logic_node *node, const int32_t *values, bool held) {
    int32_t a = values[node->a];
    switch (node->kind) {
    case NODE_ADD:
        return fixed_clamp64((int64_t)a + values[node->b], INT32_MAX);
    case NODE_MULTIPLY:
        return fixed_clamp64(((int64_t)a * values[node->b]) >> 16, INT32_MAX);
    case NODE_GATE:
        return values[node->b] != 0 ? a : 0;
    default: // EDGE
        return a != 0 && !held;
    }
}

void graph_step(struct graph *graph, int32_t values[GRAPH_VALUES]) {
    const struct logic_node *node = graph->nodes, *end = node + graph->count;
    int32_t *out = values + SOURCE_OF_NODES;
    uint32_t held = graph->held;
    for (uint32_t bit = 1; node != end; node++, bit <<= 1) {
        uint32_t was = held & bit;
        int32_t a = values[node->a], value;
        held -= was;
        if (node->kind == NODE_COMPARE)
            value = a > node->high || (was && a >= node->low);
        else if (node->kind == NODE_WINDOW)
            value = a >= node->low && a <= node->high;
        else if (node->kind == NODE_PAST)
            value = *out; // stands there already
        else
            value = evaluate(node, values, was);
        *out++ = value;
        if (node->kind == NODE_EDGE ? a != 0 : value != 0)
            held += bit;
    }
    graph->held = (uint16_t)held;
}
