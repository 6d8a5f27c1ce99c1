// What a board is set up with: constant while anything moves.
#ifndef HEADWAY_SETTINGS_H
#define HEADWAY_SETTINGS_H

#include "gap.h"
#include "gate.h"
#include "home.h"
#include "monitor.h"
#include "servo.h"
#include "siphash.h"
#include "sync.h"

#define SETTINGS_NAME_MAX 25   // bytes of UTF-8
#define SETTINGS_FORMAT 4      // of their bytes; another one is not read
#define SETTINGS_BYTES_MAX 480 // of their bytes, at most

struct device_settings {
    char name[SETTINGS_NAME_MAX + 1]; // ends with zero
    uint8_t key[SIPHASH_KEY_BYTES]; // the long-term one; it comes by the programmer, never by wire
    uint8_t knot_shift;             // knot interval = 2^knot_shift us, 9 .. 15
    uint16_t servo_period_us;
    uint16_t sample_every;     // an encoder sample each so many servo periods
    uint16_t brake_periods;    // until the brake has engaged or let go, in servo periods
    uint32_t stop_us;          // from a fault or the emergency line to the brake, at most
    uint32_t sync_lost_us;     // without a clock sample
    uint16_t dither_us;        // one status in four leaves up to so much later
    int32_t torque_step_tq;    // per servo period, of the torque during a stop ramp
    struct scale knot_periods; // servo periods in a knot interval
    int32_t offset_count;      // axis' position minus the encoder's, where the encoder is absolute
    bool carries_gravity;      // without torque the axis falls
    uint8_t gap_policy[TRACK_COUNT]; // enum gap_policy
    struct gate_limits limits[TRACK_COUNT];
    struct servo_settings servo;
    struct monitor_settings monitor;
    struct home_settings home;
    struct sync_settings sync;
    uint8_t peer_key[SIPHASH_KEY_BYTES]; // of the boards among themselves; comes as `key` does
    uint8_t neighbours;                  // bit p: another board is at port p
    uint32_t ask_us;                     // how often they are asked for their time
    uint32_t peer_least_us;              // no frame takes less time between them
    uint32_t step_least_q16; // from a step to the next [1/65536 us]; 0: no stepper but a servo
};

// Whether every number is within what the arithmetic and the promises rely on.
bool settings_valid(const struct device_settings *settings);

// Settings as bytes: in memory with the key, on the wire without it. Reading keeps the key that is
// there if the bytes have none; false if they are no settings (then the output is undefined).
int32_t settings_encode(const struct device_settings *settings, bool with_key, uint8_t *bytes,
                        int32_t capacity);
bool settings_decode(const uint8_t *bytes, int32_t size, bool with_key,
                     struct device_settings *settings);

#endif
