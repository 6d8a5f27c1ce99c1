// Feeds the firmware all that could reach it, under the sanitizers (test_sanitizers.py builds it).
//
// Exits with 0 if no sanitizer stopped it, every promise held and the walk went everywhere it
// should have: a harness that only ever sees refusals would prove little.
#include "board.h"
#include "cobs.h" // packets
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define POLLS 100000
#define LIVES 20 // the device is flashed anew so often

static uint64_t lcg = 20240229;

static uint32_t random32(void) { // Knuth's MMIX generator, its upper half
    lcg = lcg * 6364136223846793005u + 1442695040888963407u;
    return (uint32_t)(lcg >> 32);
}

static uint32_t below(uint32_t limit) { return random32() % limit; }

static int64_t between(int64_t low, int64_t high) {
    uint64_t wide = (uint64_t)random32() << 32 | random32();
    return low + (int64_t)(wide % ((uint64_t)high - (uint64_t)low + 1));
}

// Any number, and often one near an end of some range.
static int64_t extreme64(void) {
    static const int64_t ends[] = {0, 1LL << 15, 1LL << 25, 1LL << 30, 1LL << 31, 1LL << 60};
    int64_t value = ends[below(6)] + between(-2, 2);
    switch (below(6)) {
    case 0:
        return between(INT64_MIN / 2, INT64_MAX / 2);
    case 1:
        return INT64_MAX - below(3);
    case 2:
        return INT64_MIN + below(3);
    case 3:
        return -value;
    default:
        return value;
    }
}

static int32_t clip(int64_t value, int32_t limit) {
    return value > limit ? limit : value < -limit ? -limit : (int32_t)value;
}

static int32_t extreme32(void) { return below(20) ? clip(extreme64(), INT32_MAX) : INT32_MIN; }

