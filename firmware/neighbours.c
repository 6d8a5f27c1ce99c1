#include "neighbours.h"
#include "cobs.h" // packets on the byte stream
#include "device.h"
#include "peer.h"

// The count is rounded down, and so is the time at it. A time that is too early proves less of what
// was sent, and more of what was received.
#define ROUNDED_US 1

static void send(struct board *board, int32_t port, const uint8_t *frame, int32_t size) {
    uint8_t packet[COBS_BOUND(PEER_RESPONSE_BYTES)];
    board_send(board, port, packet, cobs_encode(frame, size, packet));
}

void neighbours_ask(struct device *device, struct board *board, uint32_t count_us) {
    struct neighbours *neighbours = &device->neighbours;
    const struct device_settings *settings = &device->settings;
    if (settings->neighbours == 0 || count_us - neighbours->asked_us < neighbours->pause_us)
        return;
    uint64_t random = board_random(board);
    uint32_t quarter_us = settings->ask_us / 4;
    neighbours->asked_us = count_us;
    neighbours->pause_us =
        settings->ask_us - quarter_us + (uint32_t)(((random & 0xffff) * 2 * quarter_us) >> 16);
    for (int32_t port = BOARD_HOST + 1; port < BOARD_PORTS; port++) {
        if (!(settings->neighbours & 1 << port))
            continue;
        struct question *question = &neighbours->questions[port];
        uint8_t frame[PEER_REQUEST_BYTES];
        question->open = true;
        question->nonce = board_random(board);
        question->sent_us = board_count_us(board);
        peer_request_encode(settings->peer_key, question->nonce, frame);
        send(board, port, frame, sizeof frame);
    }
}

static void answer(struct device *device, struct board *board, uint64_t nonce, int32_t port,
                   uint32_t arrived_us) {
    const struct sync *sync = &device->sync;
    struct peer_response response = {
        .nonce = nonce,
        .received_us = clock_at(&device->clock, arrived_us) + ROUNDED_US,
        .sent_us = clock_at(&device->clock, board_count_us(board)),
        .least_error_ns = sync->least_error_ns,
        .most_error_ns = sync->most_error_ns,
        .lineage = sync->lineage,
        .settled = sync->settled,
    };
    uint8_t frame[PEER_RESPONSE_BYTES];
    peer_response_encode(device->settings.peer_key, &response, frame);
    send(board, port, frame, sizeof frame);
}

bool neighbours_take(struct device *device, struct board *board, const uint8_t *frame, int32_t size,
                     int32_t port, uint32_t arrived_us, uint32_t count_us) {
    const struct device_settings *settings = &device->settings;
    struct question *question = &device->neighbours.questions[port];
    struct peer_response response;
    uint64_t nonce;
    if (!(settings->neighbours & 1 << port))
        return false;
    if (peer_request_decode(settings->peer_key, frame, size, &nonce)) {
        answer(device, board, nonce, port, arrived_us);
        return true;
    }
    if (!peer_response_decode(settings->peer_key, frame, size, &response) || !question->open ||
        response.nonce != question->nonce)
        return false;
    question->open = false;
    struct stamps stamps = {.echo_us = question->sent_us,
                            .received_us = response.received_us,
                            .sent_us = response.sent_us};
    struct sync_source source = {.to_here_least_us = settings->peer_least_us,
                                 .to_there_least_us = settings->peer_least_us,
                                 .least_error_ns = response.least_error_ns,
                                 .most_error_ns = response.most_error_ns,
                                 .lineage = {response.lineage, response.settled}};
    device_take_stamps(device, &source, &stamps, arrived_us, count_us);
    return true;
}
