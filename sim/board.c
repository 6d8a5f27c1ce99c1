#include "board.h"
#include "fixed.h" // counts modulo 2^32
#include <string.h>

uint32_t board_count_at(const struct board *board, int64_t true_us) {
    int64_t billion = 1000000000;
    int64_t drift_us = true_us / billion * board->drift_ppb + // in two parts: no overflow
                       true_us % billion * board->drift_ppb / billion;
    return (uint32_t)(uint64_t)(board->count_offset + true_us + drift_us);
}

void node_run(struct node *node) {
    device_guard(&node->device, &node->board);
    if (!node->board.hung)
        device_poll(&node->device, &node->board);
}

uint32_t board_count_us(const struct board *board) { return board_count_at(board, board->true_us); }

int32_t board_encoder_count(const struct board *board) { return board->encoder_count; }

void board_set_duty(struct board *board, int32_t duty_q15) { board->duty_q15 = duty_q15; }

void board_set_power(struct board *board, bool on) { board->power = on; }

void board_set_brake(struct board *board, bool engaged) {
    if (board->brake != engaged)
        board->brake_us = board->true_us;
    board->brake = engaged;
}

bool board_stop_line(const struct board *board) { return board->stop_line; }

bool board_home_switch(const struct board *board) { return board->home_switch; }

bool board_index(struct board *board, int32_t *count) {
    bool indexed = board->indexed;
    *count = board->index_count;
    board->indexed = false;
    return indexed;
}

int32_t board_supply_mV(const struct board *board) { return (int32_t)(board->supply_V * 1000); }

void board_set_chopper(struct board *board, bool on) { board->chopper = on; }

int32_t board_load(const struct board *board, enum board_record record, uint8_t *bytes,
                   int32_t capacity) {
    const struct memory *memory = &board->memory[record];
    if (memory->size > capacity)
        return 0;
    memcpy(bytes, memory->bytes, (size_t)memory->size);
    return memory->size;
}

void board_save(struct board *board, enum board_record record, const uint8_t *bytes, int32_t size) {
    if (size < 0 || size > BOARD_RECORD_MAX)
        return;
    board->memory[record].size = size;
    memcpy(board->memory[record].bytes, bytes, (size_t)size);
}

uint64_t board_random(struct board *board) { // splitmix64 (Steele, Lea, Flood, 2014)
    uint64_t z = board->random += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return z ^ z >> 31;
}

static int32_t floor_divide(int32_t a, int32_t b) { return a / b - (a % b < 0); }

// The marks that homing looks for are where the axis truly is.
static void pass_marks(struct board *board, int32_t count) {
    if (board->index_every > 0) {
        int32_t every = board->index_every, at = board->index_at;
        int32_t before = floor_divide(fixed_difference(board->true_count, at), every);
        int32_t after = floor_divide(fixed_difference(count, at), every);
        if (before != after) {
            uint32_t mark = (uint32_t)(after > before ? after : before) * (uint32_t)every;
            int32_t true_count = fixed_sum((int32_t)mark, at);
            board->index_count = fixed_difference(true_count, board->encoder_offset);
            board->indexed = true;
        }
    }
    board->true_count = count;
    if (board->switch_every > 0) {
        int32_t turns =
            floor_divide(fixed_difference(count, board->switch_from), board->switch_every);
        uint32_t way = (uint32_t)turns * (uint32_t)board->switch_every;
        count = fixed_difference(count, (int32_t)way);
    }
    board->home_switch = count >= board->switch_from && count < board->switch_to;
}

void board_set_encoder(struct board *board, int32_t count) {
    pass_marks(board, count);
    struct encoder_fault *fault = &board->encoder_fault;
    if (fault->defect != ENCODER_GOOD && board->true_us >= fault->since_us) {
        if (!fault->begun)
            fault->at_count = count;
        fault->begun = true;
        if (fault->defect == ENCODER_STUCK)
            count = fault->at_count;
        else if (fault->defect == ENCODER_REVERSED)
            count = fixed_difference(fault->at_count, fixed_difference(count, fault->at_count));
        else
            count = fixed_sum(count, 1 << 16);
    }
    board->encoder_count = fixed_difference(count, board->encoder_offset);
}

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
