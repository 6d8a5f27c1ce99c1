// The board that the emulator has: its inputs are laid down before each call, its outputs lie there
// afterwards. One device and one board, where emulator.py finds them by name.
#include "device.h"
#include <string.h>

#define PACKET_MAX 1100
#define PACKETS 8

struct packet {
    int32_t size, port;
    uint32_t count_us;
    uint8_t bytes[PACKET_MAX];
};

struct board {
    uint32_t count_us;
    int32_t encoder_count;
    int32_t supply_mV;
    int32_t arrived; // packets that wait, in the order of their arrival
    int32_t sent;
    int32_t duty_q15;
    uint32_t outputs; // bits: power, brake, chopper, digital outputs
    uint32_t taken;   // of those that wait
    uint64_t random;  // the next of the generator's numbers
    struct packet in[PACKETS], out[PACKETS];
};

struct device the_device;
struct board the_board;
const uint32_t the_sizes[] = {sizeof(struct device), sizeof(struct board), sizeof(struct packet)};

uint32_t board_count_us(const struct board *board) { return board->count_us; }

int32_t board_encoder_count(const struct board *board) { return board->encoder_count; }

static void set(struct board *board, uint32_t bit, bool on) {
    board->outputs = on ? board->outputs | bit : board->outputs & ~bit;
}

void board_set_power(struct board *board, bool on) { set(board, 1, on); }

void board_set_brake(struct board *board, bool engaged) { set(board, 2, engaged); }

void board_set_chopper(struct board *board, bool on) { set(board, 4, on); }

void board_set_duty(struct board *board, int32_t duty_q15) { board->duty_q15 = duty_q15; }

void board_step(struct board *board, uint32_t count_us, int32_t steps, uint32_t first_q16,
                uint32_t spacing_q16) {
    (void)board, (void)count_us, (void)steps, (void)first_q16, (void)spacing_q16;
}

bool board_stop_line(const struct board *board) { return (void)board, false; }

bool board_home_switch(const struct board *board) { return (void)board, false; }

bool board_index(struct board *board, int32_t *count) { return (void)board, (void)count, false; }

int32_t board_supply_mV(const struct board *board) { return board->supply_mV; }

bool board_frame_start(const struct board *board, uint16_t *number, uint32_t *count_us) {
    return (void)board, (void)number, (void)count_us, false;
}

void board_set_digital(struct board *board, int32_t output, bool on, uint32_t count_us) {
    (void)count_us;
    set(board, 8u << output, on);
}

void board_set_pwm(struct board *board, int32_t output, int32_t duty_q15) {
    (void)board, (void)output, (void)duty_q15;
}

uint8_t board_digital_inputs(const struct board *board) { return (void)board, 0; }

uint64_t board_random(struct board *board) { return board->random; }

int32_t board_receive(struct board *board, uint8_t *bytes, int32_t capacity, int32_t *port,
                      uint32_t *count_us) {
    if ((int32_t)board->taken == board->arrived)
        return 0;
    const struct packet *packet = &board->in[board->taken++];
    if (packet->size > capacity)
        return 0;
    memcpy(bytes, packet->bytes, (size_t)packet->size);
    *port = packet->port;
    *count_us = packet->count_us;
    return packet->size;
}

void board_send(struct board *board, int32_t port, const uint8_t *bytes, int32_t size) {
    if (board->sent == PACKETS || size > PACKET_MAX)
        return;
    struct packet *packet = &board->out[board->sent++];
    packet->size = size;
    packet->port = port;
    memcpy(packet->bytes, bytes, (size_t)size);
}

int32_t board_load(const struct board *board, enum board_record record, uint8_t *bytes,
                   int32_t capacity) {
    return (void)board, (void)record, (void)bytes, (void)capacity, 0;
}

void board_save(struct board *board, enum board_record record, const uint8_t *bytes, int32_t size) {
    (void)board, (void)record, (void)bytes, (void)size;
}

void the_poll(void) {
    device_guard(&the_device, &the_board);
    device_poll(&the_device, &the_board);
}
