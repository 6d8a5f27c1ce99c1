// The last encoder samples with their stamps in system time. Each is reported twice, in a row, so
// that neither a lost report nor one that comes out of turn costs a sample.
#ifndef HEADWAY_HISTORY_H
#define HEADWAY_HISTORY_H

#include <stdint.h>

#define HISTORY_SAMPLES 32 // a power of two

struct sample {
    int64_t time_us;
    int32_t count;
};

struct history {
    uint32_t taken;    // samples ever taken; the ring holds the last HISTORY_SAMPLES
    uint32_t reported; // of these, how many at the last report
    uint32_t repeated; // and at the one before
    uint32_t lost;     // overwritten before any report
    struct sample samples[HISTORY_SAMPLES];
};

void history_push(struct history *history, int64_t time_us, int32_t count);

// Forgets all samples: their stamps are of another time.
void history_flush(struct history *history);

// Writes the samples since the report before the last, oldest first, into `out`, which has room for
// HISTORY_SAMPLES; returns how many.
int32_t history_report(struct history *history, struct sample *out);

#endif
