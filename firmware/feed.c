#include "feed.h"
#include <string.h>

static bool is_fed(const struct logic *logic, int32_t track, uint16_t *feed) {
    for (int32_t i = 0; i < logic->feds; i++)
        if (logic->fed[i].track == SOURCE_OF_PIECES + track) {
            *feed = logic->fed[i].feed;
            return true;
        }
    return false;
}

uint16_t feeds_rule(struct feeds *feeds, const struct logic *logic) {
    uint32_t changed = 0;
    memset(feeds->given, 0, sizeof feeds->given);
    for (int32_t i = 0; i < FEED_TRACKS; i++) {
        struct taken *taken = &feeds->taken[i];
        uint16_t feed = 0;
        bool was = feeds->fed >> i & 1, is = is_fed(logic, i, &feed);
        if (was == is && taken->feed == feed)
            continue;
        changed |= 1u << i;
        *taken = (struct taken){.feed = feed};
        feeds->fed = (uint16_t)((feeds->fed & ~(1u << i)) | (uint32_t)is << i);
    }
    return (uint16_t)changed;
}

static void push(struct peer_feed *frame, int64_t time_us, int32_t value) {
    if (frame->count == PEER_POINTS)
        memmove(frame->points, frame->points + 1, (PEER_POINTS - 1) * sizeof frame->points[0]);
    else
        frame->count++;
    frame->points[frame->count - 1] = (struct peer_point){time_us, value};
}

// Else the clock has stepped back, or points are too far apart for a frame.
static bool goes_on(const struct peer_feed *frame, int64_t at_us) {
    return frame->count > 0 && at_us > frame->points[frame->count - 1].time_us &&
           at_us - frame->points[0].time_us <= FEED_OLDEST_US;
}

static bool changes(const struct peer_feed *frame, int64_t at_us, int32_t value) {
    if (frame->count == 0)
        return true;
    const struct peer_point *last = &frame->points[frame->count - 1];
    return value != last->value || at_us - last->time_us > FEED_ALONE_US;
}

static void give(const struct feed *feed, struct given *given, int32_t value, int64_t time_us) {
    struct peer_feed *frame = &given->frame;
    int64_t at_us = time_us + feed->after_us;
    bool due = given->wait == 0;
    given->wait = due ? feed->every - 1 : given->wait - 1;
    frame->number = feed->number;
    frame->steps = feed->kind == FEED_STEP;
    if (!goes_on(frame, at_us)) {
        frame->count = 0;
        given->waits = false;
    }
    if (frame->steps ? changes(frame, at_us, value) : due)
        push(frame, at_us, value);
    frame->time_us = at_us; // also of one that still waits
    given->waits |= due;
}

int32_t feeds_step(struct feeds *feeds, const struct logic *logic, const int32_t *values,
                   int64_t time_us) {
    int64_t most_us = 0;
    for (int32_t i = 0; i < logic->feeds; i++)
        give(&logic->feed[i], &feeds->given[i], values[logic->feed[i].source], time_us);
    for (int32_t i = 0; i < FEED_TRACKS; i++) {
        const struct taken *taken = &feeds->taken[i];
        if (!(feeds->fed >> i & 1))
            continue;
        if (!taken->begun || taken->known_us > time_us + FEED_FRESH_US) // or the clock stepped back
            return FEED_UNKNOWN_MS;
        if (time_us - taken->known_us > most_us)
            most_us = time_us - taken->known_us;
    }
    return most_us < (int64_t)FEED_UNKNOWN_MS * 1000 ? (int32_t)(most_us / 1000) : FEED_UNKNOWN_MS;
}

const struct peer_feed *feeds_next(struct feeds *feeds, int32_t count) {
    for (int32_t i = 0; i < count; i++) {
        feeds->given_last = (uint8_t)(feeds->given_last + 1 < count ? feeds->given_last + 1 : 0);
        struct given *given = &feeds->given[feeds->given_last];
        if (!given->waits)
            continue;
        given->waits = false;
        return &given->frame;
    }
    return 0;
}

// The first point that has not been taken.
static int32_t first_new(const struct taken *taken, const struct peer_feed *frame) {
    int32_t i = 0;
    while (i < frame->count && frame->points[i].time_us <= taken->last_us)
        i++;
    return i;
}

static enum piece_result append(struct pieces *pieces, const struct peer_feed *frame, int32_t i,
                                int64_t now_us) {
    const struct peer_point *to = &frame->points[i], *from = frame->steps ? to : to - 1;
    struct wanted_piece piece = {.has_start = true,
                                 .has_from = true,
                                 .start_us = from->time_us,
                                 .end_us = to->time_us,
                                 .from = from->value,
                                 .to = to->value};
    return pieces_take(pieces, pieces->next, &piece, now_us);
}

bool feeds_take(struct feeds *feeds, int32_t track, struct pieces *pieces,
                const struct peer_feed *frame, int64_t now_us, uint32_t *refused, uint32_t *late,
                bool *anew) {
    struct taken *taken = &feeds->taken[track];
    int64_t age_us = now_us - frame->time_us;
    *anew = false;
    if (age_us > FEED_FRESH_US || age_us < -FEED_FRESH_US)
        return false;
    // The clock stepped back; or, after days, numbers are to begin anew.
    if (taken->known_us > now_us + FEED_FRESH_US || pieces->next > PIECES_MANY)
        taken->begun = false;
    bool begins = !taken->begun;
    if (!begins && frame->time_us <= taken->known_us)
        return true; // it has been heard, or overtaken
    int32_t i = begins ? frame->count - 1 : first_new(taken, frame);
    if (begins) { // what it has now, and what comes
        memset(pieces, 0, sizeof *pieces);
        *anew = taken->begun = true;
    }
    bool follows = i > 0 && frame->points[i - 1].time_us == taken->last_us;
    bool gap = !begins && i < frame->count && !follows;
    feeds->gaps += gap;
    for (; i < frame->count; i++) {
        bool alone = (begins || gap) && !frame->steps; // no line leads to it
        enum piece_result result = alone ? PIECE_TAKEN : append(pieces, frame, i, now_us);
        if (result == PIECE_FULL) { // it is in the next frame
            if (taken->last_us > taken->known_us)
                taken->known_us = taken->last_us;
            return true;
        }
        *refused += result != PIECE_TAKEN && result != PIECE_LATE;
        *late += result == PIECE_LATE && !begins;
        taken->last_us = frame->points[i].time_us;
        gap = false;
    }
    taken->known_us = frame->time_us;
    return true;
}
