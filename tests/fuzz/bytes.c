// Fuzz target: bytes, as they come from a wire. The first one says what reads the rest: a decoder, or a
// whole device by one of its ports. Plans, settings and packets that are taken are written again.
#include "group.h"
#include "handshake.h"
#include "node.h"
#include "peer.h"

static struct node begun;
static struct host host;

int LLVMFuzzerInitialize(int *argc, char ***argv) {
    (void)argc, (void)argv;
    fuzz_begin(&begun, &host);
    return 0;
}

// In a block of exactly their size: a sanitizer sees each byte too many.
static uint8_t *copy(const uint8_t *bytes, int32_t size) {
    uint8_t *block = malloc(size ? (size_t)size : 1);
    memcpy(block, bytes, (size_t)size);
    return block;
}

static void read_plan(const uint8_t *bytes, int32_t size) {
    static struct plan plan, again;
    struct stamps stamps;
    uint8_t written[FRAME_PAYLOAD_MAX];
    if (!plan_decode(bytes, size, &stamps, &plan))
        return;
    PROMISE(plan_encode(&stamps, &plan, written, size / 2) <= size / 2);
    int32_t made = plan_encode(&stamps, &plan, written, sizeof written);
    PROMISE(made <= size || size > (int32_t)sizeof written || made < 0);
    if (made < 0)
        return;
    PROMISE(plan_decode(written, made, &stamps, &again));
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan.tracks & 1 << sink)
            PROMISE(memcmp(plan.points[sink], again.points[sink], plan.count * 4u) == 0);
}

static void read_status(const uint8_t *bytes, int32_t size) {
    static struct status status;
    uint8_t written[FRAME_PAYLOAD_MAX * 2];
    if (status_decode(bytes, size, &status))
        PROMISE(status.sample_count <= STATUS_SAMPLES_MAX);
    status = begun.device.status;
    status.sample_count = (uint8_t)size;
    PROMISE(status_encode(&status, written, size) <= size);
}

static void read_settings(const uint8_t *bytes, int32_t size, bool with_key) {
    struct device_settings settings = begun.device.settings;
    uint8_t written[SETTINGS_BYTES_MAX];
    if (!settings_decode(bytes, size, with_key, &settings))
        return;
    PROMISE(settings_encode(&settings, with_key, written, sizeof written) == size);
    PROMISE(memcmp(written, bytes, (size_t)size) == 0);
    settings_valid(&settings);
}

static void read_cobs(uint8_t *bytes, int32_t size) {
    uint8_t packet[COBS_BOUND(FRAME_MAX)];
    int32_t plain = cobs_decode(bytes, size);
    PROMISE(plain <= size);
    if (plain < 0 || plain > FRAME_MAX)
        return;
    int32_t made = cobs_encode(bytes, plain, packet);
    PROMISE(made <= (int32_t)sizeof packet && memchr(packet, 0, (size_t)made) == NULL);
    PROMISE(cobs_decode(packet, made) == plain && memcmp(packet, bytes, (size_t)plain) == 0);
}

static void read_other(uint8_t what, const uint8_t *bytes, int32_t size) {
    struct session session = host.session, group;
    struct nonces nonces = {{0}, {0}};
    struct stamps stamps;
    struct command command;
    struct peer_response response;
    struct peer_feed feed;
    static struct fault_log faults;
    uint64_t nonce;
    uint8_t written[64];
    switch (what) {
    case 0:
        frame_open(&session, bytes, size);
        break;
    case 1:
        sync_decode(bytes, size, &stamps);
        break;
    case 2:
        if (command_decode(bytes, size, &command))
            PROMISE(command_encode(&command, written, size) == size &&
                    command_encode(&command, written, size - 1) == -1 &&
                    memcmp(written, bytes, (size_t)size) == 0);
        break;
    case 3:
        fault_log_decode(bytes, size, &faults);
        break;
    case 4:
        hello_decode(bytes, size, nonces.host);
        welcome_decode(fuzz_key[0], bytes, size, &nonces);
        break;
    case 5:
        peer_request_decode(fuzz_key[0], bytes, size, &nonce);
        peer_response_decode(fuzz_key[0], bytes, size, &response);
        peer_feed_decode(fuzz_key[0], bytes, size, &feed);
        break;
    default:
        if (size >= FRAME_HEADER_BYTES)
            group_decode(&session, bytes, size - FRAME_HEADER_BYTES, &group);
        break;
    }
}

// Frames between two ends, lost, late, twice, changed on the way: each is taken once, as it was sent.
static void read_frames(const uint8_t *bytes, int32_t size) {
    static uint8_t frames[8][FRAME_MAX];
    int32_t sizes[8] = {0};
    bool taken[8] = {false};
    struct session from = host.session, to = begun.device.session;
    for (int32_t at = 0; at + 2 < size; at += 3) {
        int32_t slot = bytes[at] % 8, value = bytes[at + 2];
        uint8_t *frame = frames[slot];
        switch (bytes[at + 1] % 8) {
        case 0:
            from.sent += (uint64_t)value << (value % 32);
            break;
        case 1:
            from.sent = FRAME_COUNTER_MAX - (uint64_t)value % 4;
            break;
        case 2:
            if (sizes[slot] > 0) { // one bit
                frame[value % sizes[slot]] ^= (uint8_t)(1 << value / 32);
                PROMISE(frame_open(&to, frame, sizes[slot]) != FRAME_OK);
                frame[value % sizes[slot]] ^= (uint8_t)(1 << value / 32);
            }
            break;
        case 3:
        case 4: {
            bool good = frame_open(&to, frame, sizes[slot]) == FRAME_OK;
            PROMISE(!(good && taken[slot]));
            taken[slot] |= good;
            break;
        }
        case 5:
            to.begun = value != 0;
            from.begun = value != 1;
            break;
        default:
            memset(frame + FRAME_HEADER_BYTES, value, (size_t)value);
            sizes[slot] = frame_seal(&from, (enum frame_type)(value % 12), frame, value);
            taken[slot] = false;
        }
    }
}

// Packets, each as long as the byte before it says, to a device at a port.
static void read_device(int32_t port, const uint8_t *bytes, int32_t size) {
    static struct node node;
    memcpy(&node, &begun, sizeof node);
    for (int32_t at = 0; at < size;) {
        int32_t length = bytes[at] < size - at - 1 ? bytes[at] : size - at - 1;
        board_deliver(&node.board, port, node.board.true_us, bytes + at + 1, length);
        at += length + 1;
        fuzz_poll(&node);
        fuzz_promise(&node);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length) {
    if (length < 1 || length > 2000)
        return 0;
    int32_t size = (int32_t)length - 1;
    uint8_t what = data[0] % 16, *bytes = copy(data + 1, size);
    if (what == 0)
        read_plan(bytes, size);
    else if (what == 1)
        read_status(bytes, size);
    else if (what <= 3)
        read_settings(bytes, size, what == 3);
    else if (what == 4)
        read_cobs(bytes, size);
    else if (what == 14)
        read_frames(bytes, size);
    else if (what <= 6)
        read_device(what == 5 ? BOARD_HOST : 1, bytes, size);
    else
        read_other((uint8_t)(what - 7), bytes, size);
    free(bytes);
    return 0;
}
