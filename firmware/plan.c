#include "plan.h"
#include "wire.h" // fields and varints

static void write_stamps(struct writer *w, const struct stamps *stamps) {
    write_uint(w, stamps->echo_us, 4);
    write_uint(w, (uint64_t)stamps->received_us, 8);
    write_uint(w, (uint64_t)stamps->sent_us, 8);
    mark_write(w, &stamps->mark);
}

static int64_t read_time(struct reader *r) {
    int64_t time_us = (int64_t)read_uint(r, 8);
    if (time_us > PLAN_TIME_MAX || time_us < -PLAN_TIME_MAX)
        r->failed = true;
    return time_us;
}

static void read_stamps(struct reader *r, struct stamps *stamps) {
    stamps->echo_us = (uint32_t)read_uint(r, 4);
    stamps->received_us = read_time(r);
    stamps->sent_us = read_time(r);
    mark_read(r, &stamps->mark);
    if (stamps->mark.least_us > PLAN_TIME_MAX || stamps->mark.least_us < -PLAN_TIME_MAX)
        r->failed = true;
}

static bool counts_ok(const struct plan *plan) {
    return plan->count >= 3 && plan->count <= PLAN_POINTS_MAX && plan->tracks != 0 &&
           plan->tracks < 1 << TRACK_COUNT;
}

int32_t sync_encode(const struct stamps *stamps, uint8_t *payload, int32_t capacity) {
    struct writer w = {payload, capacity, 0, false};
    write_stamps(&w, stamps);
    return w.failed ? -1 : w.size;
}

bool sync_decode(const uint8_t *payload, int32_t size, struct stamps *stamps) {
    struct reader r = {payload, size, 0, false};
    read_stamps(&r, stamps);
    return !r.failed && r.at == size;
}

int32_t plan_encode(const struct stamps *stamps, const struct plan *plan, uint8_t *payload,
                    int32_t capacity) {
    struct writer w = {payload, capacity, 0, false};
    if (!counts_ok(plan))
        return -1;
    write_stamps(&w, stamps);
    write_uint(&w, plan->number, 4);
    write_uint(&w, plan->epoch, 2);
    write_uint(&w, (uint64_t)plan->first_knot, 8);
    write_uint(&w, plan->tracks, 1);
    write_uint(&w, plan->count, 1);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        if (!(plan->tracks & 1 << sink))
            continue;
        int64_t point = 0, difference = 0;
        for (int32_t i = 0; i < plan->count; i++) {
            int64_t d = plan->points[sink][i] - point;
            write_varint(&w, d - difference);
            difference = i == 0 ? 0 : d; // the first point is no difference
            point = plan->points[sink][i];
        }
    }
    return w.failed ? -1 : w.size;
}

// Reads one track; a point beyond 32 bits fails, whatever the differences were.
static void read_points(struct reader *r, int32_t *points, int32_t count) {
    int64_t point = 0, difference = 0;
    for (int32_t i = 0; i < count; i++) {
        int64_t d = read_varint(r);
        if (d >= 1LL << 33 || d <= -(1LL << 33)) // second differences of 32 bits stay below
            r->failed = true;
        if (r->failed)
            return;
        d += difference;
        point += d;
        if (point > INT32_MAX || point < INT32_MIN)
            r->failed = true;
        points[i] = (int32_t)point;
        difference = i == 0 ? 0 : d; // the first point is no difference
    }
}

bool plan_decode(const uint8_t *payload, int32_t size, struct stamps *stamps, struct plan *plan) {
    struct reader r = {payload, size, 0, false};
    read_stamps(&r, stamps);
    plan->number = (uint32_t)read_uint(&r, 4);
    plan->epoch = (uint16_t)read_uint(&r, 2);
    plan->first_knot = (int64_t)read_uint(&r, 8);
    plan->tracks = (uint8_t)read_uint(&r, 1);
    plan->count = (uint8_t)read_uint(&r, 1);
    if (r.failed || !counts_ok(plan))
        return false;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan->tracks & 1 << sink)
            read_points(&r, plan->points[sink], plan->count);
    return !r.failed && r.at == size;
}
