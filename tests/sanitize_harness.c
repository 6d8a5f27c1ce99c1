// Feeds the firmware all that could reach it, under the sanitizers (test_sanitizers.py builds it).
//
// The linker lets the calls of some of the board's functions pass through here (--wrap): between them
// time may go on and the guard's interrupt may come.
//
// Exits with 0 if no sanitizer stopped it, every promise held and the walk went everywhere it
// should have: a harness that only ever sees refusals would prove little.
#include "board.h"
#include "cobs.h" // packets
#include "command.h"
#include "gap.h"
#include "group.h"
#include "peer.h"
#include "store.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define POLLS 1000000
#define LIVES 20 // so many boards

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
    int32_t stop = below(2) ? 0 : (int32_t)below(2 * GATE_DIFFERENCE_MAX + 1);
    return (struct gate_limits){!below(4), -size, size, difference, second, stop};
}

static struct servo_settings random_servo(void) {
    return (struct servo_settings){
        .kp_tq = random_scale(),
        .ki_tq = random_scale(),
        .kd_tq = random_scale(),
        .velocity_tq = random_scale(),
        .acceleration_tq = random_scale(),
        .resistance_mV = random_scale(),
        .emf_mV = random_scale(),
        .emf_tq = random_scale(),
        .supply_duty = random_scale(),
        .torque_limit_tq = below(2) ? SERVO_TORQUE_MAX : 1 + (int32_t)below(SERVO_TORQUE_MAX),
        .integrate_running = below(2),
        .ahead_us = (uint16_t)below(513), // of a knot of 512 us at least
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
            struct instant at = instant_at(knot * (1LL << shift) + below(1u << shift), shift);
            PROMISE(at.knot == knot);
            int32_t value = track_value(&track, &at), rate = track_rate(&track, &at);
            track_curve(&track, &at);
            PROMISE(value < GATE_POINT_MAX + 200 && value > -GATE_POINT_MAX - 200);
            PROMISE(rate <= 1 << 26 && rate >= -(1 << 26) - 3);
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
                .feedback_limit_tq = below(2) ? SERVO_FEEDBACK_FREE : (int32_t)below(1 << 30),
                .integrate = below(2),
            };
            int32_t duty = servo_step(&settings, &servo, &setpoint, extreme32());
            PROMISE(duty <= SERVO_DUTY_MAX && duty >= -SERVO_DUTY_MAX);
            PROMISE(servo.torque_tq <= settings.torque_limit_tq);
            PROMISE(servo.torque_tq >= -settings.torque_limit_tq);
        }
    }
}

static int32_t positive32(void) {
    int64_t value = extreme64();
    return value < 0 || value > INT32_MAX ? INT32_MAX : value == 0 ? 1 : (int32_t)value;
}

// Anything that settings_valid lets pass.
static struct monitor_settings random_monitor(void) {
    int32_t low = extreme32(), high = extreme32();
    return (struct monitor_settings){
        .following_pq = positive32(),
        .following_periods = (uint16_t)below(below(2) ? 9 : 65536),
        .speed_pq = positive32(),
        .bounded = below(2),
        .low_pq = low < high ? low : high,
        .high_pq = low < high ? high : low,
        .deceleration_q16 = positive32(),
        .torque_periods = below(2) ? below(9) : random32(),
        .load_q8 = random_scale(),
        .overload = below(2) ? below(1000) : random32(),
        .heating_q16 = (uint16_t)random32(),
        .rise_q16 = positive32(),
        .stuck_pq = positive32(),
        .stuck_periods = below(2) ? below(9) : random32(),
        .spike_counts = below(2) ? (1 << 18) - 1 : 1 + (int32_t)below((1 << 18) - 1),
        .supply_min_mV = extreme32(),
        .supply_max_mV = extreme32(),
        .chopper_mV = extreme32(),
        .late_us = below(2) ? UINT32_MAX : random32(),
    };
}