#define PROMISE(condition)                                                                         \
    do {                                                                                           \
        if (!(condition)) {                                                                        \
            fprintf(stderr, "line %d: not so: %s\n", __LINE__, #condition);                        \
            exit(3);                                                                               \
        }                                                                                          \
    } while (0)

static struct scale random_scale(void) {
    return (struct scale){(uint16_t)(below(4) ? random32() : 65535), (uint8_t)below(32)};
}

static struct gate_limits random_limits(void) {
    int32_t size = below(2) ? GATE_POINT_MAX : (int32_t)below(GATE_POINT_MAX);
    int32_t difference = below(2) ? GATE_DIFFERENCE_MAX : 1 + (int32_t)below(GATE_DIFFERENCE_MAX);
    int32_t second = below(2) ? INT32_MAX : 1 + (int32_t)below(1u << 27);
    return (struct gate_limits){-size, size, difference, second};
}

static struct servo_settings random_servo(void) {
    return (struct servo_settings){
        .kp_tq = random_scale(),
        .ki_tq = random_scale(),
        .kd_tq = random_scale(),
        .velocity_tq = random_scale(),
        .resistance_mV = random_scale(),
        .emf_mV = random_scale(),
        .supply_duty = random_scale(),
        .torque_limit_tq = below(2) ? SERVO_TORQUE_MAX : 1 + (int32_t)below(SERVO_TORQUE_MAX),
        .integrate_running = below(2),
    };
}

// ---- kernels, at the ends of what their headers allow

static void splines(void) {
    static struct track track;
    for (int32_t n = 0; n < 2000; n++) {
        int32_t points[PLAN_POINTS_MAX], count = 3 + (int32_t)below(PLAN_POINTS_MAX - 2);
        int64_t point = between(-GATE_POINT_MAX, GATE_POINT_MAX);
        for (int32_t i = 0; i < count; i++) {
            int64_t most = (1 << 26) - 1; // as track.h says
            int64_t d = below(2) ? between(-most, most) : below(2) ? most : -most;
            points[i] = clip(point + d, GATE_POINT_MAX);
            point = points[i];
        }
        int64_t first_knot = below(3) ? between(-(1LL << 45), 1LL << 45) : between(-200, 200);
        memset(&track, 0, sizeof track);
        track_write(&track, first_knot, points, count);
        for (int32_t i = 0; i < 50; i++) {
            int32_t shift = 9 + (int32_t)below(7);
            int64_t knot = first_knot + between(-3, count + 5);
            struct track_value v =
                track_evaluate(&track, knot * (1LL << shift) + below(1u << shift), shift);
            PROMISE(v.value < GATE_POINT_MAX + 200 && v.value > -GATE_POINT_MAX - 200);
            PROMISE(v.rate <= 1 << 26 && v.rate >= -(1 << 26) - 3);
        }
    }
}

static void servos(void) {
    for (int32_t n = 0; n < 5000; n++) {
        struct servo_settings settings = random_servo();
        struct servo servo = {0};
        for (int32_t i = 0; i < 20; i++) {
            struct setpoint setpoint = {
                .position_pq = clip(extreme64(), GATE_POINT_MAX + 200),
                .velocity_pq = extreme32(),
                .torque_tq = extreme32(),
                .kp = random_scale(),
                .ki = random_scale(),
                .kd = random_scale(),
                .integrate = below(2),
            };
            int32_t duty = servo_step(&settings, &servo, &setpoint, extreme32());
            PROMISE(duty <= SERVO_DUTY_MAX && duty >= -SERVO_DUTY_MAX);
            PROMISE(servo.torque_tq <= settings.torque_limit_tq);
            PROMISE(servo.torque_tq >= -settings.torque_limit_tq);
        }
    }
}

static void gates(void) {
    static struct track track;
    int32_t accepted = 0;
    for (int32_t n = 0; n < 50000; n++) {
        struct gate_limits limits = random_limits();
        int32_t points[PLAN_POINTS_MAX], count = 3 + (int32_t)below(PLAN_POINTS_MAX - 2);
        int64_t knot = between(-(1LL << 51), 1LL << 51);
        memset(&track, 0, sizeof track);
        int32_t rest = (int32_t)between(limits.point_min, limits.point_max);
        if (below(3)) { // at rest, some knots ago
            for (int32_t i = 0; i < count; i++)
                points[i] = rest;
            track_write(&track, knot - (int64_t)below(200), points, count);
        }
        int32_t noise = below(2) ? 0 : (int32_t)below(20); // one of so many points is anything
        for (int32_t i = 0; i < count; i++)
            points[i] = noise && !below((uint32_t)noise) ? extreme32() : rest;
        int64_t first_knot = below(3) ? knot + between(-130, 130) : extreme64();
        accepted +=
            gate_check_track(&limits, &track, first_knot, points, count, knot) == GATE_ACCEPTED;
    }
    PROMISE(accepted > 1000);
}

// Random bytes, in a block of exactly their size so that reading beyond it is seen.
static void decoders(void) {
    static struct plan plan;
    static struct status status;
    struct stamps stamps;
    for (int32_t n = 0; n < 50000; n++) {
        int32_t size = (int32_t)below(below(2) ? 60 : 400);
        uint8_t *bytes = malloc((size_t)size + 1);
        uint32_t mask = below(2) ? 0xff : 0x03; // small bytes are varints of one byte
        for (int32_t i = 0; i < size; i++)
            bytes[i] = (uint8_t)(random32() & mask);
        bytes = realloc(bytes, size ? (size_t)size : 1);
        if (size > 38)
            bytes[36] = 1, bytes[37] = (uint8_t)below(130);
        sync_decode(bytes, size, &stamps);
        plan_decode(bytes, size, &stamps, &plan);
        status_decode(bytes, size, &status);
        PROMISE(cobs_decode(bytes, size) <= size);
        free(bytes);
    }
}

// ---- the device

struct host {
    struct session session;
    struct stamps stamps;
    uint32_t number;
    int64_t first_knot; // of its first plan
    int32_t rest_pq;
    uint8_t frame[FRAME_MAX];
};

struct tally {
    uint32_t states[DEVICE_HOLD + 1], refusals[GATE_SINK + 1], bad, accepted, statuses;
};

static void send(struct host *host, struct board *board, enum frame_type type, int32_t size) {
    uint8_t packet[COBS_BOUND(FRAME_MAX)];
    if (size < 0)
        return;
    size = frame_seal(&host->session, type, host->frame, size);
    size = cobs_encode(host->frame, size, packet);
    if (!below(20))
        packet[below((uint32_t)size)] ^= (uint8_t)(1 << below(8));
    board_deliver(board, board->true_us + (int64_t)below(300), packet, size);
}

static void send_noise(struct host *host, struct board *board) {
    int32_t size = (int32_t)below(below(4) ? 80 : FRAME_PAYLOAD_MAX + 1);
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    for (int32_t i = 0; i < size; i++)
        payload[i] = (uint8_t)random32();
    if (below(2)) { // signed, so that it reaches what parses it
        send(host, board, (enum frame_type)below(5), size);
    } else {
        for (int32_t i = 0; i < size; i++)
            payload[i] |= payload[i] == 0;
        board_deliver(board, board->true_us, payload, size);
    }
}

static void send_sync(struct host *host, struct board *board, bool hostile) {
    struct stamps stamps = host->stamps;
    stamps.sent_us = board->true_us;
    if (hostile) {
        int64_t *fields[] = {&stamps.status_us, &stamps.status_received_us, &stamps.sent_us};
        *fields[below(3)] = extreme64();
    }
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, board, FRAME_SYNC, sync_encode(&stamps, payload, FRAME_PAYLOAD_MAX));
}

