// The payload of a SIGNALS frame: pieces for a device's tracks, and how far the host has its readings.
//
//     base_us i64, seen u32, count u8
//     each piece: track u8, number u32, flags u8 (1: a start, 2: a first value)
//         start varint if it has one, end varint; first value varint if it has one, last value varint
//
// Times are from base_us on. A host repeats what has no answer (report.h); what was taken is not taken
// twice.
#ifndef HEADWAY_BATCH_H
#define HEADWAY_BATCH_H

#include "piece.h"

#define BATCH_PIECES 64

struct batch_piece {
    uint8_t track;   // a source, see graph.h
    uint32_t number; // in its track
    struct wanted_piece piece;
};

struct batch {
    int64_t base_us;
    uint32_t seen; // readings before this number need not be told again
    uint8_t count;
    struct batch_piece pieces[BATCH_PIECES];
};

// The size, or -1 if it does not fit; false if malformed (then the output is undefined).
int32_t batch_encode(const struct batch *batch, uint8_t *payload, int32_t capacity);
bool batch_decode(const uint8_t *payload, int32_t size, struct batch *batch);

#endif
