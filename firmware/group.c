#include "group.h"
#include "wire.h" // fields

static void mask(uint8_t key[SIPHASH_KEY_BYTES], const uint8_t session_key[SIPHASH_KEY_BYTES],
                 uint64_t counter) {
    uint8_t message[8], pad[SIPHASH_KEY_BYTES];
    struct writer w = {message, sizeof message, 0, false}, p = {pad, sizeof pad, 0, false};
    write_uint(&w, counter, sizeof message);
    write_uint(&p, siphash24(session_key, GROUP_PAD_LOW, message, sizeof message), 8);
    write_uint(&p, siphash24(session_key, GROUP_PAD_HIGH, message, sizeof message), 8);
    for (int32_t i = 0; i < SIPHASH_KEY_BYTES; i++)
        key[i] ^= pad[i];
}

int32_t group_encode(const struct session *session, const struct session *group, uint8_t *payload,
                     int32_t capacity) {
    struct writer w = {payload, capacity, 0, false};
    write_bytes(&w, group->send_key, SIPHASH_KEY_BYTES);
    if (w.failed)
        return -1;
    mask(payload, session->send_key, session->sent + 1);
    write_uint(&w, group->number, 4);
    write_uint(&w, group->sent, 6);
    return w.failed ? -1 : w.size;
}

bool group_decode(const struct session *session, const uint8_t *frame, int32_t payload_size,
                  struct session *group) {
    struct reader r = {frame + FRAME_HEADER_BYTES, payload_size, 0, false};
    uint8_t key[SIPHASH_KEY_BYTES];
    read_bytes(&r, key, SIPHASH_KEY_BYTES);
    uint32_t number = (uint32_t)read_uint(&r, 4);
    uint64_t counter = read_uint(&r, 6);
    if (r.failed || r.at != payload_size || number == session->number)
        return false;
    mask(key, session->receive_key, frame_counter(frame));
    session_begin(group, number, (enum frame_prefix)session->send_direction, key, key);
    group->received = counter; // what came before is not for us
    return true;
}