static void monitors(void) {
    uint32_t found[REASONS] = {0};
    for (int32_t n = 0; n < 1000; n++) {
        struct monitor_settings settings = random_monitor();
        struct monitor monitor = {0};
        int32_t count = extreme32(), step = (int32_t)between(-(1 << 18), 1 << 18);
        step = below(2) ? step : 0;
        for (int32_t i = 0; i < 600; i++) {
            struct servo servo = {
                .error_pq = clip(extreme64(), (1 << 29) - 1),
                .torque_tq = clip(extreme64(), SERVO_TORQUE_MAX),
                .effort_tq = clip(extreme64(), 1 << 30) & INT32_MAX,
                .feedback_tq = clip(extreme64(), 1 << 29),
                .clipped = below(2),
            };
            struct observation seen = {
                .count = count = below(200) ? fixed_sum(count, step) : extreme32(),
                .position_pq = below(2) ? clip(extreme64(), 1 << 30) : clip(count, 1 << 30),
                .setpoint_pq = extreme32(),
                .servo = &servo,
                .torque_limit_tq = below(2) ? SERVO_TORQUE_MAX : 1 + (int32_t)below(1 << 25),
                .supply_mV = extreme32(),
                .late_us = random32(),
                .power = below(8),
                .driven = below(8),
                .bounded = below(2),
                .may_stand = below(2),
                .looks = (uint8_t)(below(2) ? LOOKS : random32() & LOOKS),
                .stuck_periods = (uint8_t)(below(2) ? 1 : random32()),
                .heat_shift = (uint8_t)below(6),
            };
            monitor_step(&settings, &monitor, &seen);
            found[monitor.breach.reason]++;
            PROMISE(monitor.overload >= 0 && monitor.rise_q16 >= 0);
        }
    }
    static const uint8_t measured[] = {
        REASON_FOLLOWING, REASON_SPEED,   REASON_ROOM,         REASON_TORQUE,
        REASON_I2T,       REASON_WINDING, REASON_LATE,         REASON_STUCK,
        REASON_REVERSED,  REASON_SPIKE,   REASON_UNDERVOLTAGE, REASON_OVERVOLTAGE,
    };
    for (uint32_t i = 0; i < sizeof measured; i++)
        PROMISE(found[measured[i]] > 0);
}

static void ramps(void) {
    for (int32_t n = 0; n < 5000; n++) {
        struct ramp ramp;
        ramp_start(&ramp, extreme32(), clip(extreme64(), 1 << 28),
                   clip(extreme64(), SERVO_TORQUE_MAX), clip(extreme64(), SERVO_TORQUE_MAX));
        int32_t deceleration_q16 = positive32(), step_tq = positive32();
        for (int32_t i = 0; i < 50; i++) {
            int64_t before = ramp.velocity_q16;
            ramp_step(&ramp, deceleration_q16, step_tq);
            PROMISE(before < 0 ? ramp.velocity_q16 <= 0 && ramp.velocity_q16 > before
                               : ramp.velocity_q16 >= 0 && ramp.velocity_q16 <= before);
            ramp_position_pq(&ramp);
            ramp_velocity_pq(&ramp);
        }
    }
}

static struct home_settings random_home(void) {
    return (struct home_settings){
        .method = (uint8_t)below(HOME_METHODS),
        .backwards = below(2),
        .mark_count = extreme32(),
        .speed_q16 = 1 + (int32_t)below(1 << 29),
        .acceleration_q16 = positive32(),
        .torque_tq = positive32(),
        .way_counts = positive32(),
        .still_periods = (uint16_t)below(50),
    };
}

static void homes(void) {
    uint32_t results[3] = {0};
    for (int32_t n = 0; n < 5000; n++) {
        struct home_settings settings = random_home();
        struct home home = {0};
        int32_t count = extreme32();
        home_begin(&settings, &home, below(4) ? TASK_HOME : TASK_JOG, extreme32(), count,
                   extreme32());
        for (int32_t i = 0; i < 60; i++) {
            struct home_marks marks = {
                .count = below(4) ? count : (count = extreme32()),
                .indexed = !below(20),
                .index_count = extreme32(),
                .on_switch = !below(3),
                .pushing = below(10),
            };
            results[home_step(&settings, &home, &marks)]++;
            PROMISE(home.velocity_q16 <= settings.speed_q16);
            PROMISE(home.velocity_q16 >= -settings.speed_q16);
            home_position_pq(&home);
            home_velocity_pq(&home);
        }
    }
    PROMISE(results[TASK_RUNS] > 100 && results[TASK_DONE] > 100 && results[TASK_FAILED] > 100);
}

static void gaps(void) {
    static struct track tracks[TRACK_COUNT];
    static struct plan plan;
    uint32_t filled = 0;
    for (int32_t n = 0; n < 20000; n++) {
        uint8_t policies[TRACK_COUNT];
        int64_t end = between(-(1LL << 50), 1LL << 50);
        plan.tracks = (uint8_t)(1 + below((1 << TRACK_COUNT) - 1));
        plan.count = (uint8_t)(below(4) ? 3 + below(10) : 120 + below(9));
        plan.first_knot = below(8) ? end + (int64_t)below(8) : extreme64() / 2;
        for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
            policies[sink] = (uint8_t)below(GAP_POLICIES);
            int32_t points[3] = {extreme32(), extreme32(), extreme32()};
            memset(&tracks[sink], 0, sizeof tracks[sink]);
            if (below(4))
                track_write(&tracks[sink], end - 2 - (int64_t)below(3), points, 3);
            for (int32_t i = 0; i < plan.count; i++)
                plan.points[sink][i] = extreme32();
        }
        gap_verdict(policies, tracks, &plan);
        int64_t missing = gap_knots(tracks, &plan), first_knot = plan.first_knot;
        if (missing > GAP_FILL_MAX)
            continue;
        uint8_t count = plan.count;
        bool fits = gap_fill(policies, tracks, &plan);
        PROMISE(fits == (count + missing <= PLAN_POINTS_MAX));
        PROMISE(!fits ||
                (plan.count == count + missing && plan.first_knot == first_knot - missing));
        filled += fits && missing > 0;
    }
    PROMISE(filled > 1000);
}

