#include "board.h"
#include "fixed.h" // counts modulo 2^32
#include <string.h>

#define SOF_JITTER_PS 100000 // a choice: from the wire to a timer's capture
#define SOF_NUMBERS 2048     // 11 bits (USB 2.0, section 8.4.3)
#define PS_PER_US 1000000

// The starts of frames up to now. They are caught by hardware, so the count is that of their moment.
static void pass_frames(struct board *board) {
    struct frame_clock *bus = &board->bus;
    while (bus->period_ps > 0 && bus->next_us + (bus->next_ps > 0) <= board->true_us) {
        int64_t late_ps = bus->next_ps + (int64_t)(splitmix64(&bus->random) % SOF_JITTER_PS);
        board->sof_count = board_count_at(board, bus->next_us + late_ps / PS_PER_US);
        board->sof_number = bus->next_number;
        bus->begun = true;
        bus->next_number = (bus->next_number + 1) % SOF_NUMBERS;
        int64_t next_ps = bus->next_ps + bus->period_ps;
        bus->next_us += next_ps / PS_PER_US;
        bus->next_ps = next_ps % PS_PER_US;
    }
}

bool board_frame_start(const struct board *board, uint16_t *number, uint32_t *count_us) {
    *number = (uint16_t)board->sof_number;
    *count_us = board->sof_count;
    return board->bus.begun;
}

void board_advance(struct board *board, int64_t true_us) {
    board->true_us = true_us;
    oscillator_seek(&board->oscillator, true_us);
    pass_frames(board);
}

uint32_t board_count_at(const struct board *board, int64_t true_us) {
    return (uint32_t)(uint64_t)oscillator_read(&board->oscillator, true_us);
}

void node_run(struct node *node) {
    device_guard(&node->device, &node->board);
    if (!node->board.hung)
        device_poll(&node->device, &node->board);
}

uint32_t board_count_us(const struct board *board) { return board_count_at(board, board->true_us); }

int32_t board_encoder_count(const struct board *board) {
    return board->stepping.used ? board_steps(board, board_count_us(board)) : board->encoder_count;
}

void board_set_duty(struct board *board, int32_t duty_q15) { board->duty_q15 = duty_q15; }

// As the current comes on the driver takes the phase at which the rotor is; steps count from there.
void board_set_power(struct board *board, bool on) {
    if (on && !board->power && board->stepping.used) {
        int32_t steps = board_steps(board, board_count_us(board));
        board->encoder_offset = fixed_difference(board->true_count, steps);
    }
    board->power = on;
}

static uint64_t passed(const struct pulse_train *train, uint32_t count_us) {
    int32_t since_us = (int32_t)(count_us - train->count_us);
    int64_t since_q16 = (int64_t)since_us * 65536 - train->first_q16;
    return since_us < 0 || since_q16 < 0 ? 0 : (uint64_t)since_q16 / train->spacing_q16 + 1;
}

static int32_t steps_of(const struct pulse_train *train, uint32_t count_us) {
    if (train->steps == 0)
        return 0;
    int32_t all = train->steps < 0 ? -train->steps : train->steps;
    uint64_t given = passed(train, count_us);
    int32_t steps = given < (uint64_t)all ? (int32_t)given : all;
    return train->steps < 0 ? -steps : steps;
}

int32_t board_steps(const struct board *board, uint32_t count_us) {
    int32_t steps = board->stepping.over;
    for (int32_t i = 0; i < BOARD_TRAINS; i++)
        steps = fixed_sum(steps, steps_of(&board->stepping.ring[i], count_us));
    return steps;
}

void board_step(struct board *board, uint32_t count_us, int32_t steps, uint32_t first_q16,
                uint32_t spacing_q16) {
    struct stepping *stepping = &board->stepping;
    struct pulse_train *train = &stepping->ring[stepping->trains++ % BOARD_TRAINS];
    stepping->over = fixed_sum(stepping->over, train->steps);
    *train = (struct pulse_train){count_us, steps, first_q16, spacing_q16};
}

void board_set_brake(struct board *board, bool engaged) {
    if (board->brake != engaged)
        board->brake_us = board->true_us;
    board->brake = engaged;
}

static void forget_flips(struct board *board, int32_t output) {
    for (int32_t i = 0; i < BOARD_FLIPS; i++)
        if (board->flip[i].output == output && board->flip[i].time_us > board->true_us)
            board->flip[i].output = FLIP_FORGOTTEN;
}

// A count to come is a timer's, which changes the output by itself. It is so near that the counter's
// drift until then changes by far less than a microsecond.
void board_set_digital(struct board *board, int32_t output, bool on, uint32_t count_us) {
    int32_t ahead_us = (int32_t)(count_us - board_count_us(board));
    int64_t time_us = board->true_us;
    if (ahead_us <= 0)
        forget_flips(board, output);
    else
        time_us += ahead_us - (int32_t)(board_count_at(board, time_us + ahead_us) - count_us);
    board->flip[board->flips++ % BOARD_FLIPS] = (struct flip){time_us, output, on};
}

void board_set_pwm(struct board *board, int32_t output, int32_t duty_q15) {
    board->pwm_q15[output] = duty_q15;
}

uint8_t board_digital_inputs(const struct board *board) { return board->digital_in; }

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

uint64_t board_random(struct board *board) { return splitmix64(&board->random); }

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

static bool fill(struct parcel *parcels, int32_t count, int32_t port, int64_t time_us,
                 const uint8_t *bytes, int32_t size) {
    for (int32_t i = 0; i < count; i++) {
        if (parcels[i].size != 0)
            continue;
        if (size <= 0 || size > (int32_t)sizeof parcels[i].bytes)
            return false;
        parcels[i].time_us = time_us;
        parcels[i].size = size;
        parcels[i].port = port;
        memcpy(parcels[i].bytes, bytes, (size_t)size);
        return true;
    }
    return false;
}

bool board_deliver(struct board *board, int32_t port, int64_t arrival_us, const uint8_t *bytes,
                   int32_t size) {
    bool taken = fill(board->inbox, BOARD_INBOX, port, arrival_us, bytes, size);
    board->dropped += !taken;
    return taken;
}

int32_t board_receive(struct board *board, uint8_t *bytes, int32_t capacity, int32_t *port,
                      uint32_t *count_us) {
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
    *port = next->port;
    *count_us = board_count_at(board, next->time_us);
    return size;
}

void board_send(struct board *board, int32_t port, const uint8_t *bytes, int32_t size) {
    board->dropped += !fill(board->outbox, BOARD_OUTBOX, port, board->true_us, bytes, size);
}
