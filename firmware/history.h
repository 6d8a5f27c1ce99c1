// Encoder samples with their stamps in system time, kept until they have been sent.
#ifndef HEADWAY_HISTORY_H
#define HEADWAY_HISTORY_H

#include <stdint.h>

#define HISTORY_SAMPLES 64 // a power of two

struct sample {
    int64_t time_us;
    int32_t count;
};

struct history {
    uint32_t taken; // samples ever taken; the ring holds the last HISTORY_SAMPLES
    uint32_t sent;  // samples ever sent or overwritten unsent
    uint32_t lost;  // overwritten unsent
    struct sample samples[HISTORY_SAMPLES];
};

void history_push(struct history *history, int64_t time_us, int32_t count);

// Moves up to `capacity` unsent samples, oldest first, into `out`; returns how many.
int32_t history_pop(struct history *history, struct sample *out, int32_t capacity);

#endif