// Anything that settings_valid lets pass.
static struct sync_settings random_sync(void) {
    return (struct sync_settings){
        .method = (uint8_t)below(SYNC_METHODS),
        .among_boards = !below(4),
        .drift_ppm = (uint16_t)(below(3) ? 100 + below(201) : below(301)),
        .wander_ppb_s = (uint16_t)(below(3) ? below(2000) : below(SYNC_WANDER_MAX_PPB_S + 1)),
        .to_device_least_us = below(3) ? 0 : below(SYNC_LIMIT_MAX_US + 1),
        .to_host_least_us = below(3) ? 0 : below(SYNC_LIMIT_MAX_US + 1),
        .limit_us = 1 + below(below(2) ? 1000 : SYNC_LIMIT_MAX_US),
        .average = {below(2) ? below(100000) : random32(), (uint16_t)random32(),
                    (uint16_t)random32()},
    };
}

// A host, or a neighbour that says of itself what it likes.
static struct sync_source random_source(const struct sync_settings *settings, bool honest,
                                        bool alone) {
    struct sync_source source = sync_host(settings);
    if (!settings->among_boards && (alone || below(2)))
        return source;
    source.number = (uint8_t)below(SYNC_SOURCES);
    source.lineage = (struct lineage){below(4), below(2)};
    if (!honest) {
        source.least_error_ns = extreme32();
        source.most_error_ns = extreme32();
    }
    return source;
}

// A mark that the board has dated, and what others make of it.
static void agree(struct sync *sync, const struct sync_settings *settings,
                  const struct headway_clock *clock, uint32_t count_us, bool honest) {
    uint32_t at_us = count_us - below(20000);
    struct mark mark = sync_date(sync, settings, clock, (uint16_t)random32(), at_us);
    PROMISE(mark.width_us != MARK_OPEN || mark.least_us == 0);
    if (!honest) {
        mark.least_us = below(2) ? extreme64() / 8 : mark.least_us + between(-100, 100);
        mark.width_us = (uint16_t)random32();
    }
    if (mark.width_us != MARK_OPEN)
        sync_take_mark(sync, settings, clock, &mark, at_us, count_us);
}

// Hosts that tell the truth, and those that tell anything; from milliseconds to half an hour apart,
// and once over years.
static void clocks(void) {
    uint32_t taken = 0, excluded = 0, settled = 0, stepped = 0, dated = 0, doubtful = 0;
    for (int32_t n = 0; n < 2000; n++) {
        struct sync_settings settings = random_sync();
        struct sync sync = {.id = settings.among_boards ? 1 + below(3) : 0};
        uint32_t count_us = random32(), echo_us = count_us;
        struct headway_clock clock = {.count_us = count_us};
        int64_t base_us = below(2) ? between(-PLAN_TIME_MAX, PLAN_TIME_MAX) / 2 : 0, host_us = 0;
        uint32_t longest_us = below(3) ? 50000 : below(2) ? 40000000 : 1u << 31;
        bool honest = below(3), alone = below(2);
        sync_restart(&sync);
        for (int32_t i = 0; i < (n == 0 ? 100000 : 150); i++) {
            uint32_t passed_us = n == 0 ? (1u << 31) - 1 : below(longest_us);
            int64_t before_us = clock.system_us;
            count_us += passed_us;
            host_us += passed_us;
            if (i == 75 && below(2)) // somebody sets it
                host_us += between(-5000, 5000);
            clock_advance(&clock, count_us);
            bool may_step = below(2);
            bool steps = sync_steer(&sync, &settings, &clock, may_step);
            PROMISE(steps || clock.system_us >= before_us);
            PROMISE(clock.rate_q32 <= CLOCK_RATE_MAX_Q32 && clock.rate_q32 >= -CLOCK_RATE_MAX_Q32);
            PROMISE(sync_error_us(&sync) >= 0);
            stepped += steps;
            settled += sync.settled;
            struct stamps stamps = {echo_us, base_us + host_us, base_us + host_us, {0, 0, 0}};
            if (!honest && below(2))
                stamps.sent_us = extreme64() / 8;
            if (!honest && below(2))
                stamps.received_us = extreme64() / 8;
            if (!honest && below(2))
                stamps.echo_us = random32();
            if (n == 0 && i % 1000)
                continue;
            struct sync_source source = random_source(&settings, honest, alone);
            bool good = sync_take(&sync, &settings, &clock, &source, &stamps, count_us - below(2),
                                  count_us, may_step);
            if (!settings.among_boards && below(2)) // marks are the host's time
                agree(&sync, &settings, &clock, count_us, honest);
            taken += good;
            excluded += !good;
            echo_us = count_us;
            dated += sync.marked;
            doubtful += sync.doubtful;
            if (sync.outcast >= SYNC_OUTCAST || (sync.doubtful && below(2)))
                sync_restart(&sync);
        }
    }
    PROMISE(taken > 1000 && excluded > 1000 && settled > 1000 && stepped > 1000);
    PROMISE(dated > 1000 && doubtful > 100);
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
    static struct fault_log faults;
    struct device_settings settings;
    struct nonces nonces = {{0}, {0}};
    struct session group, session = {0};
    struct command command;
    struct stamps stamps;
    for (int32_t n = 0; n < 50000; n++) {
        int32_t size = (int32_t)below(below(2) ? 60 : 400);
        uint8_t *bytes = malloc((size_t)size + 1);
        uint32_t mask = below(2) ? 0xff : 0x03; // small bytes are varints of one byte
        for (int32_t i = 0; i < size; i++)
            bytes[i] = (uint8_t)(random32() & mask);
        bytes = realloc(bytes, size ? (size_t)size : 1);
        if (size > 35) // a plan's tracks and count
            bytes[34] = 1, bytes[35] = (uint8_t)below(130);
        sync_decode(bytes, size, &stamps);
        plan_decode(bytes, size, &stamps, &plan);
        status_decode(bytes, size, &status);
        command_decode(bytes, size, &command);
        fault_log_decode(bytes, size, &faults);
        settings_decode(bytes, size, below(2), &settings);
        hello_decode(bytes, size, nonces.host);
        welcome_decode(nonces.device, bytes, size, &nonces);
        frame_open(&session, bytes, size);
        if (size >= FRAME_HEADER_BYTES)
            group_decode(&session, bytes, size - FRAME_HEADER_BYTES, &group);
        PROMISE(cobs_decode(bytes, size) <= size);
        free(bytes);
    }
}

