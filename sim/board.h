// The simulated board: what firmware/board.h asks for, without hardware. It lives beside the device
// in MuJoCo's plugin state, so one struct of plain numbers is all there is to save and restore.
#ifndef HEADWAY_SIM_BOARD_H
#define HEADWAY_SIM_BOARD_H

#include "cobs.h"
#include "device.h"
#include "oscillator.h"

#define BOARD_PACKET_MAX COBS_BOUND(FRAME_MAX)
#define BOARD_INBOX 16
#define BOARD_OUTBOX 16
#define BOARD_FLIPS 256 // twice those of all outputs that may wait

struct parcel {
    int64_t time_us; // arrival or departure, true time
    int32_t size;    // 0: empty
    int32_t port;
    uint8_t bytes[BOARD_PACKET_MAX];
};

// Non-volatile: it outlives a reset.
struct memory {
    int32_t size;
    uint8_t bytes[BOARD_RECORD_MAX];
};

// What is wrong with the encoder, from `since_us` on.
enum encoder_defect { ENCODER_GOOD, ENCODER_STUCK, ENCODER_REVERSED, ENCODER_SPIKE };
struct encoder_fault {
    int32_t defect; // enum encoder_defect
    int64_t since_us;
    int32_t at_count; // when it set in
    int32_t begun;
};

// Pulses of a window, as the board was told.
struct pulse_train {
    uint32_t count_us;
    int32_t steps;
    uint32_t first_q16, spacing_q16;
};

// Of a stepper's board. The ring is longer than the trains that are not over can be.
#define BOARD_TRAINS 4
struct stepping {
    int32_t used;    // there is a stepper
    int32_t over;    // steps of trains that are no longer in the ring
    uint32_t trains; // ever
    struct pulse_train ring[BOARD_TRAINS];
};

// A change of a digital output, also one to come.
#define FLIP_FORGOTTEN -1 // its output: it does not come
struct flip {
    int64_t time_us; // true time
    int32_t output, on;
};

// Starts of the frames of the bus that the board is at (sim/bus.py).
struct frame_clock {
    int64_t period_ps; // 0: no bus
    int64_t next_us;   // true time of the next start, and what it is later than that
    int64_t next_ps;
    uint32_t next_number;
    uint32_t begun; // there has been one
    uint64_t random;
};

struct board {
    int64_t true_us; // the simulator's own time; the device sees only its counter
    struct oscillator oscillator;
    struct frame_clock bus;
    uint32_t sof_number; // of the last start of a frame, 11 bits ...
    uint32_t sof_count;  // ... and the count at it, as the hardware caught it
    int32_t encoder_count;
    int32_t encoder_offset; // what an incremental encoder does not know
    int32_t duty_q15;
    int32_t power;
    int32_t brake;       // as the device sets it
    int64_t brake_us;    // when it was last changed
    double brake_anchor; // joint position at which the brake engaged
    int32_t brake_anchored;
    int32_t chopper;
    double supply_V;      // of the bridge, as the plant has it
    double current_A;     // of the motor
    double capacitance_F; // of the bridge; 0: the supply takes back what the motor feeds back
    double feed_V;        // what the supply would be without load
    int32_t stop_line;    // the emergency line is open
    int32_t switch_from, switch_to; // true counts at which the home switch is on
    int32_t switch_every;           // true counts from one such place to the next, 0: there is one
    int32_t home_switch;
    int32_t index_every; // true counts from one index pulse to the next, 0: none
    int32_t index_at;    // true count of one of them
    int32_t true_count;  // of the last step
    int32_t indexed;     // an index pulse waits to be read
    int32_t index_count;
    struct encoder_fault encoder_fault;
    struct stepping stepping;
    int32_t hung;       // the main loop: only interrupts run
    uint8_t digital_in; // bit i: input i is on
    int32_t pwm_q15[BOARD_PWM];
    uint32_t flips; // changes of digital outputs, ever; the ring holds the last BOARD_FLIPS
    struct flip flip[BOARD_FLIPS];
    uint64_t random;
    uint32_t dropped; // packets that found the inbox or outbox full
    struct memory memory[RECORDS];
    struct parcel inbox[BOARD_INBOX];
    struct parcel outbox[BOARD_OUTBOX];
};

// The encoder as the device gets to see it, from the true count.
void board_set_encoder(struct board *board, int32_t count);

// A device and its board.
struct node {
    struct device device;
    struct board board;
};

// Time goes on.
void board_advance(struct board *board, int64_t true_us);

// What a board runs by itself at one instant: the guard's timer and, unless it hangs, the main loop.
void node_run(struct node *node);

// Steps that have been given at a count, modulo 2^32; at one that is not too long past.
int32_t board_steps(const struct board *board, uint32_t count_us);

// Count of the local oscillator at a true time.
uint32_t board_count_at(const struct board *board, int64_t true_us);

// Puts a packet into the inbox, to arrive at a true time; false if it is full or too long.
bool board_deliver(struct board *board, int32_t port, int64_t arrival_us, const uint8_t *bytes,
                   int32_t size);

#endif
