#include "history.h"
#include "near.h" // pointers

void history_push(struct history *history, int64_t time_us, int32_t count) {
    NEAR(history);
    if (history->taken - history->reported >= HISTORY_SAMPLES)
        history->lost++;
    struct sample *sample = &history->samples[history->taken++ % HISTORY_SAMPLES];
    NEAR(sample);
    sample->time_us = time_us;
    sample->count = count;
}

void history_flush(struct history *history) {
    history->reported = history->repeated = history->taken;
}

int32_t history_report(struct history *history, struct sample *out) {
    uint32_t first = history->repeated;
    if (history->taken - first > HISTORY_SAMPLES)
        first = history->taken - HISTORY_SAMPLES;
    int32_t count = 0;
    while (first != history->taken)
        out[count++] = history->samples[first++ % HISTORY_SAMPLES];
    history->repeated = history->reported;
    history->reported = history->taken;
    return count;
}
