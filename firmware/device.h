// The device: everything one board knows and does. The caller owns the struct; there is no other
// state, no pointer in it and no allocation.
#ifndef HEADWAY_DEVICE_H
#define HEADWAY_DEVICE_H

#include "board.h"
#include "clock.h"
#include "frame.h"
#include "gate.h"
#include "history.h"
#include "plan.h"
#include "servo.h"
#include "status.h"
#include "track.h"

#define DEVICE_COAST_KNOTS 5       // without an accepted plan for longer, RUNNING becomes COAST
#define DEVICE_FRESH_US 100000     // a plan sent longer ago is stale
#define DEVICE_START_PQ (64 << 10) // a first plan starts within this of the measured position

enum device_state {
    DEVICE_UNSYNCED, // the only state in which the clock may step
    DEVICE_IDLE,     // synced, output off, brake on
    DEVICE_RUNNING,  // executes its tracks
    DEVICE_COAST,    // no plan accepted for a while: the last one runs on to its rest
    DEVICE_HOLD,     // at rest: keeps position and last torque, integrator on, takes no plan
};

// What is set before power-up; constant while the device runs.
struct device_settings {
    uint8_t key[SIPHASH_KEY_BYTES];
    uint32_t session;
    uint8_t knot_shift; // knot interval = 2^knot_shift us, 9 .. 15
    uint16_t servo_period_us;
    uint16_t sample_every; // an encoder sample each so many servo periods
    struct gate_limits limits[TRACK_COUNT];
    struct servo_settings servo;
};

struct device {
    struct device_settings settings;
    enum device_state state;
    bool configured;
    struct session session;
    struct headway_clock clock;
    struct track tracks[TRACK_COUNT];
    struct servo servo;
    struct history history;
    uint32_t next_servo_us; // local count of the next servo period
    uint32_t periods;
    int64_t status_knot;   // knot of the last status sent
    int64_t accepted_knot; // knot in which the last plan was accepted
    int64_t start_knot;    // of the first plan
    int32_t encoder_count;
    struct status status;
    struct plan plan; // the one being decoded
};

void device_init(struct device *device, const struct device_settings *settings, uint32_t count_us);

// To be called at least every 250 us: takes what arrived, runs the servo when it is due.
void device_poll(struct device *device, struct board *board);

#endif
