// The payload of a READINGS frame: what was sampled, and what has arrived of pieces and logic. One
// leaves with each status once a device has heard of any of them.
//
//     logic u32, result u8, wrong u8; next u32 of each track of pieces, refused u32
//     late u32, gaps u32, kept u32, first u32, count u8, base_us i64; each reading: trigger u8, time varint, value varint
//
// Readings are numbered from 0; what no batch says was seen is told again (reading.h). Before `kept` all
// were seen or overwritten. Times and values are differences, the first time's from base_us.
#ifndef HEADWAY_REPORT_H
#define HEADWAY_REPORT_H

#include "graph.h"
#include "reading.h"
#include <stdbool.h>

#define REPORT_READINGS 48
#define REPORT_TRACKS (SOURCE_OF_INPUTS - SOURCE_OF_PIECES)

struct report {
    uint32_t logic;               // number of the last one that came ...
    uint8_t result, wrong;        // ... and what was wrong, see logic_check
    uint32_t next[REPORT_TRACKS]; // number of the piece that is to come
    uint32_t refused;             // pieces, ever
    uint32_t late;                // of those taken: came after their start
    uint32_t gaps;                // in tracks that come from other boards
    uint32_t kept;                // number of the oldest reading that is left
    uint32_t first;               // number of the first reading here
    uint8_t count;
    struct reading readings[REPORT_READINGS];
};

int32_t report_encode(const struct report *report, uint8_t *payload, int32_t capacity);
bool report_decode(const uint8_t *payload, int32_t size, struct report *report);

#endif
