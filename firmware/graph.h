// The logic: a few nodes that make values of other values, once a servo period, in their order.
//
// A node reads tracks, inputs and nodes before it; so there is no cycle. Truth is 1, anything but 0 is
// true. A host that writes nodes in any order sorts them first.
#ifndef HEADWAY_GRAPH_H
#define HEADWAY_GRAPH_H

#include <stdbool.h>
#include <stdint.h>

#define GRAPH_NODES 16

// Where values are from. The first are tracks: of motion, then of pieces.
enum graph_source {
    SOURCE_OF_TRACKS = 0,
    SOURCE_OF_PIECES = 5,
    SOURCE_OF_INPUTS = 16,
    INPUT_POSITION = SOURCE_OF_INPUTS, // measured [counts]
    INPUT_ERROR,                       // following error [pq]
    INPUT_TORQUE,                      // [tq]
    INPUT_SUPPLY,                      // [mV]
    INPUT_STATE,                       // enum device_state
    INPUT_DIGITAL,                     // and three more: the board's digital inputs
    INPUT_LAG = INPUT_DIGITAL + 4,     // of tracks from other boards [ms], see feed.h
    INPUTS_END,
    SOURCE_OF_NODES = 32,
    GRAPH_VALUES = SOURCE_OF_NODES + GRAPH_NODES,
    SOURCE_UNUSED = 255,
};

enum node_kind {
    NODE_ADD,      // a + b, within 32 bits
    NODE_MULTIPLY, // a b / 2^16, rounded down, within 32 bits
    NODE_COMPARE,  // turns true above `high`, false below `low`: a hysteresis
    NODE_WINDOW,   // low <= a <= high
    NODE_GATE,     // a while b is true, else 0
    NODE_EDGE,     // true in the period in which a turns true
    NODE_PAST,     // a, a track, `low` microseconds ago; where it does not reach back to, `high`
    NODE_KINDS,
};

struct logic_node {
    uint8_t kind; // enum node_kind
    uint8_t a, b; // sources; b only of ADD, MULTIPLY, GATE
    int32_t low, high;
};

enum graph_result {
    GRAPH_GOOD,
    GRAPH_KIND,    // there is no such kind
    GRAPH_MISSING, // an input that is not there, or of which nobody keeps the past
    GRAPH_CYCLE,   // reads itself or a node after it; a track of a feed of its own
    GRAPH_LIMITS,  // low is above high; a past that no track reaches back to
};

struct graph {
    uint8_t count;
    uint16_t held; // bit i: node i was true (COMPARE), its input was (EDGE)
    struct logic_node nodes[GRAPH_NODES];
};

bool source_exists(uint8_t source, int32_t nodes);

// The first node that is wrong, and why. There are at most GRAPH_NODES. A track of motion reaches back
// by so many knots as it has points, knots of 2^knot_shift us.
enum graph_result graph_check(const struct logic_node *nodes, int32_t count, int32_t knot_shift,
                              int32_t *wrong);

// One servo period: values of tracks, inputs and the past are given, those of the other nodes are found.
void graph_step(struct graph *graph, int32_t values[GRAPH_VALUES]);

#endif
