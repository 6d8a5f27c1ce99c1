// The one board that the judge has: a memory (settings.c), outputs under a timer (guard.c), ports
// (neighbours.c), and, for a whole device (device.c), an axis with all that a board sees of it.
#ifndef HEADWAY_JUDGE_RACK_H
#define HEADWAY_JUDGE_RACK_H

#include "board.h"

#define RACK_PACKETS 16
#define RACK_PACKET_MAX 1100 // bytes; longer ones are cut

struct memory {
    int32_t size;
    uint8_t bytes[BOARD_RECORD_MAX];
};

struct rack_packet {
    int32_t port, size;
    uint32_t arrived_us;
    uint8_t bytes[RACK_PACKET_MAX];
};

// An axis without inertia: the duty makes its speed. Speeds are 1/65536 counts per us.
struct rack_axis {
    int64_t position_q16; // counts
    int32_t speed_q16;    // at a duty of 32768, while the bridge is on and the brake off
    int32_t pull_q16;     // then, whatever the duty is
    int32_t turn_q16;     // always: somebody turns it
    int64_t wall_q16;     // a stop that it cannot pass ...
    int64_t floor_q16;    // ... and the one at its other end
};

struct board {
    struct memory memory[RECORDS];
    int32_t kept;    // bytes of the next save that the memory takes
    int32_t grown;   // bytes that it adds
    int32_t flipped; // the byte of it whose lowest bit the memory takes wrongly; -1: none
    uint32_t count_us;
    bool line_open, power, brake;
    int32_t duty_q15;
    uint64_t random; // what it draws next

    struct rack_axis axis;
    int32_t encoder_count;
    bool indexed; // and not read yet
    int32_t index_count;
    bool on_switch, chopper, on_bus;
    int32_t supply_mV;
    uint8_t digital_inputs, digital_outputs;
    int32_t pwm_q15[BOARD_PWM];
    uint16_t frame_number;
    uint32_t frame_us;
    struct rack_packet waiting[RACK_PACKETS];
    int32_t packets;      // that wait
    bool collects;        // what is sent, in place of saying it
    int32_t interrupt_at; // the guard comes before the n-th call that sets an output; 0: not
    bool interrupt_opens; // then the emergency line opens just before it
};

// What a device with this board sent, or switched beside its axis; device.c.
void rack_sent(int32_t port, const uint8_t *bytes, int32_t size);
void rack_switched(int32_t output, int32_t value, uint32_t count_us);

void rack_stepped(uint32_t count_us, int32_t steps, uint32_t first_q16, uint32_t spacing_q16);

// The timer's interrupt of the device with this board; device.c.
void rack_interrupt(struct board *board);

// Time goes on, and the axis with it.
void rack_advance(struct board *board, uint32_t step_us);

#endif
