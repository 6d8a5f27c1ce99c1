#include "device.h"
#include "cobs.h" // packets on the byte stream
#include <string.h>

void device_init(struct device *device, const struct device_settings *settings, uint32_t count_us) {
    memset(device, 0, sizeof *device);
    device->settings = *settings;
    memcpy(device->session.key, settings->key, sizeof settings->key);
    device->session.number = settings->session;
    device->session.send_direction = TO_HOST;
    device->clock.count_us = count_us;
    device->next_servo_us = count_us;
    device->configured = true;
}

static int64_t knot_at(const struct device *device, int64_t time_us) {
    return time_us >> device->settings.knot_shift;
}

// A first plan starts at rest, near where the axis is, and on every track it carries.
static bool starts_here(const struct device *device) {
    const struct plan *plan = &device->plan;
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++) {
        const int32_t *p = plan->points[sink];
        if (plan->tracks & 1 << sink && (p[0] != p[1] || p[0] != p[2]))
            return false;
    }
    int64_t measured_pq = (int64_t)device->encoder_count * (1 << SERVO_COUNT_BITS);
    int64_t distance_pq = plan->points[TRACK_POSITION][0] - measured_pq;
    return distance_pq <= DEVICE_START_PQ && distance_pq >= -DEVICE_START_PQ;
}

// A track that appears while others run would jump to its first point.
static bool adds_track(const struct device *device) {
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (device->plan.tracks & 1 << sink && !device->tracks[sink].written)
            return true;
    return false;
}

static enum gate_result judge(const struct device *device, int64_t now_us, int64_t sent_us) {
    const struct plan *plan = &device->plan;
    if (device->state == DEVICE_UNSYNCED || device->state == DEVICE_HOLD)
        return GATE_STATE;
    int64_t age_us = now_us - sent_us;
    if (age_us > DEVICE_FRESH_US || age_us < -DEVICE_FRESH_US)
        return GATE_STALE;
    if (device->status.counters.plans_accepted != 0 && plan->number <= device->status.plan_accepted)
        return GATE_STALE;
    if (device->state == DEVICE_IDLE ? !starts_here(device) : adds_track(device))
        return GATE_START;
    return gate_check(device->settings.limits, device->tracks, plan, knot_at(device, now_us));
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
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan->tracks & 1 << sink)
            track_write(&device->tracks[sink], plan->first_knot, plan->points[sink], plan->count);
    device->status.plan_accepted = plan->number;
    uint32_t behind = device->status.plan_seen - plan->number;
    if (behind < 32)
        device->status.accepted_mask |= 1u << behind;
    device->status.counters.plans_accepted++;
    device->accepted_knot = knot_at(device, now_us);
    if (device->state == DEVICE_IDLE)
        device->start_knot = plan->first_knot;
    device->state = DEVICE_RUNNING;
}

static void take_plan(struct device *device, int64_t now_us, int64_t sent_us) {
    struct counters *counters = &device->status.counters;
    note_seen(&device->status, device->plan.number);
    enum gate_result result = judge(device, now_us, sent_us);
    if (result == GATE_ACCEPTED) {
        accept(device, now_us);
        return;
    }
    device->status.refusal = result;
    if (result == GATE_LATE)
        counters->plans_late++;
    else
        counters->plans_refused++;
}

static void take_stamps(struct device *device, const struct stamps *stamps, int64_t received_us) {
    if (stamps->status_us == 0 || stamps->status_us < device->clock.stepped_us ||
        stamps->status_us > received_us) // none yet, or under way when the clock stepped
        return;
    int64_t ahead_us = (stamps->status_received_us - stamps->status_us) + // t1 - t0
                       (stamps->sent_us - received_us);                   // t2 - t3
    clock_sample(&device->clock, ahead_us / 2);
    if (device->clock.synced && device->state == DEVICE_UNSYNCED)
        device->state = DEVICE_IDLE;
}

// The clock's sample is as old as the packet's arrival; what is live is judged now.
static void take_packet(struct device *device, uint8_t *packet, int32_t size, uint32_t arrived_us,
                        uint32_t count_us) {
    size = cobs_decode(packet, size);
    if (size < 0 || frame_open(&device->session, packet, size) != FRAME_OK) {
        device->status.counters.frames_bad++;
        return;
    }
    const uint8_t *payload = packet + FRAME_HEADER_BYTES;
    int32_t payload_size = size - FRAME_HEADER_BYTES - FRAME_TAG_BYTES;
    int64_t received_us = clock_at(&device->clock, arrived_us);
    struct stamps stamps;
    if (packet[1] == FRAME_SYNC && sync_decode(payload, payload_size, &stamps)) {
        take_stamps(device, &stamps, received_us);
    } else if (packet[1] == FRAME_PLAN &&
               plan_decode(payload, payload_size, &stamps, &device->plan)) {
        take_plan(device, clock_at(&device->clock, count_us), stamps.sent_us);
        take_stamps(device, &stamps, received_us);
    } else {
        device->status.counters.frames_bad++;
    }
}

