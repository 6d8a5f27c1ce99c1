#include "graph.h"
#include "fixed.h" // clamp
#include "near.h"

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

static enum graph_result check_node(const struct logic_node *node, int32_t at, int32_t count) {
    if (node->kind >= NODE_KINDS)
        return GRAPH_KIND;
    if (node->low > node->high)
        return GRAPH_LIMITS;
    enum graph_result result = check_source(node->a, at, count);
    if (result == GRAPH_GOOD && reads_two(node->kind))
        result = check_source(node->b, at, count);
    return result;
}

enum graph_result graph_check(const struct logic_node *nodes, int32_t count, int32_t *wrong) {
    for (*wrong = 0; *wrong < count; ++*wrong) {
        enum graph_result result = check_node(&nodes[*wrong], *wrong, count);
        if (result != GRAPH_GOOD)
            return result;
    }
    return GRAPH_GOOD;
}

static int32_t evaluate(const struct logic_node *node, const int32_t *values, bool held) {
    int32_t a = values[node->a];
    switch (node->kind) {
    case NODE_ADD:
        return fixed_clamp64((int64_t)a + values[node->b], INT32_MAX);
    case NODE_MULTIPLY:
        return fixed_clamp64(((int64_t)a * values[node->b]) >> 16, INT32_MAX);
    case NODE_COMPARE:
        return a > node->high || (held && a >= node->low);
    case NODE_WINDOW:
        return a >= node->low && a <= node->high;
    case NODE_GATE:
        return values[node->b] != 0 ? a : 0;
    default: // EDGE
        return a != 0 && !held;
    }
}

APART void graph_step(struct graph *graph, int32_t values[GRAPH_VALUES]) {
    const struct logic_node *node = graph->nodes;
    uint32_t held = graph->held, bit = 1;
    for (int32_t i = 0; i < graph->count; i++, node++, bit <<= 1) {
        int32_t value = evaluate(node, values, held & bit);
        bool holds = node->kind == NODE_EDGE ? values[node->a] != 0 : value != 0;
        held = holds ? held | bit : held & ~bit;
        values[SOURCE_OF_NODES + i] = value;
    }
    graph->held = (uint16_t)held;
}