// From resting plans around the live knots to points that are anything.
static void send_plan(struct host *host, struct node *node, int32_t wildness) {
    static struct plan plan;
    const struct device *device = &node->device;
    int64_t knot = device->clock.system_us >> device->settings.knot_shift;
    if (device->state == DEVICE_IDLE) {
        host->first_knot = knot + (int64_t)below(8);
        host->rest_pq =
            clip((int64_t)node->board.encoder_count * 1024 + between(-1000, 1000), GATE_POINT_MAX);
    }
    plan.number = ++host->number;
    plan.first_knot = host->first_knot;
    int64_t end = device->tracks[TRACK_POSITION].end;
    if (device->state != DEVICE_IDLE)
        plan.first_knot = knot - (int64_t)below(20);
    if (plan.first_knot > end + 1 && device->state != DEVICE_IDLE)
        plan.first_knot = end + 1;
    plan.count = (uint8_t)(3 + below(60));
    plan.tracks = (uint8_t)(1 | (device->tracks[TRACK_TORQUE].written || below(2)) << 1 |
                            (device->tracks[TRACK_KP].written || !below(4)) << 2);
    int64_t free_knot = knot + GATE_LIVE_KNOTS + 1;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        const struct track *track = &device->tracks[sink];
        int64_t last = sink == TRACK_POSITION ? host->rest_pq : 100;
        int64_t step = 0;
        for (int32_t i = 0; i < plan.count; i++) {
            if (track->written && plan.first_knot + i < free_knot) {
                last = track_point(track, plan.first_knot + i);
            } else if (device->state != DEVICE_IDLE && i < plan.count - 3) {
                step = clip(step + between(-50000, 50000), 100000);
                last = clip(last + (sink == TRACK_POSITION ? step : step / 100), GATE_POINT_MAX);
            }
            plan.points[sink][i] = (int32_t)last;
            if (wildness && !below((uint32_t)wildness))
                plan.points[sink][i] = extreme32();
        }
    }
    if (!below(30))
        plan.first_knot = extreme64();
    if (!below(30))
        plan.tracks = (uint8_t)(1 + below(31));
    struct stamps stamps = host->stamps;
    stamps.sent_us = below(30) ? board_count_us(&node->board) + host->stamps.sent_us : extreme64();
    stamps.sent_us = below(30) ? node->device.clock.system_us : stamps.sent_us;
    stamps.status_us = below(3) ? 0 : stamps.status_us;
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, &node->board, FRAME_PLAN, plan_encode(&stamps, &plan, payload, FRAME_PAYLOAD_MAX));
}

