// The one board that the judge has: a memory (settings.c), outputs under a timer (guard.c), and ports
// (neighbours.c).
#ifndef HEADWAY_JUDGE_RACK_H
#define HEADWAY_JUDGE_RACK_H

#include "board.h"

struct memory {
    int32_t size;
    uint8_t bytes[BOARD_RECORD_MAX];
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
};

#endif
