#include "inbox.h"
#include "admit.h"
#include "cobs.h" // packets on the byte stream
#include "group.h"
#include "happen.h"
#include "obey.h"
#include "outbox.h"

// A first plan starts at rest, near where the axis is, and on every track it carries.
static bool starts_here(const struct device *device) {
    const struct plan *plan = &device->plan;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        const int32_t *p = plan->points[sink];
        if (plan->tracks & 1 << sink && (p[0] != p[1] || p[0] != p[2]))
            return false;
    }
    int32_t distance_pq = fixed_difference(plan->points[TRACK_POSITION][0], device->position_pq);
    int32_t most_pq = device->steps ? DEVICE_START_STEPS_PQ : DEVICE_START_PQ;
    return distance_pq <= most_pq && distance_pq >= -most_pq;
}

// A track that appears while others run would jump to its first point.
static bool adds_track(const struct device *device) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (device->plan.tracks & 1 << sink && !device->tracks[sink].written)
            return true;
    return false;
}

static bool takes_plans(const struct device *device) {
    return (device->state == DEVICE_ARMED && device->status.homed &&
            device->home.task == TASK_NONE) ||
           device->state == DEVICE_RUNNING || device->state == DEVICE_COAST;
}

// A plan beyond the end of what is stored: filled, refused, or a reason to stop.
static enum gate_result close_gap(struct device *device, uint32_t count_us) {
    const uint8_t *policies = device->settings.gap_policy;
    struct plan *plan = &device->plan;
    int64_t missing = gap_knots(device->tracks, plan);
    if (missing == 0)
        return GATE_ACCEPTED;
    enum gap_policy verdict = gap_verdict(policies, device->tracks, plan);
    if (verdict == GAP_INTERPOLATE) {
        bool filled = missing <= GAP_FILL_MAX && gap_fill(policies, device->tracks, plan);
        return filled ? GATE_ACCEPTED : GATE_GAP;
    }
    struct breach gap = {verdict == GAP_FAULT ? REASON_GAP_FAULT : REASON_GAP,
                         missing > INT32_MAX ? INT32_MAX : (int32_t)missing, GAP_FILL_MAX};
    happen_breach(device, gap, count_us);
    return GATE_GAP;
}

static enum gate_result judge(struct device *device, uint32_t count_us, int64_t sent_us) {
    const struct plan *plan = &device->plan;
    int64_t now_us = clock_at(&device->clock, count_us);
    if (!takes_plans(device))
        return GATE_STATE;
    if (plan->epoch != device->status.epoch)
        return GATE_EPOCH;
    int64_t age_us = now_us - sent_us;
    if (age_us > DEVICE_FRESH_US || age_us < -DEVICE_FRESH_US)
        return GATE_STALE;
    if (device->status.counters.plans_accepted != 0 && plan->number <= device->status.plan_accepted)
        return GATE_STALE;
    if (device->state == DEVICE_ARMED ? !starts_here(device) : adds_track(device))
        return GATE_START;
    enum gate_result gap = close_gap(device, count_us);
    if (gap != GATE_ACCEPTED)
        return gap;
    return gate_check(device->settings.limits, device->tracks, plan,
                      device_knot_at(device, now_us));
}

static void note_seen(struct status *status, uint32_t number) {
    if (number <= status->plan_seen)
        return;
    uint32_t ahead = number - status->plan_seen;
    status->accepted_mask = ahead < 32 ? status->accepted_mask << ahead : 0;
    status->plan_seen = number;
}

static void accept(struct device *device, int64_t now_us) {
    const struct plan *plan = &device->plan;
    if (device->state == DEVICE_ARMED)
        device->start_knot = plan->first_knot;
    happen(device, EVENT_PLAN);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan->tracks & 1 << sink)
            track_write(&device->tracks[sink], plan->first_knot, plan->points[sink], plan->count);
    device->status.plan_accepted = plan->number;
    uint32_t behind = device->status.plan_seen - plan->number;
    if (behind < 32)
        device->status.accepted_mask |= 1u << behind;
    device->status.counters.plans_accepted++;
    device->accepted_knot = device_knot_at(device, now_us);
}

static void take_plan(struct device *device, uint32_t count_us, int64_t sent_us) {
    struct counters *counters = &device->status.counters;
    note_seen(&device->status, device->plan.number);
    enum gate_result result = judge(device, count_us, sent_us);
    if (result == GATE_ACCEPTED) {
        accept(device, clock_at(&device->clock, count_us));
        return;
    }
    device->status.refusal = result;
    if (result == GATE_LATE)
        counters->plans_late++;
    else
        counters->plans_refused++;
}

static void take_stamps(struct device *device, const struct stamps *stamps, uint32_t arrived_us,
                        uint32_t count_us) {
    const struct sync_settings *settings = &device->settings.sync;
    struct sync_source host = sync_host(settings);
    device->status.heard_us = stamps->sent_us;
    device->heard_count_us = arrived_us;
    if (settings->among_boards)
        return;
    device_take_stamps(device, &host, stamps, arrived_us, count_us);
    uint32_t mark_us;
    if (stamps->mark.width_us != MARK_OPEN &&
        marks_find(&device->marks, stamps->mark.number, &mark_us))
        sync_take_mark(&device->sync, settings, &device->clock, &stamps->mark, mark_us, count_us);
}

