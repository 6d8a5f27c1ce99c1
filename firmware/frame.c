#include "frame.h"
#include "wire.h" // little-endian fields
#include <string.h>

void session_begin(struct session *session, uint32_t number, enum frame_prefix send_direction,
                   const uint8_t send_key[SIPHASH_KEY_BYTES],
                   const uint8_t receive_key[SIPHASH_KEY_BYTES]) {
    session->begun = true;
    session->send_direction = (uint8_t)send_direction;
    session->number = number;
    memcpy(session->send_key, send_key, SIPHASH_KEY_BYTES);
    memcpy(session->receive_key, receive_key, SIPHASH_KEY_BYTES);
    session->sent = session->received = 0; // the first frame is number 1
    session->window = ~0ULL;
}

int32_t frame_seal(struct session *session, enum frame_type type, uint8_t *frame,
                   int32_t payload_size) {
    if (!session->begun || session->sent >= FRAME_COUNTER_MAX)
        return -1;
    struct writer header = {frame, FRAME_HEADER_BYTES, 0, false};
    write_uint(&header, FRAME_VERSION, 1);
    write_uint(&header, type, 1);
    write_uint(&header, session->number, 4);
    write_uint(&header, ++session->sent, 6);
    int32_t size = FRAME_HEADER_BYTES + payload_size;
    struct writer tag = {frame + size, FRAME_TAG_BYTES, 0, false};
    write_uint(&tag, siphash24(session->send_key, session->send_direction, frame, size), 8);
    return size + FRAME_TAG_BYTES;
}

// The window is that of IPsec (Kent, RFC 4303, section 3.4.3).
static bool replayed(const struct session *session, uint64_t counter) {
    if (counter > session->received)
        return false;
    uint64_t behind = session->received - counter;
    return behind >= FRAME_WINDOW || session->window >> behind & 1;
}

static void note(struct session *session, uint64_t counter) {
    if (counter > session->received) {
        uint64_t ahead = counter - session->received;
        session->window = ahead < FRAME_WINDOW ? session->window << ahead : 0;
        session->received = counter;
    }
    session->window |= 1ULL << (session->received - counter);
}

enum frame_error frame_screen(const struct session *session, const uint8_t *frame) {
    struct reader header = {frame, FRAME_HEADER_BYTES, 0, false};
    if (read_uint(&header, 1) != FRAME_VERSION)
        return FRAME_BAD_VERSION;
    read_uint(&header, 1); // the type, covered by the tag
    if (read_uint(&header, 4) != session->number || !session->begun)
        return FRAME_BAD_SESSION;
    return replayed(session, read_uint(&header, 6)) ? FRAME_REPLAYED : FRAME_OK;
}

enum frame_error frame_open(struct session *session, const uint8_t *frame, int32_t size) {
    if (size < FRAME_HEADER_BYTES + FRAME_TAG_BYTES || size > FRAME_MAX)
        return FRAME_BAD_LENGTH;
    enum frame_error screened = frame_screen(session, frame);
    if (screened != FRAME_OK)
        return screened;
    int32_t signed_size = size - FRAME_TAG_BYTES;
    struct reader tag = {frame + signed_size, FRAME_TAG_BYTES, 0, false};
    uint8_t direction = session->send_direction == TO_DEVICE ? TO_HOST : TO_DEVICE;
    if (read_uint(&tag, 8) != siphash24(session->receive_key, direction, frame, signed_size))
        return FRAME_BAD_TAG;
    note(session, frame_counter(frame));
    return FRAME_OK;
}

uint64_t frame_counter(const uint8_t *frame) {
    struct reader counter = {frame + 6, 6, 0, false};
    return read_uint(&counter, 6);
}
