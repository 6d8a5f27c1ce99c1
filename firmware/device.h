// The device: everything one board knows and does. The caller owns the struct; there is no other
// state, no pointer in it and no allocation.
//
// What arrives is in inbox.c, from whom in admit.c, what it leads to in happen.c (with the table of
// states.c), what comes out in drive.c and outbox.c.
#ifndef HEADWAY_DEVICE_H
#define HEADWAY_DEVICE_H

#include "board.h"
#include "clock.h"
#include "fault.h"
#include "frame.h"
#include "guard.h"
#include "history.h"
#include "home.h"
#include "monitor.h"
#include "neighbours.h"
#include "offer.h"
#include "plan.h"
#include "ramp.h"
#include "servo.h"
#include "settings.h"
#include "signals.h"
#include "states.h"
#include "status.h"
#include "stepper.h"
#include "sync.h"
#include "track.h"

#define DEVICE_FIRMWARE 1          // told with the settings; counts up with what a device does
#define DEVICE_COAST_KNOTS 5       // without an accepted plan for longer, RUNNING becomes COAST
#define DEVICE_DITHER_EVERY 4      // one status in so many leaves a little later
#define DEVICE_FRESH_US 100000     // a plan sent longer ago is stale
#define DEVICE_START_PQ (64 << 10) // a first plan starts within this of the measured position
#define DEVICE_START_STEPS_PQ (2 << 10) // ... and a stepper's within this
// Servo periods in which each duty has its turn, where they are so short that all take no longer than
// this.
#define DEVICE_TURNS_SHIFT 4
#define DEVICE_TURNS (1 << DEVICE_TURNS_SHIFT)
#define DEVICE_TURNS_US 2000
#define DEVICE_REST_PQ (1 << 10) // at rest: measured speed below a count per servo period

// What need not be done in each servo period: where these are short, each has a turn, or a few, of
// DEVICE_TURNS. Else, and while the clock may step, all of it is done in each.
enum device_duty {
    DUTY_STUCK = LOOK_STUCK,
    DUTY_SUPPLY = LOOK_SUPPLY,
    DUTY_HEAT = LOOK_HEAT,
    DUTY_WINDING = LOOK_WINDING,
    DUTY_CARRY = 1 << 4,   // what is known of the clock ...
    DUTY_COMPARE = 1 << 5, // ... how far it is off ...
    DUTY_LEAD = 1 << 6,    // ... its rate ...
    DUTY_TELL = 1 << 7,    // ... its error
    DUTY_RELY = 1 << 14,   // whether it can be relied on, and an offer of a session
    DUTY_AHEAD = 1 << 8,   // a span of the next knot
    DUTY_KP = 1 << 9,      // a gain by its track
    DUTY_KI = 1 << 10,
    DUTY_KD = 1 << 11,
    DUTY_SPEED = 1 << 12,  // feed-forward of the position track's speed ...
    DUTY_TORQUE = 1 << 13, // ... and of the torque track
    DUTIES = (1 << 15) - 1,
};

// The monitor, and beside it what it allows, of the settings.
struct watch {
    struct monitor_settings settings;
    struct monitor monitor;
};

// What every servo period touches comes first: a small core reaches 128 bytes at no cost.
struct device {
    enum device_state state;
    uint32_t duties;          // of this period: bits of device_duty
    int32_t position_pq;      // measured
    struct setpoint setpoint; // of the last period: position, velocity and torque
    struct servo servo;
    uint32_t next_servo_us;    // local count of the next servo period
    uint32_t stop_count_us;    // count at the fault or emergency stop
    int32_t encoder_count;     // as the board has it
    int32_t offset_count;      // what it lacks to the axis' position
    struct servo_settings law; // of the settings, where the servo reads it
    uint32_t ahead;            // feed-forward's lead, of the same [1/65536 of a knot interval]
    uint16_t sample_wait;      // servo periods until the next sample
    bool takes_turns;          // its periods are short
    uint8_t turn;              // of this period
    int32_t hold_pq, hold_tq;
    bool configured; // else it has no settings and no key, and does nothing
    bool power, brake;
    uint8_t outputs;        // as the board was told last
    bool steps;             // it has a stepper, which needs no servo
    bool trusted;           // encoder and servo, to ramp down by
    bool executes;          // in its last period the servo followed its tracks
    bool status_waits;      // the last one has not left yet ...
    uint32_t status_us;     // ... and does at this count
    uint16_t brake_periods; // since the brake was set or let go, up to the settings' own
    bool faults_unsaved;
    uint8_t foreseen;      // the track whose next span was made last
    int64_t status_knot;   // knot of the last status
    int64_t accepted_knot; // knot in which the last plan was accepted
    int64_t start_knot;    // of the first plan
    struct headway_clock clock;
    struct watch watch;
    struct guard guard; // what judges beside all this
    struct device_settings settings;
    struct sync sync;
    uint32_t heard_count_us; // at which the host's last stamps arrived
    struct status status;
    struct ramp ramp;
    struct stepper stepper;
    struct home home;
    struct history history;
    struct session session;
    struct session group; // of all devices of the machine
    struct offer offer;
    struct neighbours neighbours;
    struct marks marks;
    uint32_t boots;
    uint32_t reports; // statuses so far
    struct fault_log faults;
    struct track tracks[TRACK_COUNT];
    struct plan plan; // the one being decoded
    struct signals signals;
    struct batch batch; // the one being decoded
};

// Begins anew from what the board remembers. Without good settings, or without a boot number that
// has never been, the device is in FAULT and answers nobody: it is set up over the programmer.
void device_boot(struct device *device, struct board *board, uint32_t count_us);

// Takes other settings. Nothing may be powered.
void device_configure(struct device *device, const struct device_settings *settings);

// To be called at least every 250 us: runs the servo when it is due, takes what arrived. Beside it,
// from an interrupt, comes device_guard (guard.h).
void device_poll(struct device *device, struct board *board);

// Sends what waits for its moment: a status, questions to neighbours and answers. device_poll does so
// as well; in between it may be called as often as a board likes.
void device_report(struct device *device, struct board *board);

// The axis' position, from the encoder's last count and the offset.
void device_locate(struct device *device);

// Samples of the clock, from wherever. Only in UNSYNCED may they step it.
void device_take_stamps(struct device *device, const struct sync_source *source,
                        const struct stamps *stamps, uint32_t arrived_us, uint32_t count_us);

int64_t device_knot_at(const struct device *device, int64_t time_us);
bool device_at_rest(const struct device *device);

#endif
