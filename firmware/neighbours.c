#include "neighbours.h"
#include "cobs.h" // packets on the byte stream
#include "device.h"
#include "fixed.h" // clamp
#include "peer.h"

_Static_assert(BOARD_PORTS <= SYNC_SOURCES, "each port is a source of its own");

#define BLUR_PPM 800 // a clock is slewed by 500 ppm at most, a reference drifts by 300 against it
#define BLUR_MAX_US 1000000
// The count is rounded down, and so is the time at it. A time that is too early proves less of what
// was sent, and more of what was received.
#define ROUNDED_US 1

static void send(struct board *board, int32_t port, const uint8_t *frame, int32_t size) {
    uint8_t packet[COBS_BOUND(PEER_FEED_BYTES)];
    board_send(board, port, packet, cobs_encode(frame, size, packet));
}

static void ask(struct device *device, struct board *board) {
    struct neighbours *neighbours = &device->neighbours;
    const struct device_settings *settings = &device->settings;
    uint32_t count_us = board_count_us(board), quarter_us = settings->ask_us / 4;
    if (count_us - neighbours->asked_us < neighbours->pause_us)
        return;
    uint64_t random = board_random(board);
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

// The interval is that of the last steering, and the clock has gone on since, and since the request
// arrived, by another rate than the reference. A reference's own error is none.
static void widen(struct peer_response *response, int64_t elapsed_us) {
    int32_t blur_ns = 1 + (int32_t)(fixed_clamp64(elapsed_us, BLUR_MAX_US) * BLUR_PPM / 1000);
    if (response->least_error_ns > -SYNC_ERROR_OPEN + blur_ns)
        response->least_error_ns -= blur_ns;
    if (response->most_error_ns < SYNC_ERROR_OPEN - blur_ns)
        response->most_error_ns += blur_ns;
}

static void answer(struct device *device, struct board *board, int32_t port) {
    const struct sync *sync = &device->sync;
    struct demand *demand = &device->neighbours.demands[port];
    uint32_t count_us = board_count_us(board);
    if (!demand->open || (int32_t)(count_us - demand->answered_us) < 0)
        return;
    demand->open = false;
    struct peer_response response = {
        .nonce = demand->nonce,
        .received_us = demand->received_us,
        .sent_us = clock_at(&device->clock, count_us),
        .least_error_ns = sync->least_error_ns,
        .most_error_ns = sync->most_error_ns,
        .lineage = sync->lineage,
        .settled = sync->settled,
    };
    uint32_t asked_us = count_us - demand->arrived_us;
    uint32_t ran_us = (uint32_t)(clock_ticks(&device->clock, count_us) - sync->told_us);
    if (!sync_is_reference(sync))
        widen(&response, asked_us > ran_us ? asked_us : ran_us);
    uint8_t frame[PEER_RESPONSE_BYTES];
    peer_response_encode(device->settings.peer_key, &response, frame);
    send(board, port, frame, sizeof frame);
}

static void keep(struct device *device, struct board *board, int32_t port, uint64_t nonce,
                 uint32_t arrived_us) {
    uint32_t dither_us = device->settings.dither_us;
    uint32_t wait_us = dither_us == 0 ? 0 : (uint32_t)(board_random(board) % dither_us);
    struct demand demand = {.open = true,
                            .nonce = nonce,
                            .arrived_us = arrived_us,
                            .received_us = clock_at(&device->clock, arrived_us) + ROUNDED_US,
                            .answered_us = board_count_us(board) + wait_us};
    device->neighbours.demands[port] = demand;
}

// Where a host gives the time there is no lineage.
static uint32_t lineage(const struct device *device) {
    return device->settings.sync.among_boards ? device->sync.lineage : 0;
}

// What the last servo period has found, while its time can be relied on.
static void feed(struct device *device, struct board *board) {
    struct signals *signals = &device->signals;
    const struct logic *logic = &signals->logic;
    if (!device->sync.settled)
        return;
    if (signals->stepped)
        signals->values[INPUT_LAG] =
            feeds_step(&signals->feeds, logic, signals->values, device->clock.system_us);
    signals->stepped = false;
    const struct peer_feed *next = feeds_next(&signals->feeds, logic->feeds);
    if (!next)
        return;
    struct peer_feed told = *next;
    uint8_t frame[PEER_FEED_BYTES];
    told.lineage = lineage(device);
    peer_feed_encode(device->settings.peer_key, &told, frame);
    for (int32_t port = BOARD_HOST + 1; port < BOARD_PORTS; port++)
        if (device->settings.neighbours & 1 << port)
            send(board, port, frame, sizeof frame);
}

static bool take_feed(struct device *device, const struct peer_feed *frame, uint32_t count_us) {
    return device->sync.settled && frame->lineage == lineage(device) &&
           signals_feed(&device->signals, frame, clock_at(&device->clock, count_us));
}

void neighbours_flush(struct device *device) {
    for (int32_t port = 0; port < BOARD_PORTS; port++)
        device->neighbours.demands[port].open = false;
}

void neighbours_speak(struct device *device, struct board *board) {
    ask(device, board);
    for (int32_t port = BOARD_HOST + 1; port < BOARD_PORTS; port++)
        answer(device, board, port);
    feed(device, board);
}

bool neighbours_take(struct device *device, struct board *board, const uint8_t *frame, int32_t size,
                     int32_t port, uint32_t arrived_us, uint32_t count_us) {
    const struct device_settings *settings = &device->settings;
    struct question *question = &device->neighbours.questions[port];
    struct peer_response response;
    struct peer_feed points;
    uint64_t nonce;
    if (!(settings->neighbours & 1 << port))
        return false;
    if (peer_request_decode(settings->peer_key, frame, size, &nonce)) {
        keep(device, board, port, nonce, arrived_us);
        return true;
    }
    if (peer_feed_decode(settings->peer_key, frame, size, &points))
        return take_feed(device, &points, count_us);
    if (!peer_response_decode(settings->peer_key, frame, size, &response) || !question->open ||
        response.nonce != question->nonce)
        return false;
    question->open = false;
    struct stamps stamps = {.echo_us = question->sent_us,
                            .received_us = response.received_us,
                            .sent_us = response.sent_us};
    struct sync_source source = {.number = (uint8_t)port,
                                 .to_here_least_us = settings->peer_least_us,
                                 .to_there_least_us = settings->peer_least_us,
                                 .least_error_ns = response.least_error_ns,
                                 .most_error_ns = response.most_error_ns,
                                 .lineage = {response.lineage, response.settled}};
    device_take_stamps(device, &source, &stamps, arrived_us, count_us);
    return true;
}