// ---- the guard, which may come at any time

static struct node *interrupted; // whose device_poll is running, if any
static uint32_t interrupts, trips;

static void guard(struct node *node) {
    bool lets = node->device.guard.verdict == GUARD_LETS;
    device_guard(&node->device, &node->board);
    trips += lets && node->device.guard.verdict != GUARD_LETS;
}

static void interrupt(void) {
    if (!interrupted || below(3))
        return;
    struct node *node = interrupted;
    interrupted = NULL; // the guard calls the board as well
    if (!below(2000))
        node->board.true_us += below(20000);
    guard(node);
    interrupted = node;
    interrupts++;
}

#define WRAP(function, type, value)                                                                \
    void __real_##function(struct board *board, type value);                                       \
    void __wrap_##function(struct board *board, type value);                                       \
    void __wrap_##function(struct board *board, type value) {                                      \
        interrupt();                                                                               \
        __real_##function(board, value);                                                           \
        interrupt();                                                                               \
    }

WRAP(board_set_power, bool, on)
WRAP(board_set_duty, int32_t, duty_q15)
WRAP(board_set_brake, bool, engaged)

int32_t __real_board_supply_mV(const struct board *board);
int32_t __wrap_board_supply_mV(const struct board *board);
int32_t __wrap_board_supply_mV(const struct board *board) {
    interrupt(); // after the servo's period has begun, before it is judged
    return __real_board_supply_mV(board);
}

static void promise_held(const struct node *node) {
    const struct board *board = &node->board;
    enum guard_verdict verdict = node->device.guard.verdict;
    PROMISE(verdict == GUARD_LETS || (board->brake && board->duty_q15 == 0));
    PROMISE(verdict != GUARD_OFF || !board->power);
}

// A board runs, or hangs; what the guard holds is held whoever comes last.
static void run_board(struct node *node) {
    interrupted = node;
    if (below(5000))
        device_poll(&node->device, &node->board);
    else
        node->board.true_us += below(40000);
    interrupted = NULL;
    promise_held(node);
    guard(node);
    promise_held(node);
    PROMISE(node->device.power || !node->board.power);
}

// ---- the device

struct host {
    uint8_t key[SIPHASH_KEY_BYTES], peer_key[SIPHASH_KEY_BYTES];
    uint64_t asked[BOARD_PORTS]; // nonces of the board's last questions
    struct nonces nonces;
    struct session session, group;
    struct stamps stamps;
    struct mark mark; // as the board has told it
    uint32_t number, commands;
    uint16_t epoch;
    int64_t first_knot; // of its first plan
    int32_t rest_pq;
    uint8_t frame[FRAME_MAX];
};

struct tally {
    uint32_t states[DEVICE_STATES], bad, accepted, statuses, sessions, settings, dark, questions,
        answers;
};

