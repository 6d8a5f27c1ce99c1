// What a board supplies. The device calls these and owns no hardware; `board` is the board's own.
#ifndef HEADWAY_BOARD_H
#define HEADWAY_BOARD_H

#include <stdbool.h>
#include <stdint.h>

struct board;

uint32_t board_count_us(const struct board *board); // free-running microseconds, wraps
int32_t board_encoder_count(const struct board *board);
void board_set_duty(struct board *board, int32_t duty_q15); // PWM duty, +-32767 / 32768
void board_set_brake(struct board *board, bool engaged);

// The next received packet (COBS, without the ending zero) and the count at which it arrived, as
// its interrupt stamped it. Returns its size, 0 if there is none.
int32_t board_receive(struct board *board, uint8_t *bytes, int32_t capacity, uint32_t *count_us);
void board_send(struct board *board, const uint8_t *bytes, int32_t size);

#endif
