#include "fault.h"
#include "wire.h" // fields

enum fault_response fault_response(enum fault_reason reason) {
    if (reason < REASON_GAP_FAULT)
        return RESPONSE_TAIL;
    return reason < REASON_LATE ? RESPONSE_FAULT : RESPONSE_BRAKE;
}

void fault_log_add(struct fault_log *log, const struct fault *fault) {
    log->faults[log->count++ % FAULT_LOG] = *fault;
}

void fault_write(struct writer *w, const struct fault *fault) {
    write_uint(w, fault->reason, 1);
    write_uint(w, fault->state, 1);
    write_uint(w, fault->boots, 4);
    write_uint(w, (uint64_t)fault->time_us, 8);
    write_uint(w, (uint32_t)fault->value, 4);
    write_uint(w, (uint32_t)fault->limit, 4);
    write_uint(w, (uint32_t)fault->position_pq, 4);
    write_uint(w, (uint32_t)fault->torque_tq, 4);
}

void fault_read(struct reader *r, struct fault *fault) {
    fault->reason = (uint8_t)read_uint(r, 1);
    fault->state = (uint8_t)read_uint(r, 1);
    fault->boots = (uint32_t)read_uint(r, 4);
    fault->time_us = (int64_t)read_uint(r, 8);
    fault->value = (int32_t)(uint32_t)read_uint(r, 4);
    fault->limit = (int32_t)(uint32_t)read_uint(r, 4);
    fault->position_pq = (int32_t)(uint32_t)read_uint(r, 4);
    fault->torque_tq = (int32_t)(uint32_t)read_uint(r, 4);
}

int32_t fault_log_encode(const struct fault_log *log, uint8_t *payload, int32_t capacity) {
    struct writer w = {payload, capacity, 0, false};
    write_uint(&w, log->count, 4);
    for (int32_t i = 0; i < FAULT_LOG; i++)
        fault_write(&w, &log->faults[i]);
    return w.failed ? -1 : w.size;
}

bool fault_log_decode(const uint8_t *payload, int32_t size, struct fault_log *log) {
    struct reader r = {payload, size, 0, false};
    log->count = (uint32_t)read_uint(&r, 4);
    for (int32_t i = 0; i < FAULT_LOG; i++)
        fault_read(&r, &log->faults[i]);
    return !r.failed && r.at == size;
}