// New settings; the key stays. The device answers with those that it has then.
static void take_settings(struct device *device, const uint8_t *payload, int32_t size) {
    bool resting = device->state == DEVICE_IDLE || device->state == DEVICE_UNSYNCED;
    struct device_settings settings = device->settings;
    if (resting && !device->power && settings_decode(payload, size, false, &settings) &&
        settings_valid(&settings))
        device_configure(device, &settings);
}

// Whether a frame came after one that was sent later. Of a plan: if that one was accepted, it had
// the points of this one. Logic is sent again until there is an answer.
static bool overtaken(const struct session *session, const uint8_t *frame) {
    return frame_counter(frame) < session->received;
}

static bool take_frame(struct device *device, struct board *board, const uint8_t *frame,
                       int32_t size, uint32_t arrived_us, uint32_t count_us) {
    const uint8_t *payload = frame + FRAME_HEADER_BYTES;
    struct stamps stamps;
    struct command command;
    struct logic logic;
    switch (frame[1]) {
    case FRAME_SYNC:
        if (!sync_decode(payload, size, &stamps))
            return false;
        take_stamps(device, &stamps, arrived_us, count_us);
        return true;
    case FRAME_PLAN:
        if (!plan_decode(payload, size, &stamps, &device->plan))
            return false;
        if (!overtaken(&device->session, frame) ||
            device->plan.number >= device->status.plan_accepted)
            take_plan(device, count_us, stamps.sent_us);
        take_stamps(device, &stamps, arrived_us, count_us);
        return true;
    case FRAME_COMMAND:
        if (!command_decode(payload, size, &command))
            return false;
        obey(device, board, &command);
        if (command.kind == COMMAND_FAULTS) // also again: the answer may have been lost
            outbox_faults(device, board);
        return true;
    case FRAME_SIGNALS:
        if (!batch_decode(payload, size, &device->batch))
            return false;
        signals_take(&device->signals, &device->batch, clock_at(&device->clock, count_us));
        return true;
    case FRAME_LOGIC:
        if (!logic_decode(payload, size, &logic))
            return false;
        if (!overtaken(&device->session, frame)) // else one that holds no longer
            signals_rule(&device->signals, &logic);
        return true;
    case FRAME_GROUP:
        return group_decode(&device->session, frame, size, &device->group);
    case FRAME_SETTINGS:
        if (size != 0)
            take_settings(device, payload, size);
        outbox_settings(device, board);
        return true;
    default:
        return false;
    }
}

static bool take_group_frame(struct device *device, const struct board *board, const uint8_t *frame,
                             int32_t size, uint32_t arrived_us, uint32_t count_us) {
    const uint8_t *payload = frame + FRAME_HEADER_BYTES;
    struct stamps stamps;
    struct command command;
    if (frame[1] == FRAME_SYNC && sync_decode(payload, size, &stamps)) {
        take_stamps(device, &stamps, arrived_us, count_us);
        return true;
    }
    if (frame[1] == FRAME_COMMAND && command_decode(payload, size, &command) &&
        command.kind == COMMAND_STOP) {
        obey_stop(device, board);
        return true;
    }
    return false;
}

// The clock's sample is as old as the packet's arrival; what is live is judged now.
static void take(struct device *device, struct board *board, uint8_t *packet, int32_t size,
                 int32_t port, uint32_t arrived_us, uint32_t count_us) {
    size = cobs_decode(packet, size);
    if (port != BOARD_HOST) {
        if (!neighbours_take(device, board, packet, size, port, arrived_us, count_us))
            device->status.counters.frames_bad++;
        return;
    }
    if (size > 1 && packet[1] == FRAME_HELLO) {
        admit_hello(device, board, packet, size, count_us);
        return;
    }
    enum sender sender = size < 0 ? SENDER_NOBODY : admit_frame(device, packet, size);
    int32_t payload_size = size - FRAME_HEADER_BYTES - FRAME_TAG_BYTES;
    bool taken = false;
    if (sender == SENDER_HOST)
        taken = take_frame(device, board, packet, payload_size, arrived_us, count_us);
    else if (sender == SENDER_GROUP)
        taken = take_group_frame(device, board, packet, payload_size, arrived_us, count_us);
    if (!taken)
        device->status.counters.frames_bad++;
}

void inbox_take(struct device *device, struct board *board) {
    uint8_t packet[COBS_BOUND(FRAME_MAX)]; // decoded in place
    uint32_t arrived_us;
    int32_t size, port;
    for (int32_t i = 0; i < INBOX_PACKETS; i++) {
        size = board_receive(board, packet, sizeof packet, &port, &arrived_us);
        if (size <= 0)
            return;
        uint32_t count_us = board_count_us(board);
        enum admission admission = admit_packet(device, packet, size, port, count_us);
        if (admission == ADMIT_OPEN) {
            take(device, board, packet, size, port, arrived_us, count_us);
            return;
        }
        device->status.counters.frames_bad += admission == ADMIT_BAD;
    }
}
