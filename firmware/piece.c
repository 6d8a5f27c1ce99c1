#include "piece.h"

#define HALF_Q31 (1 << 30)

static const struct piece *piece(const struct pieces *track, uint32_t number) {
    return &track->ring[number % PIECES];
}

static int32_t value(const struct piece *piece, int64_t time_us) {
    if (time_us >= piece->end_us)
        return piece->to;
    int64_t way_q31 = piece->slope_q31 * (time_us - piece->start_us);
    return (int32_t)(piece->from + ((way_q31 + HALF_Q31) >> 31));
}

static uint32_t oldest(const struct pieces *track) {
    return track->next > PIECES ? track->next - PIECES : 0;
}

// Starts ascend, so it is found by halves.
bool pieces_past(const struct pieces *track, int64_t time_us, int32_t *found) {
    uint32_t first = oldest(track), begun = first, end = track->next;
    while (begun < end) {
        uint32_t middle = begun + (end - begun) / 2;
        if (piece(track, middle)->start_us <= time_us)
            begun = middle + 1;
        else
            end = middle;
    }
    if (begun == first)
        return false;
    *found = value(piece(track, begun - 1), time_us);
    return true;
}

int32_t pieces_at(const struct pieces *track, int64_t time_us) {
    int32_t found = 0;
    pieces_past(track, time_us, &found);
    return found;
}

bool pieces_begun(const struct pieces *track, int64_t time_us) {
    return track->next != 0 && piece(track, track->current)->start_us <= time_us;
}

// To a piece that has begun, if there is one.
static bool go_back(struct pieces *track, int64_t time_us) {
    while (track->current > oldest(track) && !pieces_begun(track, time_us))
        track->current--;
    return pieces_begun(track, time_us);
}

int32_t pieces_now(struct pieces *track, int64_t time_us) {
    if (!pieces_begun(track, time_us) && !go_back(track, time_us))
        return 0;
    while (track->current + 1 < track->next &&
           piece(track, track->current + 1)->start_us <= time_us)
        track->current++;
    return value(piece(track, track->current), time_us);
}

enum piece_result pieces_take(struct pieces *track, uint32_t number,
                              const struct wanted_piece *wanted, int64_t now_us) {
    const struct piece *before = track->next > 0 ? piece(track, track->next - 1) : 0;
    if (number < track->next)
        return PIECE_TAKEN;
    if (number > track->next || (!before && !(wanted->has_start && wanted->has_from)))
        return PIECE_GAP;
    int64_t start_us = wanted->has_start ? wanted->start_us : before->end_us;
    int64_t took_us = wanted->end_us - start_us;
    if (took_us < 0 || took_us > PIECE_LONGEST_US || (before && start_us < before->start_us))
        return PIECE_ORDER;
    if (track->next > PIECES_MANY)
        return PIECE_FULL;
    if (track->next >= PIECES && piece(track, track->next - PIECES + 1)->start_us > now_us)
        return PIECE_FULL;
    struct piece taken = {.start_us = start_us, .end_us = wanted->end_us, .to = wanted->to};
    taken.from = wanted->has_from ? wanted->from : value(before, start_us);
    if (took_us > 0)
        taken.slope_q31 = ((int64_t)taken.to - taken.from) * (1LL << 31) / took_us;
    if (number == track->current + PIECES) // its place; the one after it has begun
        track->current++;
    track->ring[number % PIECES] = taken;
    track->next++;
    return start_us < now_us ? PIECE_LATE : PIECE_TAKEN;
}
