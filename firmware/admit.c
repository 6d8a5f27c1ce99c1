#include "admit.h"
#include "cobs.h" // packets on the byte stream
#include "command.h"
#include "happen.h"
#include <string.h>

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
    if (!hello_decode(frame, size, host_nonce)) {
        device->status.counters.frames_bad++;
        return;
    }
    if (count_us - offer->answered_us < OFFER_PAUSE_US)
        return;
    offer->answered_us = count_us;
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