static void deliver_at(struct board *board, int32_t port, const uint8_t *frame, int32_t size) {
    uint8_t packet[COBS_BOUND(FRAME_MAX)];
    size = cobs_encode(frame, size, packet);
    if (!below(20))
        packet[below((uint32_t)size)] ^= (uint8_t)(1 << below(8));
    board_deliver(board, port, board->true_us + (int64_t)below(300), packet, size);
}

static void deliver(struct board *board, const uint8_t *frame, int32_t size) {
    deliver_at(board, BOARD_HOST, frame, size);
}

static void send(struct host *host, struct board *board, enum frame_type type, int32_t size) {
    bool grouped = host->group.begun && type != FRAME_GROUP && !below(20);
    if (size >= 0)
        size = frame_seal(grouped ? &host->group : &host->session, type, host->frame, size);
    if (size >= 0)
        deliver(board, host->frame, size);
}

static void send_hello(struct host *host, struct board *board) {
    uint8_t frame[HANDSHAKE_BYTES];
    if (!below(10))
        for (int32_t i = 0; i < NONCE_BYTES; i++)
            host->nonces.host[i] = (uint8_t)random32();
    hello_encode(host->nonces.host, frame);
    deliver(board, frame, HANDSHAKE_BYTES);
}

static void send_noise(struct host *host, struct board *board) {
    int32_t size = (int32_t)below(below(4) ? 80 : FRAME_PAYLOAD_MAX + 1);
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    for (int32_t i = 0; i < size; i++)
        payload[i] = (uint8_t)random32();
    if (below(2)) { // signed, so that it reaches what parses it
        send(host, board, (enum frame_type)below(FRAME_SETTINGS + 2), size);
    } else {
        for (int32_t i = 0; i < size; i++)
            payload[i] |= payload[i] == 0;
        board_deliver(board, (int32_t)below(BOARD_PORTS), board->true_us, payload, size);
    }
}

static void send_sync(struct host *host, struct board *board, bool hostile) {
    struct stamps stamps = host->stamps;
    stamps.sent_us = board->true_us;
    if (hostile) {
        int64_t *fields[] = {&stamps.received_us, &stamps.sent_us};
        *fields[below(2)] = extreme64();
        if (!below(3))
            stamps.echo_us = random32();
        stamps.mark = (struct mark){(uint16_t)board->sof_number, (uint16_t)random32(), extreme64()};
    } else {
        stamps.mark = host->mark;
    }
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, board, FRAME_SYNC, sync_encode(&stamps, payload, FRAME_PAYLOAD_MAX));
}

// What a neighbour says, who has the key and may be anybody.
static void send_peer(struct host *host, struct board *board, bool sane) {
    uint8_t frame[PEER_RESPONSE_BYTES];
    int32_t port = (int32_t)below(BOARD_PORTS);
    if (below(2)) {
        peer_request_encode(host->peer_key, random32(), frame);
        deliver_at(board, port, frame, PEER_REQUEST_BYTES);
        return;
    }
    struct peer_response response = {
        .nonce = host->asked[port],
        .received_us = board->true_us - (int64_t)below(2000),
        .sent_us = board->true_us,
        .least_error_ns = -1000,
        .most_error_ns = 1000,
        .lineage = below(4),
        .settled = below(2),
    };
    if (!sane) {
        response.received_us = below(2) ? extreme64() : response.received_us;
        response.sent_us = below(2) ? extreme64() : response.sent_us;
        response.least_error_ns = extreme32();
        response.most_error_ns = extreme32();
    }
    peer_response_encode(host->peer_key, &response, frame);
    deliver_at(board, port, frame, PEER_RESPONSE_BYTES);
}

static void send_command(struct host *host, struct node *node, bool sane) {
    struct command command = {++host->commands, (uint8_t)below(COMMAND_KINDS + 1), 0,
                              ++host->epoch};
    command.argument = sane ? (int32_t)between(-1000, 1000) : extreme32();
    if (below(2)) // what leads on
        command.kind = node->device.state == DEVICE_IDLE   ? COMMAND_ARM
                       : node->device.state == DEVICE_HOLD ? COMMAND_RESUME
                                                           : COMMAND_CLEAR;
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, &node->board, FRAME_COMMAND, command_encode(&command, payload, FRAME_PAYLOAD_MAX));
}

static void send_group(struct host *host, struct board *board) {
    uint8_t key[SIPHASH_KEY_BYTES];
    for (int32_t i = 0; i < SIPHASH_KEY_BYTES; i++)
        key[i] = (uint8_t)random32();
    session_begin(&host->group, random32(), TO_DEVICE, key, key);
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, board, FRAME_GROUP,
         group_encode(&host->session, &host->group, payload, FRAME_PAYLOAD_MAX));
}

