#include "board.h"
#include <string.h>

uint32_t board_count_at(const struct board *board, int64_t true_us) {
    int64_t billion = 1000000000;
    int64_t drift_us = true_us / billion * board->drift_ppb + // in two parts: no overflow
                       true_us % billion * board->drift_ppb / billion;
    return (uint32_t)(uint64_t)(board->count_offset + true_us + drift_us);
}

uint32_t board_count_us(const struct board *board) { return board_count_at(board, board->true_us); }

int32_t board_encoder_count(const struct board *board) { return board->encoder_count; }

void board_set_duty(struct board *board, int32_t duty_q15) { board->duty_q15 = duty_q15; }

void board_set_brake(struct board *board, bool engaged) { board->brake = engaged; }

static bool fill(struct parcel *parcels, int32_t count, int64_t time_us, const uint8_t *bytes,
                 int32_t size) {
    for (int32_t i = 0; i < count; i++) {
        if (parcels[i].size != 0)
            continue;
        if (size <= 0 || size > (int32_t)sizeof parcels[i].bytes)
            return false;
        parcels[i].time_us = time_us;
        parcels[i].size = size;
        memcpy(parcels[i].bytes, bytes, (size_t)size);
        return true;
    }
    return false;
}

bool board_deliver(struct board *board, int64_t arrival_us, const uint8_t *bytes, int32_t size) {
    bool taken = fill(board->inbox, BOARD_INBOX, arrival_us, bytes, size);
    board->dropped += !taken;
    return taken;
}

int32_t board_receive(struct board *board, uint8_t *bytes, int32_t capacity, uint32_t *count_us) {
    struct parcel *next = 0; // the earliest that has arrived
    for (int32_t i = 0; i < BOARD_INBOX; i++) {
        struct parcel *parcel = &board->inbox[i];
        if (parcel->size != 0 && parcel->time_us <= board->true_us &&
            (!next || parcel->time_us < next->time_us))
            next = parcel;
    }
    if (!next)
        return 0;
    int32_t size = next->size;
    next->size = 0;
    if (size > capacity)
        return 0;
    memcpy(bytes, next->bytes, (size_t)size);
    *count_us = board_count_at(board, next->time_us);
    return size;
}

void board_send(struct board *board, const uint8_t *bytes, int32_t size) {
    board->dropped += !fill(board->outbox, BOARD_OUTBOX, board->true_us, bytes, size);
}
