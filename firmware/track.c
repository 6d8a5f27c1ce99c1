#include "track.h"

int32_t track_point(const struct track *track, int64_t knot) {
    if (knot > track->end)
        knot = track->end;
    return track->points[(uint32_t)knot % TRACK_POINTS];
}

void track_write(struct track *track, int64_t first_knot, const int32_t *points, int32_t count) {
    if (!track->written) { // before its first point a track is at that point
        for (int32_t i = 0; i < TRACK_POINTS; i++)
            track->points[i] = points[0];
        track->oldest = first_knot;
    }
    for (int32_t i = 0; i < count; i++)
        track->points[(uint32_t)(first_knot + i) % TRACK_POINTS] = points[i];
    track->end = first_knot + count - 1;
    if (track->oldest <= track->end - TRACK_POINTS) // those before are written over
        track->oldest = track->end - TRACK_POINTS + 1;
    track->written = true;
    for (int32_t i = 0; i < 2; i++)
        track_load(track, track->spans[i].knot);
}

// Where the end is near. Apart, and called: what it needs of registers would slow the usual case.
static __attribute__((noinline)) void copy_points(const struct track *track, int64_t knot,
                                                  int32_t points[4]) {
    for (int32_t i = 0; i < 4; i++)
        points[i] = track_point(track, knot - 1 + i);
}

static inline void find(const struct track *track, int64_t knot, struct span *span) {
    int32_t ends[4];
    if (track->end - knot >= 2) {
        uint32_t first = (uint32_t)knot - 1;
        span_set(span, knot, track->points[first % TRACK_POINTS],
                 track->points[(first + 1) % TRACK_POINTS],
                 track->points[(first + 2) % TRACK_POINTS],
                 track->points[(first + 3) % TRACK_POINTS]);
    } else {
        copy_points(track, knot, ends);
        span_set(span, knot, ends[0], ends[1], ends[2], ends[3]);
    }
}

void track_load(struct track *track, int64_t knot) {
    find(track, knot, &track->spans[(uint32_t)knot & 1]);
}

int32_t track_value(const struct track *track, const struct instant *at) {
    struct span span;
    find(track, at->knot, &span);
    return span_value(&span, at->phase);
}

int32_t track_rate(const struct track *track, const struct instant *at) {
    struct span span;
    find(track, at->knot, &span);
    return span_rate(&span, at->phase);
}

int32_t track_curve(const struct track *track, const struct instant *at) {
    struct span span;
    find(track, at->knot, &span);
    return span_curve(&span, at->phase);
}

bool track_past(const struct track *track, const struct instant *at, int32_t *value) {
    if (!track->written || at->knot <= track->oldest || at->knot > track->end)
        return false;
    *value = track_value(track, at);
    return true;
}