// From resting plans around the live knots to points that are anything.
static void send_plan(struct host *host, struct node *node, int32_t wildness) {
    static struct plan plan;
    const struct device *device = &node->device;
    int64_t knot = device->clock.system_us >> device->settings.knot_shift;
    bool first = device->state == DEVICE_ARMED;
    if (first) {
        host->first_knot = knot + GATE_LIVE_KNOTS + (int64_t)below(8);
        host->rest_pq = clip((int64_t)device->position_pq + between(-1000, 1000), GATE_POINT_MAX);
    }
    plan.number = ++host->number;
    plan.epoch = device->status.epoch;
    plan.first_knot = host->first_knot;
    int64_t end = device->tracks[TRACK_POSITION].end;
    if (!first)
        plan.first_knot = knot - (int64_t)below(20);
    if (plan.first_knot > end + 1 && !first)
        plan.first_knot = end + 1 + (int64_t)(below(10) ? 0 : below(6));
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
            } else if (!first && i < plan.count - 3) {
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
    stamps.sent_us = below(30) ? node->device.clock.system_us : extreme64();
    stamps.received_us = below(3) ? 0 : stamps.received_us;
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, &node->board, FRAME_PLAN, plan_encode(&stamps, &plan, payload, FRAME_PAYLOAD_MAX));
}

static struct device_settings random_settings(bool sane) {
    struct device_settings settings = {.name = "any", .servo = random_servo()};
    settings.knot_shift = (uint8_t)(9 + below(7));
    settings.servo_period_us = (uint16_t)(sane ? 1000 : 1 + below(65535));
    settings.sample_every = (uint16_t)(1 + below(4));
    settings.brake_periods = (uint16_t)below(20);
    settings.stop_us = sane ? 300000 : random32();
    settings.sync_lost_us = sane ? 1000000 : random32();
    settings.torque_step_tq = sane ? 1000 : 1 + (int32_t)below(INT32_MAX);
    settings.knot_periods = sane ? (struct scale){4, 0} : random_scale();
    settings.offset_count = sane ? 0 : extreme32();
    settings.carries_gravity = below(2);
    settings.dither_us = (uint16_t)(below(2) ? below(2000) : below(1 << 16));
    settings.neighbours = (uint8_t)(below(2) ? 0 : 2 * below(1 << (BOARD_PORTS - 1)));
    settings.ask_us = 1000 + below(sane ? 20000 : 9999001);
    settings.peer_least_us = sane ? 0 : below(SYNC_LIMIT_MAX_US + 1);
    settings.sync = random_sync();
    if (sane) { // as good as the oscillator and the wire are
        settings.sync.limit_us = SYNC_LIMIT_MAX_US;
        settings.sync.among_boards = false;
        settings.sync.drift_ppm = (uint16_t)(101 + below(200));
        settings.sync.to_device_least_us = settings.sync.to_host_least_us = 0;
    }
    settings.home.method = (uint8_t)below(HOME_METHODS);
    settings.home.backwards = below(2);
    settings.home.mark_count = sane ? 7 : extreme32();
    settings.home.speed_q16 = (int32_t)below((1 << 29) + 1);
    settings.home.acceleration_q16 = 1 + (int32_t)below(1u << (sane ? 20 : 29));
    settings.home.torque_tq = (int32_t)below(1 << 25);
    settings.home.way_counts = (int32_t)below(sane ? 200 : INT32_MAX);
    settings.home.still_periods = (uint16_t)below(65536);
    if (sane)
        settings.home.method = HOME_NONE;
    struct monitor_settings *m = &settings.monitor;
    uint32_t most = sane ? 1 : 1u << 30; // below it, anything
    int32_t least = sane ? 1 << 29 : 1;
    m->following_pq = least + (int32_t)below(most);
    m->following_periods = (uint16_t)random32();
    m->speed_pq = least + (int32_t)below(most);
    m->bounded = sane ? 0 : below(2);
    m->low_pq = -(int32_t)below(1u << 30);
    m->high_pq = (int32_t)below(1u << 30);
    m->deceleration_q16 = sane ? 1 << 20 : 1 + (int32_t)below(INT32_MAX);
    m->torque_periods = sane ? UINT32_MAX : random32();
    m->load_q8 = sane ? (struct scale){1, 31} : random_scale();
    m->overload = sane ? 1u << 30 : random32();
    m->heating_q16 = (uint16_t)random32();
    m->rise_q16 = least + (int32_t)below(most);
    m->stuck_pq = least + (int32_t)below(most);
    m->stuck_periods = sane ? UINT32_MAX : random32();
    m->spike_counts = sane ? (1 << 18) - 1 : 1 + (int32_t)below((1 << 18) - 1);
    m->supply_min_mV = sane ? 0 : extreme32();
    m->supply_max_mV = sane ? INT32_MAX : extreme32();
    m->chopper_mV = sane ? INT32_MAX : extreme32();
    m->late_us = sane ? 4000 : random32();
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        settings.gap_policy[sink] = (uint8_t)below(GAP_POLICIES);
        settings.limits[sink] =
            sane ? (struct gate_limits){false, -GATE_POINT_MAX, GATE_POINT_MAX, 1 << 25, 1 << 26, 0}
                 : random_limits();
    }
    return settings;
}