static void read_statuses(struct host *host, struct board *board, struct tally *tally) {
    static struct status status;
    for (int32_t i = 0; i < BOARD_OUTBOX; i++) {
        struct parcel *parcel = &board->outbox[i];
        if (parcel->size == 0)
            continue;
        int32_t size = cobs_decode(parcel->bytes, parcel->size);
        PROMISE(frame_open(&host->session, parcel->bytes, size) == FRAME_OK);
        size -= FRAME_HEADER_BYTES + FRAME_TAG_BYTES;
        PROMISE(status_decode(parcel->bytes + FRAME_HEADER_BYTES, size, &status));
        host->stamps.status_us = status.sent_us;
        host->stamps.status_received_us = parcel->time_us;
        tally->statuses++;
        parcel->size = 0;
    }
}

static void flash(struct node *node, struct host *host, bool sane) {
    struct device_settings settings = {.session = random32(), .servo = random_servo()};
    for (int32_t i = 0; i < SIPHASH_KEY_BYTES; i++)
        settings.key[i] = (uint8_t)random32();
    settings.knot_shift = (uint8_t)(9 + below(7));
    settings.servo_period_us = (uint16_t)(sane ? 1000 : 1 + below(65535));
    settings.sample_every = (uint16_t)(1 + below(4));
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        settings.limits[sink] =
            sane ? (struct gate_limits){-GATE_POINT_MAX, GATE_POINT_MAX, 1 << 25, 1 << 26}
                 : random_limits();
    memset(node, 0, sizeof *node);
    node->board.true_us = sane ? (int64_t)below(2) * 1700000000000000 : between(0, 1LL << 50);
    node->board.count_offset = between(-(1LL << 40), 1LL << 40);
    node->board.drift_ppb = (int32_t)between(-100000, 100000);
    memset(host, 0, sizeof *host);
    memcpy(host->session.key, settings.key, sizeof settings.key);
    host->session.number = settings.session;
    host->session.send_direction = TO_DEVICE;
    device_init(&node->device, &settings, board_count_us(&node->board));
}

static void live(struct tally *tally, bool sane) {
    static struct node node;
    static struct host host;
    flash(&node, &host, sane);
    uint64_t motion_us = 0;
    for (int32_t n = 0; n < POLLS / LIVES; n++) {
        node.board.true_us += (int64_t)(sane || below(1000) ? below(250) : below(1000000));
        motion_us += 1;
        if (sane)
            node.board.encoder_count = (int32_t)(motion_us / 50 % 100) - 50;
        else
            node.board.encoder_count = below(4) ? extreme32() : (int32_t)between(-100, 100);
        uint32_t what = below(100);
        if (what < 8 || (what < 30 && !node.device.clock.synced))
            send_sync(&host, &node.board, !sane && !below(4));
        else if (what < 18)
            send_plan(&host, &node, sane ? (below(5) ? 0 : 30) : 40);
        else if (what < (sane ? 20 : 30))
            send_noise(&host, &node.board);
        device_poll(&node.device, &node.board);
        read_statuses(&host, &node.board, tally);
        tally->states[node.device.state]++;
        PROMISE(node.board.duty_q15 <= SERVO_DUTY_MAX && node.board.duty_q15 >= -SERVO_DUTY_MAX);
    }
    tally->refusals[node.device.status.refusal]++;
    tally->bad += node.device.status.counters.frames_bad;
    tally->accepted += node.device.status.counters.plans_accepted;
}

int main(void) {
    struct tally tally = {0};
    splines();
    servos();
    gates();
    decoders();
    for (int32_t i = 0; i < LIVES; i++)
        live(&tally, i % 4 != 3);
    for (int32_t state = DEVICE_UNSYNCED; state <= DEVICE_HOLD; state++) {
        printf("state %d: %u polls\n", state, tally.states[state]);
        PROMISE(tally.states[state] > 100);
    }
    printf("%u plans accepted, %u bad frames, %u statuses\n", tally.accepted, tally.bad,
           tally.statuses);
    PROMISE(tally.accepted > 200 && tally.bad > 1000 && tally.statuses > 500);
    return 0;
}
