#include "status.h"
#include "wire.h" // fields and varints

int32_t status_encode(const struct status *status, uint8_t *payload, int32_t capacity) {
    struct writer w = {payload, capacity, 0, false};
    write_uint(&w, (uint64_t)status->sent_us, 8);
    write_uint(&w, status->sent_count_us, 4);
    write_uint(&w, (uint32_t)status->least_error_ns, 4);
    write_uint(&w, (uint32_t)status->most_error_ns, 4);
    write_uint(&w, (uint32_t)status->rate_q32, 4);
    write_uint(&w, (uint64_t)status->heard_us, 8);
    write_uint(&w, status->heard_age_us, 4);
    mark_write(&w, &status->mark);
    write_uint(&w, status->state, 1);
    write_uint(&w, status->refusal, 1);
    write_uint(&w,
               (uint64_t)(status->synced | status->homed << 1 | status->released << 2 |
                          status->grouped << 3),
               1);
    write_uint(&w, status->epoch, 2);
    write_uint(&w, status->command_number, 4);
    write_uint(&w, status->command_result, 1);
    write_uint(&w, (uint32_t)status->holding_tq, 4);
    fault_write(&w, &status->fault);
    write_uint(&w, status->plan_seen, 4);
    write_uint(&w, status->plan_accepted, 4);
    write_uint(&w, status->accepted_mask, 4);
    write_uint(&w, status->counters.plans_accepted, 4);
    write_uint(&w, status->counters.plans_late, 4);
    write_uint(&w, status->counters.plans_refused, 4);
    write_uint(&w, status->counters.frames_bad, 4);
    write_uint(&w, status->counters.coasts, 4);
    write_uint(&w, status->counters.stamps_excluded, 4);
    write_uint(&w, (uint32_t)status->torque_peak_tq, 4);
    write_uint(&w, status->torque_clipped, 4);
    if (status->sample_count > STATUS_SAMPLES_MAX)
        return -1;
    write_uint(&w, status->sample_count, 1);
    struct sample last = {status->sent_us, 0};
    for (int32_t i = 0; i < status->sample_count; i++) {
        write_varint(&w, status->samples[i].time_us - last.time_us);
        write_varint(&w, (int64_t)status->samples[i].count - last.count);
        last = status->samples[i];
    }
    return w.failed ? -1 : w.size;
}

bool status_decode(const uint8_t *payload, int32_t size, struct status *status) {
    struct reader r = {payload, size, 0, false};
    status->sent_us = (int64_t)read_uint(&r, 8);
    status->sent_count_us = (uint32_t)read_uint(&r, 4);
    status->least_error_ns = (int32_t)(uint32_t)read_uint(&r, 4);
    status->most_error_ns = (int32_t)(uint32_t)read_uint(&r, 4);
    status->rate_q32 = (int32_t)(uint32_t)read_uint(&r, 4);
    status->heard_us = (int64_t)read_uint(&r, 8);
    status->heard_age_us = (uint32_t)read_uint(&r, 4);
    mark_read(&r, &status->mark);
    status->state = (uint8_t)read_uint(&r, 1);
    status->refusal = (uint8_t)read_uint(&r, 1);
    uint64_t flags = read_uint(&r, 1);
    status->synced = flags & 1;
    status->homed = flags >> 1 & 1;
    status->released = flags >> 2 & 1;
    status->grouped = flags >> 3 & 1;
    status->epoch = (uint16_t)read_uint(&r, 2);
    status->command_number = (uint32_t)read_uint(&r, 4);
    status->command_result = (uint8_t)read_uint(&r, 1);
    status->holding_tq = (int32_t)(uint32_t)read_uint(&r, 4);
    fault_read(&r, &status->fault);
    status->plan_seen = (uint32_t)read_uint(&r, 4);
    status->plan_accepted = (uint32_t)read_uint(&r, 4);
    status->accepted_mask = (uint32_t)read_uint(&r, 4);
    status->counters.plans_accepted = (uint32_t)read_uint(&r, 4);
    status->counters.plans_late = (uint32_t)read_uint(&r, 4);
    status->counters.plans_refused = (uint32_t)read_uint(&r, 4);
    status->counters.frames_bad = (uint32_t)read_uint(&r, 4);
    status->counters.coasts = (uint32_t)read_uint(&r, 4);
    status->counters.stamps_excluded = (uint32_t)read_uint(&r, 4);
    status->torque_peak_tq = (int32_t)(uint32_t)read_uint(&r, 4);
    status->torque_clipped = (uint32_t)read_uint(&r, 4);
    status->sample_count = (uint8_t)read_uint(&r, 1);
    if (r.failed || status->sample_count > STATUS_SAMPLES_MAX)
        return false;
    uint64_t time_us = (uint64_t)status->sent_us, count = 0; // unsigned: hostile sums may wrap
    for (int32_t i = 0; i < status->sample_count; i++) {
        time_us += (uint64_t)read_varint(&r);
        count += (uint64_t)read_varint(&r);
        status->samples[i] = (struct sample){(int64_t)time_us, (int32_t)(uint32_t)count};
    }
    return !r.failed && r.at == size;
}
