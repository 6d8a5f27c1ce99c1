// The monitor: what is measured, judged every servo period against what is allowed. The gate bounds
// what is asked for; this bounds what happens.
#ifndef HEADWAY_MONITOR_H
#define HEADWAY_MONITOR_H

#include "fault.h"
#include "fixed.h"
#include "servo.h"

#define MONITOR_SPEED_PERIODS 8     // of the low-pass on the measured speed
#define MONITOR_LOAD_ONE_Q8 256     // torque load 1: the continuous torque
#define MONITOR_HEAT_PERIODS 256    // between two steps of the winding's temperature
#define MONITOR_SUPPLY_PERIODS 4    // a supply beyond its limits for so long in a row
#define MONITOR_CHOPPER_OFF_SHIFT 6 // the chopper goes off 1/64 below where it goes on

struct monitor_settings {
    bool bounded;               // there are position limits
    uint16_t following_periods; // with a following error beyond its limit, in a row
    int32_t following_pq;       // largest following error
    int32_t speed_pq;           // largest speed, per servo period
    int32_t spike_counts;       // in one period
    int32_t low_pq, high_pq;    // within these the axis must always be able to stop ...
    int32_t deceleration_q16;   // ... with this: 1/65536 pq per period squared
    uint32_t torque_periods;    // at the torque ceiling in a row
    uint32_t late_us;           // of a servo period
    struct scale load_q8;       // torque in 1/256 of the continuous torque [1/tq]
    uint32_t overload;          // allowance of load^2 - 1, summed over periods
    uint16_t heating_q16;       // share by which the winding's rise nears load^2 in 256 periods
    int32_t rise_q16;       // largest rise of the winding; 65536: at continuous torque, for ever
    int32_t stuck_pq;       // of the setpoint's way without a count
    uint32_t stuck_periods; // of torque half the ceiling away without a count
    int32_t supply_min_mV, supply_max_mV, chopper_mV;
};

// A breach; reason REASON_NONE if there is none.
struct breach {
    enum fault_reason reason;
    int32_t value, limit;
};

struct monitor {
    struct breach breach; // of the last period; if there is none, only its reason is set
    int32_t primed;       // `count` is the last one, or not: 0
    int32_t count;
    int32_t speed_sum;  // of count differences in pq, a first-order low-pass over 8 periods
    uint32_t following; // periods beyond the limit, in a row
    uint32_t torque;    // periods at the ceiling, in a row
    int64_t overload;   // sum of load^2 - 1 in 1/65536, not below 0
    int64_t heat;       // sum of load^2 in 1/65536 since the last step
    uint16_t heat_periods;
    int32_t rise_q16;       // of the winding ...
    uint16_t rise_fraction; // ... and what lies below
    bool begun;             // `still_pq` is valid
    int32_t still_count;    // when that was last judged
    int32_t still_pq;       // setpoint when the count last changed
    int32_t still_tq;       // torque then
    uint32_t still_periods; // pushed on since then without a count
    uint8_t under, over;    // periods of bad supply, in a row
    bool chopper;
};

// What need not be judged in each period.
enum monitor_look {
    LOOK_STUCK = 1,   // whether the encoder has stood still
    LOOK_SUPPLY = 2,  // and the chopper
    LOOK_HEAT = 4,    // of the motor: what it is allowed ...
    LOOK_WINDING = 8, // ... and the winding's rise
    LOOKS = 15,
};

// What one servo period found.
struct observation {
    bool power;            // the bridge is on: else only the encoder is judged
    bool driven;           // the servo follows a setpoint
    bool bounded;          // it is to be kept within its limits
    bool may_stand;        // standing still is what it is there for
    uint8_t looks;         // bits of monitor_look: what is judged now besides
    uint8_t heat_shift;    // the servo's effort is of 2^this periods, up to 2^5 ...
    uint8_t stuck_periods; // ... and an encoder that stands still does so for these
    int32_t count;         // of the encoder
    int32_t position_pq;   // measured
    int32_t setpoint_pq;
    const struct servo *servo; // after its last period
    int32_t torque_limit_tq;
    int32_t supply_mV; // if it is judged
    uint32_t late_us;  // after it was due
};

// One servo period: `breach` says what it found. The worst one is told: what forbids the ramp before
// what does not.
void monitor_step(const struct monitor_settings *settings, struct monitor *monitor,
                  const struct observation *seen);

// Whether a position is within the last limits.
bool monitor_inside(const struct monitor_settings *settings, int32_t position_pq);

// Measured speed, pq per servo period.
int32_t monitor_speed_pq(const struct monitor *monitor);

// Before the servo begins to follow another setpoint: what counts periods in a row starts anew.
void monitor_begin(struct monitor *monitor);

#endif
