// Replays varint-*, plan-*, sync-* and status-*.
#include "sinks.h"
#include "status.h"
#include "wire.h"

static struct mark given_mark(void) {
    return (struct mark){(uint16_t)given("mark_number"), (uint16_t)given("mark_width_us"),
                         given("mark_least_us")};
}

static struct stamps given_stamps(void) {
    return (struct stamps){(uint32_t)given("echo_us"), given("received_us"), given("sent_us"),
                           given_mark()};
}

static void say_stamps(const struct stamps *stamps) {
    say_number("echo_us", stamps->echo_us);
    say_number("received_us", stamps->received_us);
    say_number("sent_us", stamps->sent_us);
    say_number("mark_number", stamps->mark.number);
    say_number("mark_width_us", stamps->mark.width_us);
    say_number("mark_least_us", stamps->mark.least_us);
}

static void say_payload(const uint8_t *payload, int32_t size) {
    if (size == -1)
        say("refused");
    else
        say_bytes("payload", payload, size);
}

static void replay_varint_encode(void) {
    int32_t capacity = (int32_t)given("capacity");
    struct writer w = {room(capacity), capacity, 0, false};
    write_varint(&w, given("value"));
    say_payload(w.bytes, w.failed ? -1 : w.size);
}

static void replay_varint_decode(void) {
    int32_t size;
    struct reader r = {given_bytes("payload", &size), 0, 0, false};
    r.size = size;
    int64_t value = read_varint(&r);
    if (r.failed)
        say("malformed");
    else
        say_number("value", value);
}

static void replay_bytes_encode(void) {
    int32_t size, capacity = (int32_t)given("capacity");
    const uint8_t *bytes = given_bytes("bytes", &size);
    struct writer w = {room(capacity), capacity, 0, false};
    write_bytes(&w, bytes, size);
    say_payload(w.bytes, w.failed ? -1 : w.size);
}

static void replay_bytes_decode(void) {
    int32_t size, count = (int32_t)given("count");
    struct reader r = {given_bytes("payload", &size), 0, 0, false};
    r.size = size;
    uint8_t *bytes = room(count);
    read_bytes(&r, bytes, count);
    if (r.failed)
        say("malformed");
    else
        say_bytes("bytes", bytes, count);
}

static void replay_sync_encode(void) {
    struct stamps stamps = given_stamps();
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    say_payload(payload, sync_encode(&stamps, payload, capacity));
}

static void replay_sync_decode(void) {
    int32_t size;
    const uint8_t *payload = given_bytes("payload", &size);
    struct stamps stamps;
    if (sync_decode(payload, size, &stamps))
        say_stamps(&stamps);
    else
        say("malformed");
}

static void replay_plan_encode(void) {
    struct stamps stamps = given_stamps();
    struct plan plan = given_points();
    plan.number = (uint32_t)given("number");
    plan.epoch = (uint16_t)given("epoch");
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    say_payload(payload, plan_encode(&stamps, &plan, payload, capacity));
}

static void replay_plan_decode(void) {
    int32_t size;
    const uint8_t *payload = given_bytes("payload", &size);
    struct stamps stamps;
    struct plan plan;
    if (!plan_decode(payload, size, &stamps, &plan)) {
        say("malformed");
        return;
    }
    say_stamps(&stamps);
    say_number("number", plan.number);
    say_number("epoch", plan.epoch);
    say_number("first_knot", plan.first_knot);
    say_number("tracks", plan.tracks);
    say_number("count", plan.count);
    for (int32_t sink = 0; sink < TRACK_COUNT; sink++)
        if (plan.tracks & 1 << sink)
            say_list(sink_names[sink], plan.points[sink], plan.count);
}

