#include "admit.h"
#include "cobs.h" // packets on the byte stream
#include "command.h"
#include "happen.h"
#include "peer.h"
#include <string.h>

#define SESSION_BYTES 6                     // of a header: up to its session
#define PEEK_BYTES (1 + FRAME_HEADER_BYTES) // that a header is in: no block before its end is full

// Decodes the beginning of a packet's header alone. The length of each block but the first lies where a zero was.
static void peek(const uint8_t *packet, int32_t bytes, uint8_t *header) {
    int32_t left = packet[0]; // of the block
    for (int32_t i = 1; i <= bytes; i++) {
        uint8_t byte = packet[i];
        if (--left == 0) {
            left = byte;
            byte = 0;
        }
        header[i - 1] = byte;
    }
}

static enum admission opens_if(bool good) { return good ? ADMIT_OPEN : ADMIT_BAD; }

static bool is_of(const struct session *session, uint32_t number) {
    return session->begun && number == session->number;
}

static const struct session *session_of(const struct device *device, uint32_t number) {
    if (is_of(&device->session, number))
        return &device->session;
    if (is_of(&device->group, number))
        return &device->group;
    return is_of(&device->offer.session, number) ? &device->offer.session : 0;
}

static bool is_for_us(const struct device *device, const uint8_t *packet, int32_t size) {
    uint8_t header[FRAME_HEADER_BYTES];
    if (size < COBS_BOUND(FRAME_HEADER_BYTES + FRAME_TAG_BYTES))
        return false;
    peek(packet, SESSION_BYTES, header);
    const struct session *session =
        session_of(device, header[2] | (uint32_t)header[3] << 8 | (uint32_t)header[4] << 16 |
                               (uint32_t)header[5] << 24);
    if (!session)
        return false;
    peek(packet, FRAME_HEADER_BYTES, header);
    return frame_screen(session, header) == FRAME_OK;
}

enum admission admit_packet(const struct device *device, const uint8_t *packet, int32_t size,
                            int32_t port, uint32_t count_us) {
    // Noise ends here, mostly: before version and type there is nothing but a block's length.
    if (size < PEEK_BYTES || packet[0] < 3)
        return ADMIT_BAD;
    if (port == BOARD_HOST && packet[2] == FRAME_HELLO && size == COBS_BOUND(HANDSHAKE_BYTES))
        return count_us - device->offer.looked_us < OFFER_PAUSE_US ? ADMIT_IGNORED : ADMIT_OPEN;
    if (packet[1] != FRAME_VERSION)
        return ADMIT_BAD;
    if (port == BOARD_HOST)
        return opens_if(packet[2] != FRAME_HELLO && is_for_us(device, packet, size));
    return opens_if(device->settings.neighbours & 1 << port &&
                    (size == COBS_BOUND(PEER_REQUEST_BYTES) ||
                     size == COBS_BOUND(PEER_RESPONSE_BYTES) ||
                     size == COBS_BOUND(PEER_FEED_BYTES)));
}

// A session with nonces that have never been. False if there is none left in this boot, or if its
// number is taken: the host asks again.
static bool make_offer(struct device *device, struct board *board, const uint8_t *host_nonce,
                       uint32_t count_us) {
    struct offer *offer = &device->offer;
    offer->session.begun = false;
    if (offer->count == UINT32_MAX)
        return false;
    offer->count++;
    memcpy(offer->nonces.host, host_nonce, NONCE_BYTES);
    nonce_of_device(device->boots, offer->count, board_random(board), offer->nonces.device);
    handshake_session(device->settings.key, &offer->nonces, TO_HOST, &offer->session);
    uint32_t number = offer->session.number;
    offer->session.begun = (!device->session.begun || number != device->session.number) &&
                           (!device->group.begun || number != device->group.number);
    offer->made_us = count_us;
    return offer->session.begun;
}

void admit_hello(struct device *device, struct board *board, const uint8_t *frame, int32_t size,
                 uint32_t count_us) {
    struct offer *offer = &device->offer;
    uint8_t host_nonce[NONCE_BYTES];
    offer->looked_us = count_us;
    if (!hello_decode(frame, size, host_nonce)) {
        device->status.counters.frames_bad++;
        return;
    }
    bool same = offer->session.begun && memcmp(host_nonce, offer->nonces.host, NONCE_BYTES) == 0;
    if (!same && !make_offer(device, board, host_nonce, count_us))
        return;
    uint8_t welcome[HANDSHAKE_BYTES], packet[COBS_BOUND(HANDSHAKE_BYTES)];
    welcome_encode(device->settings.key, &offer->nonces, welcome);
    board_send(board, BOARD_HOST, packet, cobs_encode(welcome, HANDSHAKE_BYTES, packet));
}

// Another host, or the same one anew: it counts from the start, and its time may be another one. At
// rest under power no clock steps; if the new host's time is another one it has to disarm first.
static void begin_session(struct device *device) {
    struct status *status = &device->status;
    device->session = device->offer.session;
    device->offer.session.begun = false;
    device->group.begun = false;
    signals_restart(&device->signals);
    status->epoch = 0; // plans of the old session can come no more
    status->command_number = 0;
    status->command_result = COMMAND_DONE;
    status->plan_seen = status->plan_accepted = status->accepted_mask = 0;
    if (device->state != DEVICE_HOLD) {
        sync_restart(&device->sync);
        happen(device, EVENT_SYNC_LOST);
    }
}

enum sender admit_frame(struct device *device, const uint8_t *frame, int32_t size) {
    enum frame_error error = frame_open(&device->session, frame, size);
    if (error == FRAME_OK)
        return SENDER_HOST;
    if (error != FRAME_BAD_SESSION)
        return SENDER_NOBODY;
    if (frame_open(&device->group, frame, size) == FRAME_OK)
        return SENDER_GROUP;
    bool resting = device->state == DEVICE_HOLD || !device->power;
    if (!resting || frame_open(&device->offer.session, frame, size) != FRAME_OK)
        return SENDER_NOBODY;
    begin_session(device);
    return SENDER_HOST;
}

void admit_advance(struct device *device, uint32_t count_us) {
    struct offer *offer = &device->offer;
    if (offer->session.begun && count_us - offer->made_us > OFFER_VALID_US)
        offer->session.begun = false;
}
