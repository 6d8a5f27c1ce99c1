// What a board supplies. The device calls these and owns no hardware; `board` is the board's own.
//
// A board calls device_poll from its main loop and device_guard (guard.h) from the interrupt of a timer
// that nothing else stops. So what sets power, duty and brake, and what tells the count and the
// line, is called from there too, also in the middle of the same function called by the main loop:
// each sets its output by one store, or takes no harm from being interrupted. What the main loop then
// finishes setting is put right by the end of its period, or by the next interrupt.
#ifndef HEADWAY_BOARD_H
#define HEADWAY_BOARD_H

#include <stdbool.h>
#include <stdint.h>

struct board;

// What lies in non-volatile memory. Two places for each: one stays good while the other is written.
enum board_record {
    RECORD_SETTINGS_A,
    RECORD_SETTINGS_B,
    RECORD_BOOTS_A,
    RECORD_BOOTS_B,
    RECORD_FAULTS_A,
    RECORD_FAULTS_B,
    RECORDS,
};
#define BOARD_RECORD_MAX 512 // bytes

uint32_t board_count_us(const struct board *board); // free-running microseconds, wraps
int32_t board_encoder_count(const struct board *board);
void board_set_power(struct board *board, bool on);         // the bridge; off: no current flows
void board_set_duty(struct board *board, int32_t duty_q15); // PWM duty, +-32767 / 32768
void board_set_brake(struct board *board, bool engaged);

// Of a stepper: so many steps, below 0 backwards, the first so long after a count to come, then one each
// `spacing_q16` [1/65536 us]. The board gives them by itself, after those that it has. Without an encoder
// in steps its encoder's count is that of the steps that it has given.
void board_step(struct board *board, uint32_t count_us, int32_t steps, uint32_t first_q16,
                uint32_t spacing_q16);

bool board_stop_line(const struct board *board);   // true: the emergency line is open
bool board_home_switch(const struct board *board); // true: on the switch
// True once after each index pulse; `count` is the encoder's at the pulse.
bool board_index(struct board *board, int32_t *count);
int32_t board_supply_mV(const struct board *board);
void board_set_chopper(struct board *board, bool on); // burns what the motor feeds back

// Outputs and inputs beside the axis, as many as it has. A digital output changes at a count, a few servo
// periods ahead at most; of one output up to 32 changes may wait, in order. If the count is not to come
// the output changes at once, and what waits for it is forgotten: so off is off.
#define BOARD_DIGITAL 4
#define BOARD_PWM 2
void board_set_digital(struct board *board, int32_t output, bool on, uint32_t count_us);
void board_set_pwm(struct board *board, int32_t output, int32_t duty_q15); // 0 .. 32767
uint8_t board_digital_inputs(const struct board *board);                   // bit i: input i is on

// The last start of a bus frame: its number and the count at it. False where there is no bus.
bool board_frame_start(const struct board *board, uint16_t *number, uint32_t *count_us);

// Ports: the host's, and those of the boards beside this one, as many as it has.
#define BOARD_HOST 0
#define BOARD_PORTS 5

// The next received packet (COBS, without the ending zero), the port, and the count at which it
// arrived, as its interrupt stamped it. Returns its size, 0 if there is none.
int32_t board_receive(struct board *board, uint8_t *bytes, int32_t capacity, int32_t *port,
                      uint32_t *count_us);
void board_send(struct board *board, int32_t port, const uint8_t *bytes, int32_t size);

// Memory that outlives a reset and, but for faults, the supply. Settings and boots are saved while
// nothing moves, and may take their time. Faults are saved in the period that finds them, maybe in
// motion: into RAM that a reset leaves alone, say, which the board may copy to flash once the power is
// off. `board_load` returns the size, 0 if nothing was saved. A save that is cut short may leave
// anything in its own record, and changes no other.
int32_t board_load(const struct board *board, enum board_record record, uint8_t *bytes,
                   int32_t capacity);
void board_save(struct board *board, enum board_record record, const uint8_t *bytes, int32_t size);
uint64_t board_random(struct board *board); // of a ring oscillator: not to be relied on alone

#endif
