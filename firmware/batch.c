#include "batch.h"
#include "fields.h"
#include "graph.h" // sources

static void visit_time(struct fields *f, int64_t base_us, int64_t *time_us) {
    int64_t since_us = (int64_t)((uint64_t)*time_us - (uint64_t)base_us); // whatever they are
    field_varint(f, &since_us);
    f->failed |= since_us > PIECE_TIME_MAX || since_us < -PIECE_TIME_MAX;
    if (!f->failed)
        *time_us = base_us + since_us;
}

static void visit_value(struct fields *f, int32_t *value) {
    int64_t wide = *value;
    field_varint(f, &wide);
    f->failed |= wide > INT32_MAX || wide < INT32_MIN;
    *value = (int32_t)wide;
}

static void visit_piece(struct fields *f, int64_t base_us, struct batch_piece *sent) {
    struct wanted_piece *piece = &sent->piece;
    uint8_t flags =
        (uint8_t)((f->reading ? 0 : piece->has_start) | (f->reading ? 0 : piece->has_from) << 1);
    field_u8(f, &sent->track);
    f->failed |= sent->track < SOURCE_OF_PIECES || sent->track >= SOURCE_OF_INPUTS;
    field_u32(f, &sent->number);
    field_u8(f, &flags);
    f->failed |= flags > 3;
    piece->has_start = flags & 1;
    piece->has_from = flags & 2;
    if (piece->has_start)
        visit_time(f, base_us, &piece->start_us);
    visit_time(f, base_us, &piece->end_us);
    if (piece->has_from)
        visit_value(f, &piece->from);
    visit_value(f, &piece->to);
}

static void visit(struct fields *f, struct batch *batch) {
    int64_t *base_us = &batch->base_us;
    *base_us = (int64_t)field(f, (uint64_t)*base_us, 8);
    f->failed |= *base_us > PIECE_TIME_MAX || *base_us < -PIECE_TIME_MAX;
    field_u32(f, &batch->seen);
    field_u8(f, &batch->count);
    f->failed |= batch->count > BATCH_PIECES;
    for (int32_t i = 0; i < batch->count && !f->failed; i++)
        visit_piece(f, *base_us, &batch->pieces[i]);
}

int32_t batch_encode(const struct batch *batch, uint8_t *payload, int32_t capacity) {
    struct fields f = {.out = {payload, capacity, 0, false}};
    struct batch copy = *batch; // visited, so not const
    visit(&f, &copy);
    return f.failed || f.out.failed ? -1 : f.out.size;
}

bool batch_decode(const uint8_t *payload, int32_t size, struct batch *batch) {
    struct fields f = {.in = {payload, size, 0, false}, .reading = true};
    for (int32_t i = 0; i < BATCH_PIECES; i++) // what a piece leaves out is 0
        batch->pieces[i].piece = (struct wanted_piece){0};
    batch->base_us = 0;
    visit(&f, batch);
    return !f.failed && !f.in.failed && f.in.at == size;
}
