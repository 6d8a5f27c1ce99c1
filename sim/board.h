// The simulated board: what firmware/board.h asks for, without hardware. It lives beside the device
// in MuJoCo's plugin state, so one struct of plain numbers is all there is to save and restore.
#ifndef HEADWAY_SIM_BOARD_H
#define HEADWAY_SIM_BOARD_H

#include "cobs.h"
#include "device.h"

#define BOARD_PACKET_MAX COBS_BOUND(FRAME_MAX)
#define BOARD_INBOX 16
#define BOARD_OUTBOX 8

struct parcel {
    int64_t time_us; // arrival or departure, true time
    int32_t size;    // 0: empty
    uint8_t bytes[BOARD_PACKET_MAX];
};

struct board {
    int64_t true_us;      // the simulator's own time; the device sees only its counter
    int64_t count_offset; // counter at true time 0
    int32_t drift_ppb;    // of the counter's oscillator
    int32_t encoder_count;
    int32_t duty_q15;
    int32_t brake;
    double brake_anchor; // joint position at which the brake engaged
    int32_t brake_anchored;
    uint32_t dropped; // packets that found the inbox or outbox full
    struct parcel inbox[BOARD_INBOX];
    struct parcel outbox[BOARD_OUTBOX];
};

// A device and its board.
struct node {
    struct device device;
    struct board board;
};

// Count of the local oscillator at a true time.
uint32_t board_count_at(const struct board *board, int64_t true_us);

// Puts a packet into the inbox, to arrive at a true time; false if it is full or too long.
bool board_deliver(struct board *board, int64_t arrival_us, const uint8_t *bytes, int32_t size);

#endif
