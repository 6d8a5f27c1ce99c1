// The payload of a LOGIC frame: nodes, what outputs follow, what is read and when, what is given to other
// boards and taken from them. All of it holds from then on, or nothing.
//
//     number u32, nodes u8; each: kind u8, a u8, b u8, low i32, high i32
//     digital outputs u8 each, PWM outputs u8 each: sources, 255: none
//     triggers u8; each: kind u8, source u8, condition u8, every u16
//     feeds u8; each: kind u8, source u8, number u16, every u16, after_us u16
//     fed tracks u8; each: track u8, number of the feed u16
#ifndef HEADWAY_LOGIC_H
#define HEADWAY_LOGIC_H

#include "board.h" // outputs
#include "graph.h"

#define LOGIC_TRIGGERS 4
#define LOGIC_FEEDS 4 // each way

enum trigger_kind {
    TRIGGER_INTERVAL, // each `every` periods
    TRIGGER_EDGE,     // when the condition turns true
    TRIGGER_WINDOW,   // at once and each `every` periods while it is true
    TRIGGER_KINDS,
};

struct trigger {
    uint8_t kind;              // enum trigger_kind
    uint8_t source, condition; // what is read, and when
    uint16_t every;            // servo periods
};

enum feed_kind {
    FEED_RAMP, // a point each time; straight lines lead from one to the next
    FEED_STEP, // a point where the value changes
    FEED_KINDS,
};

// A value that other boards are given (feed.h).
struct feed {
    uint8_t kind; // enum feed_kind
    uint8_t source;
    uint16_t number;   // among all of the machine: the host sees to it
    uint16_t every;    // servo periods from one frame to the next
    uint16_t after_us; // its time, until a value holds at the others
};

struct fed {
    uint8_t track; // of pieces: a source
    uint16_t feed; // number
};

struct logic {
    uint32_t number; // of the host's, from 1 on
    uint8_t nodes;
    struct logic_node node[GRAPH_NODES];
    uint8_t digital[BOARD_DIGITAL], pwm[BOARD_PWM]; // sources
    uint8_t triggers;
    struct trigger trigger[LOGIC_TRIGGERS];
    uint8_t feeds, feds;
    struct feed feed[LOGIC_FEEDS];
    struct fed fed[LOGIC_FEEDS];
};

// What is wrong, and with which: nodes are counted first, then outputs, triggers, feeds and fed tracks.
enum graph_result logic_check(const struct logic *logic, int32_t knot_shift, int32_t *wrong);

// The size, or -1 if it does not fit; false if malformed (then the output is undefined).
int32_t logic_encode(const struct logic *logic, uint8_t *payload, int32_t capacity);
bool logic_decode(const uint8_t *payload, int32_t size, struct logic *logic);

#endif
