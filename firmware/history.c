#include "history.h"

void history_push(struct history *history, int64_t time_us, int32_t count) {
    if (history->taken - history->sent == HISTORY_SAMPLES) {
        history->sent++;
        history->lost++;
    }
    history->samples[history->taken++ % HISTORY_SAMPLES] = (struct sample){time_us, count};
}

int32_t history_pop(struct history *history, struct sample *out, int32_t capacity) {
    int32_t count = 0;
    while (count < capacity && history->sent != history->taken)
        out[count++] = history->samples[history->sent++ % HISTORY_SAMPLES];
    return count;
}
