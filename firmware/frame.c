#include "frame.h"
#include "wire.h" // little-endian fields

int32_t frame_seal(struct session *session, enum frame_type type, uint8_t *frame,
                   int32_t payload_size) {
    struct writer header = {frame, FRAME_HEADER_BYTES, 0, false};
    write_uint(&header, FRAME_VERSION, 1);
    write_uint(&header, type, 1);
    write_uint(&header, session->number, 4);
    write_uint(&header, ++session->sent, 6);
    int32_t size = FRAME_HEADER_BYTES + payload_size;
    struct writer tag = {frame + size, FRAME_TAG_BYTES, 0, false};
    write_uint(&tag, siphash24(session->key, session->send_direction, frame, size), 8);
    return size + FRAME_TAG_BYTES;
}

enum frame_error frame_open(struct session *session, const uint8_t *frame, int32_t size) {
    if (size < FRAME_HEADER_BYTES + FRAME_TAG_BYTES || size > FRAME_MAX)
        return FRAME_BAD_LENGTH;
    struct reader header = {frame, FRAME_HEADER_BYTES, 0, false};
    if (read_uint(&header, 1) != FRAME_VERSION)
        return FRAME_BAD_VERSION;
    read_uint(&header, 1); // the type, covered by the tag
    if (read_uint(&header, 4) != session->number)
        return FRAME_BAD_SESSION;
    uint64_t counter = read_uint(&header, 6);
    if (counter <= session->received)
        return FRAME_REPLAYED;
    int32_t signed_size = size - FRAME_TAG_BYTES;
    struct reader tag = {frame + signed_size, FRAME_TAG_BYTES, 0, false};
    uint8_t direction = session->send_direction == TO_DEVICE ? TO_HOST : TO_DEVICE;
    if (read_uint(&tag, 8) != siphash24(session->key, direction, frame, signed_size))
        return FRAME_BAD_TAG;
    session->received = counter;
    return FRAME_OK;
}