// RUNNING, COAST and HOLD follow from the knot alone.
static void follow_time(struct device *device, int64_t knot) {
    if (device->state == DEVICE_RUNNING && knot - device->accepted_knot > DEVICE_COAST_KNOTS) {
        device->state = DEVICE_COAST;
        device->status.counters.coasts++;
    }
    if (device->state == DEVICE_COAST && knot >= device->tracks[TRACK_POSITION].end - 1)
        device->state = DEVICE_HOLD;
}

static struct scale gain(const struct track *track, int64_t time_us, int32_t shift,
                         struct scale fixed) {
    if (!track->written)
        return fixed;
    int32_t mantissa = track_evaluate(track, time_us, shift).value >> 8; // points are mantissa Q8
    fixed.mantissa = (uint16_t)(mantissa < 0 ? 0 : mantissa > 65535 ? 65535 : mantissa);
    return fixed;
}

static struct setpoint setpoint_at(const struct device *device, int64_t time_us) {
    const struct device_settings *settings = &device->settings;
    const struct track *tracks = device->tracks;
    int32_t shift = settings->knot_shift;
    struct track_value position = track_evaluate(&tracks[TRACK_POSITION], time_us, shift);
    // The output holds for a whole period, so feed-forward is taken at the period's middle.
    int64_t middle_us = time_us + settings->servo_period_us / 2;
    struct setpoint setpoint = {
        .position_pq = position.value,
        .velocity_pq = track_evaluate(&tracks[TRACK_POSITION], middle_us, shift).rate,
        .torque_tq = track_evaluate(&tracks[TRACK_TORQUE], middle_us, shift).value,
        .kp = gain(&tracks[TRACK_KP], time_us, shift, settings->servo.kp_tq),
        .ki = gain(&tracks[TRACK_KI], time_us, shift, settings->servo.ki_tq),
        .kd = gain(&tracks[TRACK_KD], time_us, shift, settings->servo.kd_tq),
        .integrate = device->state == DEVICE_HOLD || settings->servo.integrate_running,
    };
    return setpoint;
}

static void drive(struct device *device, struct board *board, int64_t time_us) {
    bool moving = device->state >= DEVICE_RUNNING && knot_at(device, time_us) >= device->start_knot;
    board_set_brake(board, !moving);
    if (!moving) {
        board_set_duty(board, 0);
        return;
    }
    struct setpoint setpoint = setpoint_at(device, time_us);
    board_set_duty(board, servo_step(&device->settings.servo, &device->servo, &setpoint,
                                     device->encoder_count));
    int32_t torque = device->servo.unclipped_tq;
    torque = torque < 0 ? -torque : torque;
    if (torque > device->status.torque_peak_tq)
        device->status.torque_peak_tq = torque;
    if (device->servo.torque_tq != device->servo.unclipped_tq)
        device->status.torque_clipped++;
}

static void send_status(struct device *device, struct board *board, uint32_t count_us) {
    uint8_t frame[FRAME_MAX], packet[COBS_BOUND(FRAME_MAX)];
    struct status *status = &device->status;
    status->sent_us = clock_at(&device->clock, count_us);
    status->state = device->state;
    status->synced = device->clock.synced;
    status->sample_count = (uint8_t)history_report(&device->history, status->samples);
    int32_t size = status_encode(status, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX);
    size = frame_seal(&device->session, FRAME_STATUS, frame, size);
    board_send(board, packet, cobs_encode(frame, size, packet));
    status->torque_peak_tq = 0;
}

static void run_period(struct device *device, struct board *board, uint32_t count_us) {
    clock_advance(&device->clock, count_us);
    int64_t time_us = device->clock.system_us;
    device->encoder_count = board_encoder_count(board);
    if (device->periods++ % device->settings.sample_every == 0)
        history_push(&device->history, time_us, device->encoder_count);
    follow_time(device, knot_at(device, time_us));
    drive(device, board, time_us);
    if (knot_at(device, time_us) != device->status_knot) {
        device->status_knot = knot_at(device, time_us);
        send_status(device, board, count_us);
    }
}

void device_poll(struct device *device, struct board *board) {
    if (!device->configured) { // an empty board: off and braked
        board_set_brake(board, true);
        board_set_duty(board, 0);
        return;
    }
    uint8_t packet[COBS_BOUND(FRAME_MAX)];
    uint32_t arrived_us;
    int32_t size;
    while ((size = board_receive(board, packet, sizeof packet, &arrived_us)) > 0)
        take_packet(device, packet, size, arrived_us, board_count_us(board));
    uint32_t count_us = board_count_us(board);
    if ((int32_t)(count_us - device->next_servo_us) >= 0) {
        device->next_servo_us += device->settings.servo_period_us;
        run_period(device, board, count_us);
    }
}
