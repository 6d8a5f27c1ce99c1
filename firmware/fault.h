// Why a device stopped: reasons, what each leads to, and the log that survives a reset.
#ifndef HEADWAY_FAULT_H
#define HEADWAY_FAULT_H

#include <stdbool.h>
#include <stdint.h>

enum fault_reason {
    REASON_NONE,
    REASON_HOST,         // the host said stop
    REASON_SYNC_LOST,    // no clock sample for too long; value and limit in us
    REASON_CLOCK,        // the clock may be off by more than is allowed; us
    REASON_GAP,          // a plan left knots open; missing knots, how many may be filled
    REASON_FOLLOWING,    // following error; pq
    REASON_SPEED,        // measured speed; pq per servo period
    REASON_ROOM,         // no room left to stop; measured position, the limit, pq
    REASON_TORQUE,       // at the torque ceiling for too long; servo periods
    REASON_HOMING,       // a homing task did not find its mark; way made, way allowed, counts
    REASON_GAP_FAULT,    // the same, where a gap is a fault
    REASON_OUTSIDE,      // moves on outwards past its last limit; measured position, the limit, pq
    REASON_I2T,          // torque above the continuous one for too long; 1/256 of the allowance
    REASON_WINDING,      // winding temperature rise by its model; 1/65536 of the rated one
    REASON_UNDERVOLTAGE, // supply; mV
    REASON_OVERVOLTAGE,  // supply; mV
    REASON_LATE,         // the servo did not run in time; us
    REASON_STUCK,        // the encoder stands still under torque or a moving track; pq or periods
    REASON_REVERSED,     // the following error grows against the servo's own feedback; pq
    REASON_SPIKE,        // the encoder jumped; counts
    REASON_SETTINGS,     // no good settings in memory
    REASONS,
};

// What a reason leads to.
enum fault_response {
    RESPONSE_TAIL,  // ramp to rest, then hold
    RESPONSE_FAULT, // ramp to rest, brake, output off
    RESPONSE_BRAKE, // the encoder or the servo is not to be trusted: brake at once, output off
};

enum fault_response fault_response(enum fault_reason reason);

// A stop, frozen as it was.
struct fault {
    uint8_t reason; // enum fault_reason
    uint8_t state;  // enum device_state in which it happened
    uint32_t boots; // which life of the device
    int64_t time_us;
    int32_t value, limit; // what was found, and what is allowed
    int32_t position_pq;  // measured
    int32_t torque_tq;    // asked for
};

#define FAULT_LOG 8
#define FAULT_LOG_BYTES (4 + FAULT_LOG * 30)

struct fault_log {
    uint32_t count; // faults ever; the ring holds the last FAULT_LOG
    struct fault faults[FAULT_LOG];
};

void fault_log_add(struct fault_log *log, const struct fault *fault);

// A fault in a status, 30 bytes; the log as the payload of a FAULTS frame and as it is kept.
struct writer;
struct reader;
void fault_write(struct writer *w, const struct fault *fault);
void fault_read(struct reader *r, struct fault *fault);
int32_t fault_log_encode(const struct fault_log *log, uint8_t *payload, int32_t capacity);
bool fault_log_decode(const uint8_t *payload, int32_t size, struct fault_log *log);

#endif
