#include "report.h"
#include "fields.h"

// Differences modulo 2^64 and 2^32: whatever comes, nothing overflows.
static void visit_reading(struct fields *f, struct reading *reading, const struct reading *last) {
    int64_t time = (int64_t)((uint64_t)reading->time_us - (uint64_t)last->time_us);
    int64_t value = fixed_difference(reading->value, last->value);
    field_u8(f, &reading->trigger);
    field_varint(f, &time);
    field_varint(f, &value);
    reading->time_us = (int64_t)((uint64_t)last->time_us + (uint64_t)time);
    reading->value = fixed_sum(last->value, (int32_t)(uint32_t)(uint64_t)value);
}

static void visit(struct fields *f, struct report *report) {
    struct reading last = {.time_us = report->readings[0].time_us};
    field_u32(f, &report->logic);
    field_u8(f, &report->result);
    field_u8(f, &report->wrong);
    for (int32_t i = 0; i < REPORT_TRACKS; i++)
        field_u32(f, &report->next[i]);
    field_u32(f, &report->refused);
    field_u32(f, &report->late);
    field_u32(f, &report->gaps);
    field_u32(f, &report->kept);
    field_u32(f, &report->first);
    field_u8(f, &report->count);
    f->failed |= report->count > REPORT_READINGS;
    last.time_us = (int64_t)field(f, (uint64_t)last.time_us, 8);
    for (int32_t i = 0; i < report->count && !f->failed; i++) {
        visit_reading(f, &report->readings[i], &last);
        last = report->readings[i];
    }
}

int32_t report_encode(const struct report *report, uint8_t *payload, int32_t capacity) {
    struct fields f = {.out = {payload, capacity, 0, false}};
    struct report copy = *report; // visited, so not const
    visit(&f, &copy);
    return f.failed || f.out.failed ? -1 : f.out.size;
}

bool report_decode(const uint8_t *payload, int32_t size, struct report *report) {
    struct fields f = {.in = {payload, size, 0, false}, .reading = true};
    report->readings[0] = (struct reading){0};
    for (int32_t i = 1; i < REPORT_READINGS; i++)
        report->readings[i] = report->readings[0];
    visit(&f, report);
    return !f.failed && !f.in.failed && f.in.at == size;
}
