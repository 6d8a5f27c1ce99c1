// The payload of a STATUS frame: what the device did with the host's frames, and its samples.
#ifndef HEADWAY_STATUS_H
#define HEADWAY_STATUS_H

#include "fault.h"
#include "history.h"
#include "mark.h"
#include <stdbool.h>
#include <stdint.h>

#define STATUS_SAMPLES_MAX HISTORY_SAMPLES

struct counters {
    uint32_t plans_accepted;
    uint32_t plans_late;      // refused: a live point would have changed
    uint32_t plans_refused;   // refused by the gate for any other reason
    uint32_t frames_bad;      // not authentic, malformed, replayed
    uint32_t coasts;          // RUNNING -> COAST
    uint32_t stamps_excluded; // contradicted what was known of the host's time
};

struct status {
    int64_t sent_us;                       // the device's system time ...
    uint32_t sent_count_us;                // ... and its count, to be echoed
    int32_t least_error_ns, most_error_ns; // its system time minus the host's lies between them
    int32_t rate_q32;                      // of its system time against its count, minus one
    int64_t heard_us;                      // the host's stamp in the frame that came last ...
    uint32_t heard_age_us;                 // ... and how long before this status that was
    struct mark mark;                      // the last one, as far as it knows the time
    uint8_t state;                         // enum device_state
    uint8_t refusal;                       // enum gate_result of the last refused plan
    bool synced;
    bool homed;              // the axis knows where it is
    bool released;           // the brake is off and has had time to let go
    bool grouped;            // it has the group's key
    uint16_t epoch;          // of the plans that are taken
    uint32_t command_number; // of the last command
    uint8_t command_result;  // enum command_result
    struct fault fault;      // why it stopped last
    int32_t holding_tq;      // the torque that held it at its last rest
    uint32_t plan_seen;      // highest plan number that arrived
    uint32_t plan_accepted;  // last plan accepted
    uint32_t accepted_mask;  // bit i: plan plan_seen - i was accepted
    struct counters counters;
    int32_t torque_peak_tq;  // largest unclipped |torque| since the last status
    uint32_t torque_clipped; // servo periods at the ceiling, ever
    uint8_t sample_count;
    struct sample samples[STATUS_SAMPLES_MAX];
};

int32_t status_encode(const struct status *status, uint8_t *payload, int32_t capacity);
bool status_decode(const uint8_t *payload, int32_t size, struct status *status);

#endif