// What a status has before its samples.
#define STATUS_FIELDS(X)                                                                           \
    X(sent_us, sent_us)                                                                            \
    X(sent_count_us, sent_count_us)                                                                \
    X(least_error_ns, least_error_ns)                                                              \
    X(most_error_ns, most_error_ns)                                                                \
    X(rate_q32, rate_q32)                                                                          \
    X(heard_us, heard_us)                                                                          \
    X(heard_age_us, heard_age_us)                                                                  \
    X(mark_number, mark.number)                                                                    \
    X(mark_width_us, mark.width_us)                                                                \
    X(mark_least_us, mark.least_us)                                                                \
    X(state, state)                                                                                \
    X(refusal, refusal)                                                                            \
    X(synced, synced)                                                                              \
    X(homed, homed)                                                                                \
    X(released, released)                                                                          \
    X(grouped, grouped)                                                                            \
    X(epoch, epoch)                                                                                \
    X(command_number, command_number)                                                              \
    X(command_result, command_result)                                                              \
    X(holding_tq, holding_tq)                                                                      \
    X(fault_reason, fault.reason)                                                                  \
    X(fault_state, fault.state)                                                                    \
    X(fault_boots, fault.boots)                                                                    \
    X(fault_time_us, fault.time_us)                                                                \
    X(fault_value, fault.value)                                                                    \
    X(fault_limit, fault.limit)                                                                    \
    X(fault_position_pq, fault.position_pq)                                                        \
    X(fault_torque_tq, fault.torque_tq)                                                            \
    X(plan_seen, plan_seen)                                                                        \
    X(plan_accepted, plan_accepted)                                                                \
    X(accepted_mask, accepted_mask)                                                                \
    X(plans_accepted, counters.plans_accepted)                                                     \
    X(plans_late, counters.plans_late)                                                             \
    X(plans_refused, counters.plans_refused)                                                       \
    X(frames_bad, counters.frames_bad)                                                             \
    X(coasts, counters.coasts)                                                                     \
    X(stamps_excluded, counters.stamps_excluded)                                                   \
    X(torque_peak_tq, torque_peak_tq)                                                              \
    X(torque_clipped, torque_clipped)                                                              \
    X(sample_count, sample_count)

// Samples: `ages_us` back from sent_us, and `counts`.
static void replay_status_encode(void) {
    struct status status = {0};
    int32_t ages_us[STATUS_SAMPLES_MAX] = {0}, counts[STATUS_SAMPLES_MAX] = {0};
#define TAKE(name, member) status.member = given(#name);
    STATUS_FIELDS(TAKE)
    given_list("ages_us", ages_us, STATUS_SAMPLES_MAX);
    given_list("counts", counts, STATUS_SAMPLES_MAX);
    for (int32_t i = 0; i < STATUS_SAMPLES_MAX; i++)
        status.samples[i] = (struct sample){status.sent_us - ages_us[i], counts[i]};
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    say_payload(payload, status_encode(&status, payload, capacity));
}

static void replay_status_decode(void) {
    int32_t size;
    const uint8_t *payload = given_bytes("payload", &size);
    struct status status;
    if (!status_decode(payload, size, &status)) {
        say("malformed");
        return;
    }
#define SAY(name, member) say_number(#name, status.member);
    STATUS_FIELDS(SAY)
    int32_t counts[STATUS_SAMPLES_MAX];
    for (int32_t i = 0; i < status.sample_count; i++) {
        say_number("time_us", status.samples[i].time_us);
        counts[i] = status.samples[i].count;
    }
    say_list("counts", counts, status.sample_count);
}

const struct word payload_words[] = {
    {"varint-encode", replay_varint_encode},
    {"varint-decode", replay_varint_decode},
    {"bytes-encode", replay_bytes_encode},
    {"bytes-decode", replay_bytes_decode},
    {"sync-encode", replay_sync_encode},
    {"sync-decode", replay_sync_decode},
    {"plan-encode", replay_plan_encode},
    {"plan-decode", replay_plan_decode},
    {"status-encode", replay_status_encode},
    {"status-decode", replay_status_decode},
    {0, 0},
};
