// Fuzz target: a host with the key that is hostile. Its bytes are a script: plans of any header and
// points, commands, raw payloads, time; all of it signed. Whatever it says, what may move is within
// the limits, and what has been executed stays what it was.
#include "node.h"
#include "script.h"

static struct node begun;
static struct host begun_host;

int LLVMFuzzerInitialize(int *argc, char ***argv) {
    (void)argc, (void)argv;
    fuzz_begin(&begun, &begun_host);
    return 0;
}

static int32_t next_small(struct script *script) { return (int8_t)next(script); }

// Often one near an end of some range.
static int32_t next_edge(struct script *script) {
    static const int32_t edges[] = {0, 1 << 18, 1 << 25, 1 << 26, (1 << 30) - 1, INT32_MAX - 128};
    uint8_t what = next(script);
    if (what % 8 > 5)
        return next_whole(script);
    int32_t value = edges[what % 8] + next_small(script) / 16;
    return what & 128 ? -value : value;
}

static int32_t clip(int64_t value) {
    return value > INT32_MAX ? INT32_MAX : value < INT32_MIN ? INT32_MIN : (int32_t)value;
}

// A track that goes on from what is stored: second differences, or now and then any points.
static void draw_points(struct script *script, const struct device *device, const struct plan *plan,
                        int32_t sink, int32_t *points) {
    const struct track *track = &device->tracks[sink];
    int64_t free_knot = device->clock.system_us >> FUZZ_SHIFT;
    int32_t live = next(script) % 8, scale = next(script) % 32;
    bool any = next(script) % 8 == 0;
    int64_t point = track_point(track, plan->first_knot - 1);
    int64_t step = point - track_point(track, plan->first_knot - 2);
    for (int32_t i = 0; i < plan->count; i++) {
        if (plan->first_knot + i < free_knot + live) {
            step = track_point(track, plan->first_knot + i) - point;
        } else if (any) {
            step = next_whole(script);
        } else if (i < plan->count - 3) {
            step += (int64_t)next_small(script) * (1LL << scale);
        } else {
            step = next(script) < 250 ? 0 : next_small(script);
        }
        point = clip(point + step);
        points[i] = (int32_t)point;
    }
}

static void send_plan(struct script *script, struct host *host, struct node *node) {
    static struct plan plan;
    const struct device *device = &node->device;
    int64_t knot = device->clock.system_us >> FUZZ_SHIFT;
    plan.number = host->number + (uint32_t)next_small(script);
    host->number = plan.number > host->number ? plan.number : host->number;
    plan.epoch = (uint16_t)(device->status.epoch + (next(script) < 250 ? 0 : next_small(script)));
    plan.first_knot = knot + (next(script) < 250 ? next_small(script) : next_whole(script));
    plan.tracks = next(script) < 240 ? 31 : next(script) % 32;
    plan.count = (uint8_t)(next(script) % PLAN_POINTS_MAX + 1);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan.tracks & 1 << sink)
            draw_points(script, device, &plan, sink, plan.points[sink]);
    fuzz_plan(host, node, &plan);
}

static void send_raw(struct script *script, struct host *host, struct board *board) {
    uint8_t frame[FRAME_MAX];
    int32_t size = next(script);
    enum frame_type type = (enum frame_type)(next(script) % 12);
    for (int32_t i = 0; i < size; i++)
        frame[FRAME_HEADER_BYTES + i] = next(script);
    fuzz_send(host, board, type, frame, size);
}

// Another board: an axis that turns for ever, other policies where points are missing.
static void vary(struct script *script, struct device_settings *settings) {
    struct device_settings other = *settings;
    uint8_t what = next(script);
    other.limits[TRACK_POSITION].continuous = what & 1;
    other.monitor.bounded = !(what & 1);
    other.carries_gravity = what & 2;
    if (what & 8) { // near its limits
        other.limits[TRACK_POSITION].point_min = -(1 << 20);
        other.limits[TRACK_POSITION].point_max = 1 << 20;
    }
    if (what & 4)
        other.limits[TRACK_KD].difference_max = 0;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        other.gap_policy[sink] = next(script) % (GAP_POLICIES + 1);
    if (settings_valid(&other))
        *settings = other;
}

// The gate by itself, with any limits that it may be given.
static void judge(struct script *script) {
    int32_t points[PLAN_POINTS_MAX], count = 3 + next(script) % 20;
    struct gate_limits limits = {.continuous = next(script) & 1,
                                 .point_min = next_edge(script),
                                 .point_max = next_edge(script),
                                 .difference_max = next_edge(script),
                                 .second_difference_max = next_edge(script),
                                 .stop_difference = next_edge(script)};
    int64_t knot = next_whole(script), first_knot = knot + next_small(script);
    if (!gate_limits_valid(&limits))
        return;
    int32_t rest = next_edge(script);
    for (int32_t i = 0; i < count; i++)
        points[i] = i > 2 && i < count - 3 ? next_edge(script) : rest;
    static struct track track;
    memset(&track, 0, sizeof track);
    if (gate_check_track(&limits, &track, first_knot, points, count, knot) != GATE_ACCEPTED)
        return;
    PROMISE(points[count - 1] == points[count - 2] && points[count - 1] == points[count - 3]);
    for (int32_t i = 0; i < count; i++)
        PROMISE(limits.continuous ||
                (points[i] >= limits.point_min && points[i] <= limits.point_max));
}

// Setpoints of the last periods that followed the position track.
#define EXECUTED 64
struct executed {
    uint32_t count;
    int64_t time_us[EXECUTED];
    int32_t position_pq[EXECUTED];
};

static void promise_past(struct executed *executed, const struct device *device) {
    const struct track *track = &device->tracks[TRACK_POSITION];
    bool follows = device->state == DEVICE_RUNNING || device->state == DEVICE_COAST;
    if (!track->written || !follows) {
        executed->count = 0;
        return;
    }
    struct instant begin = instant_at(device->clock.system_us, FUZZ_SHIFT);
    if (device->setpoint.position_pq == track_value(track, &begin)) {
        uint32_t i = executed->count++ % EXECUTED;
        executed->time_us[i] = device->clock.system_us;
        executed->position_pq[i] = device->setpoint.position_pq;
    }
    for (uint32_t i = 0; i < EXECUTED && i < executed->count; i++) {
        struct instant at = instant_at(executed->time_us[i], FUZZ_SHIFT);
        int32_t value;
        PROMISE(!track_past(track, &at, &value) || value == executed->position_pq[i]);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length) {
    static struct node node;
    struct host host = begun_host;
    struct script script = {data, length, 0};
    struct executed executed = {0};
    memcpy(&node, &begun, sizeof node);
    if (length > 3000)
        return 0;
    vary(&script, &node.device.settings);
    while (script.at < script.size) {
        uint8_t what = next(&script) % 16;
        if (what < 1) {
            judge(&script);
        } else if (what < 8) {
            send_plan(&script, &host, &node);
        } else if (what < 10) {
            for (int32_t polls = next(&script); polls > 0; polls--)
                fuzz_poll(&node);
        } else if (what < 12) {
            enum command_kind kind = (enum command_kind)(next(&script) % (COMMAND_KINDS + 1));
            fuzz_command(&host, &node.board, kind, next_whole(&script), next(&script));
        } else if (what < 13) {
            send_raw(&script, &host, &node.board);
        } else if (what < 14) {
            board_set_encoder(&node.board, node.board.true_count + next_small(&script) * 16);
        } else {
            fuzz_sync(&host, &node.board);
        }
        fuzz_poll(&node);
        fuzz_promise(&node);
        promise_past(&executed, &node.device);
    }
    return 0;
}