static struct device_settings valid_settings(bool sane) {
    struct device_settings settings = random_settings(sane);
    while (!settings_valid(&settings))
        settings = random_settings(sane);
    return settings;
}

static void send_settings(struct host *host, struct board *board, bool sane) {
    struct device_settings settings = sane ? valid_settings(true) : random_settings(false);
    uint8_t *payload = host->frame + FRAME_HEADER_BYTES;
    send(host, board, FRAME_SETTINGS,
         below(2) ? settings_encode(&settings, false, payload, FRAME_PAYLOAD_MAX) : 0);
}

static void read_welcome(struct host *host, const uint8_t *frame, int32_t size) {
    struct session session;
    if (welcome_decode(host->key, frame, size, &host->nonces) != WELCOME_OK)
        return;
    handshake_session(host->key, &host->nonces, TO_DEVICE, &session);
    if (session.number == host->session.number) // the same WELCOME again
        return;
    host->session = session;
    host->group.begun = false;
    host->commands = host->number = 0;
}

static void read_peer(struct host *host, const uint8_t *frame, int32_t size, int32_t port,
                      struct tally *tally) {
    struct peer_response response;
    if (peer_request_decode(host->peer_key, frame, size, &host->asked[port])) {
        tally->questions++;
        return;
    }
    PROMISE(peer_response_decode(host->peer_key, frame, size, &response));
    tally->answers++;
}

static void read_outbox(struct host *host, struct board *board, struct tally *tally) {
    static struct status status;
    static struct fault_log faults;
    static struct device_settings settings;
    for (int32_t i = 0; i < BOARD_OUTBOX; i++) {
        struct parcel *parcel = &board->outbox[i];
        if (parcel->size == 0)
            continue;
        int32_t size = cobs_decode(parcel->bytes, parcel->size);
        const uint8_t *payload = parcel->bytes + FRAME_HEADER_BYTES;
        parcel->size = 0;
        PROMISE(size > 2);
        if (parcel->port != BOARD_HOST) {
            read_peer(host, parcel->bytes, size, parcel->port, tally);
            continue;
        }
        if (parcel->bytes[1] == FRAME_WELCOME) {
            read_welcome(host, parcel->bytes, size);
            continue;
        }
        if (frame_open(&host->session, parcel->bytes, size) != FRAME_OK)
            continue; // of a session that the host has left
        size -= FRAME_HEADER_BYTES + FRAME_TAG_BYTES;
        if (parcel->bytes[1] == FRAME_STATUS) {
            PROMISE(status_decode(payload, size, &status));
            host->stamps.echo_us = status.sent_count_us;
            host->stamps.received_us = parcel->time_us;
            host->mark = status.mark;
            tally->statuses++;
        } else if (parcel->bytes[1] == FRAME_SETTINGS) {
            PROMISE(settings_decode(payload, size - 1, false, &settings)); // then the firmware
            PROMISE(settings_valid(&settings));
            tally->settings++;
        } else {
            PROMISE(parcel->bytes[1] == FRAME_FAULTS);
            PROMISE(fault_log_decode(payload, size, &faults));
        }
    }
}

// As a programmer does; into memory that may be anything before.
static void flash(struct node *node, struct host *host, bool sane) {
    struct device_settings settings = valid_settings(sane);
    memset(node, 0, sizeof *node);
    memset(host, 0, sizeof *host);
    for (int32_t i = 0; i < SIPHASH_KEY_BYTES; i++) {
        host->key[i] = settings.key[i] = (uint8_t)random32();
        host->peer_key[i] = settings.peer_key[i] = (uint8_t)random32();
    }
    host->mark.width_us = MARK_OPEN;
    node->board.true_us = sane ? (int64_t)below(2) * 1700000000000000 : between(0, 1LL << 50);
    int32_t wander_ppb_per_s = node->board.true_us == 0 ? (int32_t)below(1000) : 0; // else it seeks
    PROMISE(oscillator_begin(&node->board.oscillator, between(-(1LL << 40), 1LL << 40),
                             (int32_t)between(-100000, 100000), wander_ppb_per_s, 100000,
                             random32()));
    node->board.random = random32();
    node->board.supply_V = 24;
    PROMISE(store_save_settings(&node->board, &settings));
    device_boot(&node->device, &node->board, board_count_us(&node->board));
    PROMISE(node->device.configured && node->device.boots == 1);
}

// A power cycle, perhaps with a byte or the end of a record gone.
static void reboot(struct node *node, struct tally *tally) {
    static struct memory saved[RECORDS];
    memcpy(saved, node->board.memory, sizeof saved);
    struct memory *memory = &node->board.memory[below(RECORDS)];
    if (memory->size > 0 && below(2))
        memory->bytes[below((uint32_t)memory->size)] ^= (uint8_t)(1 << below(8));
    else if (memory->size > 0 && below(2))
        memory->size = (int32_t)below((uint32_t)memory->size);
    device_boot(&node->device, &node->board, board_count_us(&node->board));
    if (node->device.configured)
        return;
    tally->dark++;
    for (int32_t i = 0; i < 10; i++) {
        device_poll(&node->device, &node->board);
        PROMISE(!node->board.power && node->board.brake && node->board.duty_q15 == 0);
    }
    memcpy(node->board.memory, saved, sizeof saved); // the programmer mends it
    device_boot(&node->device, &node->board, board_count_us(&node->board));
}

static void speak(struct node *node, struct host *host, bool sane) {
    uint32_t what = below(100);
    if (what < 4 && !below(node->device.session.begun ? 40 : 1)) // a new one settles anew
        send_hello(host, &node->board);
    else if (what < 12 || (what < 50 && !node->device.sync.settled))
        send_sync(host, &node->board, !sane && !below(4));
    else if (what < 22)
        send_plan(host, node, sane ? (below(5) ? 0 : 30) : 40);
    else if (what < (sane ? 24 : 34))
        send_noise(host, &node->board);
    else if (what < 36)
        send_command(host, node, sane);
    else if (what == 50 && !below(4))
        send_group(host, &node->board);
    else if (what == 51 && !below(4))
        send_settings(host, &node->board, sane);
    else if (what < 60)
        send_peer(host, &node->board, sane || below(2));
}

static void live(struct tally *tally, bool sane) {
    static struct node node;
    static struct host host;
    flash(&node, &host, sane);
    uint64_t motion_us = 0;
    uint32_t number = 0;
    for (int32_t n = 0; n < POLLS / LIVES; n++) {
        uint32_t pause_us = node.device.state == DEVICE_UNSYNCED ? 4000 : 250; // it takes a second
        int64_t passed_us = sane || below(1000) ? below(pause_us) : below(1000000);
        board_advance(&node.board, node.board.true_us + passed_us);
        if (!below(50)) { // a start of a frame, just now
            node.board.bus.begun = true;
            node.board.sof_number = (node.board.sof_number + 32) % 2048 + !below(10);
            node.board.sof_count = board_count_us(&node.board) - below(200);
        }
        if (below(100000) == 0)
            oscillator_step(&node.board.oscillator, node.board.true_us, (int32_t)random32());
        motion_us += 1;
        if (sane)
            node.board.encoder_count = (int32_t)(motion_us / 50 % 100) - 50;
        else
            node.board.encoder_count = below(4) ? extreme32() : (int32_t)between(-100, 100);
        if (!sane && !below(50))
            node.board.supply_V = below(60);
        if (!below(node.board.stop_line ? 200 : 8000))
            node.board.stop_line = !node.board.stop_line;
        if (!below(5000))
            reboot(&node, tally);
        speak(&node, &host, sane);
        uint32_t accepted = node.device.status.counters.plans_accepted;
        run_board(&node);
        tally->accepted += node.device.status.counters.plans_accepted - accepted;
        read_outbox(&host, &node.board, tally);
        tally->states[node.device.state]++;
        tally->sessions += node.device.session.begun && node.device.session.number != number;
        number = node.device.session.number;
        PROMISE(node.board.duty_q15 <= SERVO_DUTY_MAX && node.board.duty_q15 >= -SERVO_DUTY_MAX);
        PROMISE(node.device.state == DEVICE_FAULT || settings_valid(&node.device.settings));
        PROMISE(memcmp(node.device.settings.key, host.key, sizeof host.key) == 0);
    }
    tally->bad += node.device.status.counters.frames_bad;
}

int main(void) {
    struct tally tally = {0};
    splines();
    servos();
    monitors();
    ramps();
    homes();
    gaps();
    clocks();
    gates();
    decoders();
    for (int32_t i = 0; i < LIVES; i++)
        live(&tally, i % 4 != 3);
    for (int32_t state = DEVICE_BOOT; state < DEVICE_STATES; state++)
        printf("state %d: %u polls\n", state, tally.states[state]);
    printf(
        "%u plans accepted, %u bad frames, %u statuses, %u sessions, %u settings, %u times dark\n",
        tally.accepted, tally.bad, tally.statuses, tally.sessions, tally.settings, tally.dark);
    for (int32_t state = DEVICE_UNSYNCED; state < DEVICE_STATES; state++)
        PROMISE(tally.states[state] > 100);
    PROMISE(tally.accepted > 200 && tally.bad > 1000 && tally.statuses > 500);
    printf("%u calls of the guard, %u trips\n", interrupts, trips);
    PROMISE(interrupts > 100000 && trips > 30);
    printf("%u questions, %u answers\n", tally.questions, tally.answers);
    PROMISE(tally.questions > 1000 && tally.answers > 1000);
    PROMISE(tally.sessions > 100 && tally.settings > 20 && tally.dark > 0);
    return 0;
}
