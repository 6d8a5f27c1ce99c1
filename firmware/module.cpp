// The firmware core for Python: the same C that runs on the board, called by the host's codec, by
// the encoder's checks and by the tests.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

extern "C" {
#include "cobs.h"
#include "command.h"
#include "crc.h"
#include "device.h"
#include "gap.h"
#include "group.h"
#include "inbox.h"
#include "wire.h"
}

namespace nb = nanobind;
using namespace nb::literals;

using Points = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Stamps = std::tuple<uint32_t, int64_t, int64_t>;
using Mark = std::tuple<uint16_t, uint16_t, int64_t>; // number, width, least
using Counts = nb::ndarray<const uint32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Times = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// An observation and the servo that it is of.
struct Observation : observation, servo {};

template <typename T>
static auto array(std::vector<T> &&values, std::initializer_list<size_t> shape) {
    auto *owned = new std::vector<T>(std::move(values));
    nb::capsule owner(owned, [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return nb::ndarray<nb::numpy, T>(owned->data(), shape, owner);
}

static const uint8_t *data(const nb::bytes &bytes) {
    return reinterpret_cast<const uint8_t *>(bytes.c_str());
}

static nb::bytes to_bytes(const std::vector<uint8_t> &bytes, int32_t size) {
    return nb::bytes(reinterpret_cast<const char *>(bytes.data()), (size_t)size);
}

static void copy_key(uint8_t *key, const nb::bytes &bytes) {
    if (bytes.size() != SIPHASH_KEY_BYTES)
        throw std::invalid_argument("a key has 16 bytes");
    std::memcpy(key, bytes.c_str(), SIPHASH_KEY_BYTES);
}

static nb::bytes key_bytes(const uint8_t *key) {
    return nb::bytes((const char *)key, SIPHASH_KEY_BYTES);
}

static void copy_nonce(uint8_t *nonce, const nb::bytes &bytes) {
    if (bytes.size() != NONCE_BYTES)
        throw std::invalid_argument("a nonce has 16 bytes");
    std::memcpy(nonce, bytes.c_str(), NONCE_BYTES);
}

static nb::bytes pack(const std::vector<uint8_t> &frame, int32_t size) {
    if (size < 0)
        throw std::overflow_error("the session has no counters left: begin another");
    std::vector<uint8_t> packet(COBS_BOUND(FRAME_MAX));
    return to_bytes(packet, cobs_encode(frame.data(), size, packet.data()));
}

static const Mark no_mark{0, MARK_OPEN, 0};

static stamps make_stamps(const Stamps &t, const Mark &m = no_mark) {
    mark made{std::get<0>(m), std::get<1>(m), std::get<2>(m)};
    return {std::get<0>(t), std::get<1>(t), std::get<2>(t), made};
}

static const char *const frame_errors[] = {"ok",          "bad length", "bad version",
                                           "bad session", "replayed",   "bad tag"};

static void bind_codec(nb::module_ &m) {
    m.def(
        "siphash24",
        [](nb::bytes key, uint8_t prefix, nb::bytes message) {
            uint8_t k[SIPHASH_KEY_BYTES];
            copy_key(k, key);
            return siphash24(k, prefix, data(message), (int32_t)message.size());
        },
        "key"_a, "prefix"_a, "message"_a);
    m.def("cobs_encode", [](nb::bytes packet) {
        std::vector<uint8_t> out(COBS_BOUND(packet.size()));
        return to_bytes(out, cobs_encode(data(packet), (int32_t)packet.size(), out.data()));
    });
    m.def("cobs_decode", [](nb::bytes packet) -> nb::object {
        std::vector<uint8_t> out(data(packet), data(packet) + packet.size());
        int32_t size = cobs_decode(out.data(), (int32_t)out.size());
        if (size < 0)
            return nb::none();
        return to_bytes(out, size);
    });
    m.def(
        "frame_header",
        [](nb::bytes packet) -> nb::object {
            std::vector<uint8_t> out(data(packet), data(packet) + packet.size());
            int32_t size = cobs_decode(out.data(), (int32_t)out.size());
            if (size < FRAME_HEADER_BYTES)
                return nb::none();
            reader header = {out.data(), FRAME_HEADER_BYTES, 0, false};
            uint64_t version = read_uint(&header, 1), type = read_uint(&header, 1);
            uint64_t number = read_uint(&header, 4), counter = read_uint(&header, 6);
            return nb::make_tuple(version, type, number, counter);
        },
        "packet"_a);
    nb::class_<session>(m, "Session")
        .def(
            "__init__",
            [](session *s, nb::bytes send_key, nb::bytes receive_key, uint32_t number,
               bool at_device) {
                uint8_t send[SIPHASH_KEY_BYTES], receive[SIPHASH_KEY_BYTES];
                copy_key(send, send_key);
                copy_key(receive, receive_key);
                new (s) session{};
                session_begin(s, number, at_device ? TO_HOST : TO_DEVICE, send, receive);
            },
            "send_key"_a, "receive_key"_a, "number"_a, "at_device"_a = false)
        .def_ro("number", &session::number)
        .def_rw("sent", &session::sent)
        .def_prop_rw(
            "received", [](const session &s) { return s.received; },
            [](session &s, uint64_t counter) {
                s.received = counter;
                s.window = ~0ULL; // as if all up to it had been
            })
        .def_prop_ro("send_key", [](const session &s) { return key_bytes(s.send_key); })
        .def_prop_ro("receive_key", [](const session &s) { return key_bytes(s.receive_key); })
        .def(
            "seal",
            [](session &s, int type, nb::bytes payload) {
                if (payload.size() > FRAME_PAYLOAD_MAX)
                    throw std::invalid_argument("payload too long for a frame");
                std::vector<uint8_t> frame(FRAME_MAX);
                std::memcpy(frame.data() + FRAME_HEADER_BYTES, payload.c_str(), payload.size());
                return pack(
                    frame, frame_seal(&s, (frame_type)type, frame.data(), (int32_t)payload.size()));
            },
            "type"_a, "payload"_a)
        .def(
            "seal_group",
            [](session &s, const session &group) {
                std::vector<uint8_t> frame(FRAME_MAX);
                int32_t size =
                    group_encode(&s, &group, frame.data() + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX);
                return pack(frame, frame_seal(&s, FRAME_GROUP, frame.data(), size));
            },
            "group"_a)
        .def(
            "open",
            [](session &s, nb::bytes packet) -> nb::object {
                std::vector<uint8_t> frame(data(packet), data(packet) + packet.size());
                int32_t size = cobs_decode(frame.data(), (int32_t)frame.size());
                frame_error error =
                    size < 0 ? FRAME_BAD_LENGTH : frame_open(&s, frame.data(), size);
                if (error != FRAME_OK)
                    return nb::str(frame_errors[error]);
                size_t payload = (size_t)size - FRAME_HEADER_BYTES - FRAME_TAG_BYTES;
                nb::bytes body((const char *)frame.data() + FRAME_HEADER_BYTES, payload);
                return nb::make_tuple((int)frame[1], body);
            },
            "packet"_a);
}

static const char *const welcome_verdicts[] = {
    "ok", "line noise", "another frame", "other version", "stale", "wrong key"};

// What a host makes of an answer to its HELLO: the verdict and, if it is "ok", the device's nonce
// and the session.
static nb::tuple open_welcome(nb::bytes key, nb::bytes host_nonce, nb::bytes packet) {
    uint8_t k[SIPHASH_KEY_BYTES];
    nonces n{};
    copy_key(k, key);
    copy_nonce(n.host, host_nonce);
    std::vector<uint8_t> frame(data(packet), data(packet) + packet.size());
    int32_t size = cobs_decode(frame.data(), (int32_t)frame.size());
    welcome_verdict verdict = welcome_decode(k, frame.data(), size, &n);
    if (verdict != WELCOME_OK)
        return nb::make_tuple(welcome_verdicts[verdict], nb::none(), nb::none());
    session s{};
    handshake_session(k, &n, TO_DEVICE, &s);
    return nb::make_tuple("ok", nb::bytes((const char *)n.device, NONCE_BYTES), s);
}

static void bind_handshake(nb::module_ &m) {
    m.def("crc_of", [](nb::bytes bytes) { return crc_of(data(bytes), (int32_t)bytes.size()); });
    m.def(
        "hello",
        [](nb::bytes host_nonce) {
            uint8_t nonce[NONCE_BYTES];
            copy_nonce(nonce, host_nonce);
            std::vector<uint8_t> frame(HANDSHAKE_BYTES);
            hello_encode(nonce, frame.data());
            return pack(frame, HANDSHAKE_BYTES);
        },
        "host_nonce"_a);
    m.def(
        "welcome",
        [](nb::bytes key, nb::bytes host_nonce, nb::bytes device_nonce) {
            uint8_t k[SIPHASH_KEY_BYTES];
            nonces n{};
            copy_key(k, key);
            copy_nonce(n.host, host_nonce);
            copy_nonce(n.device, device_nonce);
            std::vector<uint8_t> frame(HANDSHAKE_BYTES);
            welcome_encode(k, &n, frame.data());
            return pack(frame, HANDSHAKE_BYTES);
        },
        "key"_a, "host_nonce"_a, "device_nonce"_a);
    m.def("welcome_open", &open_welcome, "key"_a, "host_nonce"_a, "packet"_a);
}

static nb::bytes encode_plan(Stamps stamps_us, uint32_t number, uint16_t epoch, int64_t first_knot,
                             nb::dict tracks, Mark mark) {
    plan p{};
    p.number = number;
    p.epoch = epoch;
    p.first_knot = first_knot;
    for (auto [sink, points] : tracks) {
        int s = nb::cast<int>(sink);
        auto values = nb::cast<Points>(points);
        size_t count = values.shape(0);
        if (s < 0 || s >= TRACK_COUNT || count > PLAN_POINTS_MAX || (p.count && p.count != count))
            throw std::invalid_argument(
                "a plan has known sinks, all with the same 3 .. 128 points");
        p.tracks |= (uint8_t)(1 << s);
        p.count = (uint8_t)count;
        std::memcpy(p.points[s], values.data(), count * sizeof(int32_t));
    }
    stamps st = make_stamps(stamps_us, mark);
    std::vector<uint8_t> payload(FRAME_PAYLOAD_MAX);
    int32_t size = plan_encode(&st, &p, payload.data(), FRAME_PAYLOAD_MAX);
    if (size < 0)
        throw std::invalid_argument("the plan does not fit a frame");
    return to_bytes(payload, size);
}

static nb::object decode_plan(nb::bytes payload) {
    plan p{};
    stamps st{};
    if (!plan_decode(data(payload), (int32_t)payload.size(), &st, &p))
        return nb::none();
    nb::dict tracks;
    for (int s = 0; s < TRACK_COUNT; s++)
        if (p.tracks & 1 << s)
            tracks[nb::int_(s)] =
                array(std::vector<int32_t>(p.points[s], p.points[s] + p.count), {p.count});
    auto times = nb::make_tuple(st.echo_us, st.received_us, st.sent_us);
    return nb::make_tuple(times, p.number, p.epoch, p.first_knot, tracks);
}

static void bind_payloads(nb::module_ &m) {
    m.def("plan_encode", &encode_plan, "stamps_us"_a, "number"_a, "epoch"_a, "first_knot"_a,
          "tracks"_a, "mark"_a = no_mark);
    m.def("plan_decode", &decode_plan, "payload"_a);
    m.def(
        "sync_encode",
        [](Stamps stamps_us, Mark mark) {
            stamps st = make_stamps(stamps_us, mark);
            std::vector<uint8_t> payload(FRAME_PAYLOAD_MAX);
            return to_bytes(payload, sync_encode(&st, payload.data(), FRAME_PAYLOAD_MAX));
        },
        "stamps_us"_a, "mark"_a = no_mark);
    m.def(
        "command_encode",
        [](uint32_t number, uint8_t kind, int32_t argument, uint16_t epoch) {
            command c{number, kind, argument, epoch};
            std::vector<uint8_t> payload(FRAME_PAYLOAD_MAX);
            return to_bytes(payload, command_encode(&c, payload.data(), FRAME_PAYLOAD_MAX));
        },
        "number"_a, "kind"_a, "argument"_a = 0, "epoch"_a = 0);
    m.def("command_decode", [](nb::bytes payload) -> nb::object {
        command c{};
        if (!command_decode(data(payload), (int32_t)payload.size(), &c))
            return nb::none();
        return nb::make_tuple(c.number, c.kind, c.argument, c.epoch);
    });
    nb::class_<fault>(m, "Fault")
        .def_ro("reason", &fault::reason)
        .def_ro("state", &fault::state)
        .def_ro("boots", &fault::boots)
        .def_ro("time_us", &fault::time_us)
        .def_ro("value", &fault::value)
        .def_ro("limit", &fault::limit)
        .def_ro("position_pq", &fault::position_pq)
        .def_ro("torque_tq", &fault::torque_tq);
    m.def("faults_decode", [](nb::bytes payload) -> nb::object {
        fault_log log{};
        if (!fault_log_decode(data(payload), (int32_t)payload.size(), &log))
            return nb::none();
        std::vector<fault> faults; // oldest first
        for (uint32_t i = log.count < FAULT_LOG ? 0 : log.count - FAULT_LOG; i < log.count; i++)
            faults.push_back(log.faults[i % FAULT_LOG]);
        return nb::cast(faults);
    });
    nb::class_<status>(m, "Status")
        .def_ro("sent_us", &status::sent_us)
        .def_ro("sent_count_us", &status::sent_count_us)
        .def_ro("least_error_ns", &status::least_error_ns)
        .def_ro("most_error_ns", &status::most_error_ns)
        .def_ro("rate_q32", &status::rate_q32)
        .def_ro("heard_us", &status::heard_us)
        .def_prop_ro("mark",
                     [](status &s) {
                         return nb::make_tuple(s.mark.number, s.mark.width_us, s.mark.least_us);
                     })
        .def_ro("heard_age_us", &status::heard_age_us)
        .def_ro("state", &status::state)
        .def_ro("refusal", &status::refusal)
        .def_ro("synced", &status::synced)
        .def_ro("homed", &status::homed)
        .def_ro("released", &status::released)
        .def_ro("grouped", &status::grouped)
        .def_ro("epoch", &status::epoch)
        .def_ro("command_number", &status::command_number)
        .def_ro("command_result", &status::command_result)
        .def_ro("holding_tq", &status::holding_tq)
        .def_ro("fault", &status::fault)
        .def_prop_ro("reason", [](status &s) { return s.fault.reason; })
        .def_prop_ro("reason_value", [](status &s) { return s.fault.value; })
        .def_prop_ro("reason_limit", [](status &s) { return s.fault.limit; })
        .def_ro("plan_seen", &status::plan_seen)
        .def_ro("plan_accepted", &status::plan_accepted)
        .def_ro("accepted_mask", &status::accepted_mask)
        .def_ro("torque_peak_tq", &status::torque_peak_tq)
        .def_ro("torque_clipped", &status::torque_clipped)
        .def_prop_ro("plans_accepted", [](status &s) { return s.counters.plans_accepted; })
        .def_prop_ro("plans_late", [](status &s) { return s.counters.plans_late; })
        .def_prop_ro("plans_refused", [](status &s) { return s.counters.plans_refused; })
        .def_prop_ro("frames_bad", [](status &s) { return s.counters.frames_bad; })
        .def_prop_ro("coasts", [](status &s) { return s.counters.coasts; })
        .def_prop_ro("stamps_excluded", [](status &s) { return s.counters.stamps_excluded; })
        .def_prop_ro("samples", [](status &s) {
            std::vector<std::tuple<int64_t, int32_t>> samples;
            for (int i = 0; i < s.sample_count; i++)
                samples.emplace_back(s.samples[i].time_us, s.samples[i].count);
            return samples;
        });
    m.def("status_decode", [](nb::bytes payload) -> nb::object {
        status s{};
        if (!status_decode(data(payload), (int32_t)payload.size(), &s))
            return nb::none();
        return nb::cast(s);
    });
}

static void bind_settings(nb::module_ &m) {
    nb::class_<scale>(m, "Scale")
        .def(
            "__init__",
            [](scale *s, uint16_t mantissa, uint8_t shift) {
                if (shift > 31)
                    throw std::invalid_argument("a scale's shift is 0 .. 31");
                new (s) scale{mantissa, shift};
            },
            "mantissa"_a = 0, "shift"_a = 0)
        .def_ro("mantissa", &scale::mantissa)
        .def_ro("shift", &scale::shift)
        .def("__mul__", [](const scale &s, int32_t a) { return fixed_scale(a, s); });
    nb::class_<gate_limits>(m, "GateLimits")
        .def(
            "__init__",
            [](gate_limits *l, int32_t low, int32_t high, int32_t d, int32_t d2, int32_t stop,
               bool continuous) {
                gate_limits limits{continuous, low, high, d, d2, stop};
                if (!gate_limits_valid(&limits))
                    throw std::invalid_argument("gate limits outside the range of the gate");
                new (l) gate_limits{limits};
            },
            "point_min"_a, "point_max"_a, "difference_max"_a, "second_difference_max"_a,
            "stop_difference"_a = 0, "continuous"_a = false)
        .def_ro("continuous", &gate_limits::continuous)
        .def_ro("point_min", &gate_limits::point_min)
        .def_ro("point_max", &gate_limits::point_max)
        .def_ro("difference_max", &gate_limits::difference_max)
        .def_ro("second_difference_max", &gate_limits::second_difference_max)
        .def_ro("stop_difference", &gate_limits::stop_difference);
    nb::class_<servo_settings>(m, "ServoSettings")
        .def(nb::init<>())
        .def_rw("kp_tq", &servo_settings::kp_tq)
        .def_rw("ki_tq", &servo_settings::ki_tq)
        .def_rw("kd_tq", &servo_settings::kd_tq)
        .def_rw("velocity_tq", &servo_settings::velocity_tq)
        .def_rw("acceleration_tq", &servo_settings::acceleration_tq)
        .def_rw("resistance_mV", &servo_settings::resistance_mV)
        .def_rw("emf_mV", &servo_settings::emf_mV)
        .def_rw("emf_tq", &servo_settings::emf_tq)
        .def_rw("supply_duty", &servo_settings::supply_duty)
        .def_rw("torque_limit_tq", &servo_settings::torque_limit_tq)
        .def_rw("integrate_running", &servo_settings::integrate_running)
        .def_rw("ahead_us", &servo_settings::ahead_us);
    nb::class_<monitor_settings>(m, "MonitorSettings")
        .def(nb::init<>())
        .def_rw("following_pq", &monitor_settings::following_pq)
        .def_rw("following_periods", &monitor_settings::following_periods)
        .def_rw("speed_pq", &monitor_settings::speed_pq)
        .def_rw("bounded", &monitor_settings::bounded)
        .def_rw("low_pq", &monitor_settings::low_pq)
        .def_rw("high_pq", &monitor_settings::high_pq)
        .def_rw("deceleration_q16", &monitor_settings::deceleration_q16)
        .def_rw("torque_periods", &monitor_settings::torque_periods)
        .def_rw("load_q8", &monitor_settings::load_q8)
        .def_rw("overload", &monitor_settings::overload)
        .def_rw("heating_q16", &monitor_settings::heating_q16)
        .def_rw("rise_q16", &monitor_settings::rise_q16)
        .def_rw("stuck_pq", &monitor_settings::stuck_pq)
        .def_rw("stuck_periods", &monitor_settings::stuck_periods)
        .def_rw("spike_counts", &monitor_settings::spike_counts)
        .def_rw("supply_min_mV", &monitor_settings::supply_min_mV)
        .def_rw("supply_max_mV", &monitor_settings::supply_max_mV)
        .def_rw("chopper_mV", &monitor_settings::chopper_mV)
        .def_rw("late_us", &monitor_settings::late_us);
    nb::class_<home_settings>(m, "HomeSettings")
        .def(nb::init<>())
        .def_rw("method", &home_settings::method)
        .def_rw("backwards", &home_settings::backwards)
        .def_rw("mark_count", &home_settings::mark_count)
        .def_rw("speed_q16", &home_settings::speed_q16)
        .def_rw("acceleration_q16", &home_settings::acceleration_q16)
        .def_rw("torque_tq", &home_settings::torque_tq)
        .def_rw("way_counts", &home_settings::way_counts)
        .def_rw("still_periods", &home_settings::still_periods);
    nb::class_<sync_settings>(m, "SyncSettings")
        .def(nb::init<>())
        .def_rw("method", &sync_settings::method)
        .def_rw("among_boards", &sync_settings::among_boards)
        .def_rw("drift_ppm", &sync_settings::drift_ppm)
        .def_rw("wander_ppb_s", &sync_settings::wander_ppb_s)
        .def_rw("to_device_least_us", &sync_settings::to_device_least_us)
        .def_rw("to_host_least_us", &sync_settings::to_host_least_us)
        .def_rw("limit_us", &sync_settings::limit_us)
        .def_prop_rw(
            "interval_us", [](sync_settings &s) { return s.average.interval_us; },
            [](sync_settings &s, uint32_t value) { s.average.interval_us = value; })
        .def_prop_rw(
            "phase_gain", [](sync_settings &s) { return s.average.phase_gain; },
            [](sync_settings &s, uint16_t value) { s.average.phase_gain = value; })
        .def_prop_rw(
            "skew_gain_q8", [](sync_settings &s) { return s.average.skew_gain_q8; },
            [](sync_settings &s, uint16_t value) { s.average.skew_gain_q8 = value; });
    nb::class_<device_settings>(m, "DeviceSettings")
        .def(nb::init<>())
        .def_prop_rw(
            "name", [](device_settings &s) { return std::string(s.name); },
            [](device_settings &s, const std::string &name) {
                if (name.size() > SETTINGS_NAME_MAX || name.find('\0') != std::string::npos)
                    throw std::invalid_argument(
                        "a device's name has up to 25 bytes of UTF-8, none of them zero");
                std::memset(s.name, 0, sizeof s.name);
                std::memcpy(s.name, name.data(), name.size());
            })
        .def_rw("brake_periods", &device_settings::brake_periods)
        .def_rw("stop_us", &device_settings::stop_us)
        .def_rw("sync_lost_us", &device_settings::sync_lost_us)
        .def_rw("dither_us", &device_settings::dither_us)
        .def_rw("torque_step_tq", &device_settings::torque_step_tq)
        .def_rw("knot_periods", &device_settings::knot_periods)
        .def_rw("offset_count", &device_settings::offset_count)
        .def_rw("step_least_q16", &device_settings::step_least_q16)
        .def_rw("carries_gravity", &device_settings::carries_gravity)
        .def_rw("monitor", &device_settings::monitor)
        .def_rw("home", &device_settings::home)
        .def_rw("sync", &device_settings::sync)
        .def_prop_rw(
            "peer_key", [](device_settings &s) { return key_bytes(s.peer_key); },
            [](device_settings &s, nb::bytes key) { copy_key(s.peer_key, key); })
        .def_rw("neighbours", &device_settings::neighbours)
        .def_rw("ask_us", &device_settings::ask_us)
        .def_rw("peer_least_us", &device_settings::peer_least_us)
        .def_prop_ro("valid", [](const device_settings &s) { return settings_valid(&s); })
        .def(
            "encode",
            [](const device_settings &s, bool with_key) {
                std::vector<uint8_t> bytes(SETTINGS_BYTES_MAX);
                return to_bytes(bytes,
                                settings_encode(&s, with_key, bytes.data(), SETTINGS_BYTES_MAX));
            },
            "with_key"_a = false)
        .def_static(
            "decode",
            [](nb::bytes bytes, bool with_key) -> nb::object {
                device_settings s{};
                if (!settings_decode(data(bytes), (int32_t)bytes.size(), with_key, &s))
                    return nb::none();
                return nb::cast(s);
            },
            "bytes"_a, "with_key"_a = false)
        .def("set_gap_policy",
             [](device_settings &s, int sink, int policy) {
                 if (sink < 0 || sink >= TRACK_COUNT || policy < 0 || policy >= GAP_POLICIES)
                     throw std::invalid_argument("no such sink or policy");
                 s.gap_policy[sink] = (uint8_t)policy;
             })
        .def("gap_policy",
             [](device_settings &s, int sink) {
                 if (sink < 0 || sink >= TRACK_COUNT)
                     throw std::invalid_argument("no such sink");
                 return (int)s.gap_policy[sink];
             })
        .def_prop_rw(
            "key", [](device_settings &s) { return key_bytes(s.key); },
            [](device_settings &s, nb::bytes key) { copy_key(s.key, key); })
        .def_rw("knot_shift", &device_settings::knot_shift)
        .def_rw("servo_period_us", &device_settings::servo_period_us)
        .def_rw("sample_every", &device_settings::sample_every)
        .def_rw("servo", &device_settings::servo)
        .def("set_limits",
             [](device_settings &s, int sink, const gate_limits &limits) {
                 if (sink < 0 || sink >= TRACK_COUNT)
                     throw std::invalid_argument("no such sink");
                 s.limits[sink] = limits;
             })
        .def("limits", [](device_settings &s, int sink) {
            if (sink < 0 || sink >= TRACK_COUNT)
                throw std::invalid_argument("no such sink");
            return s.limits[sink];
        });
}

static nb::tuple evaluate(const track &t, Times times_us, int32_t knot_shift) {
    size_t n = times_us.shape(0);
    std::vector<int32_t> value(n), rate(n), curve(n);
    for (size_t i = 0; i < n; i++) {
        instant at = instant_at(times_us.data()[i], knot_shift);
        value[i] = track_value(&t, &at);
        rate[i] = track_rate(&t, &at);
        curve[i] = track_curve(&t, &at);
    }
    return nb::make_tuple(array(std::move(value), {n}), array(std::move(rate), {n}),
                          array(std::move(curve), {n}));
}

using Tracks = std::vector<const track *>;

// Of several tracks, a row each.
static auto track_points(const Tracks &tracks, int64_t first_knot, int32_t count) {
    size_t k = tracks.size(), m = (size_t)(count < 0 ? 0 : count);
    std::vector<int32_t> points(k * m);
    for (size_t j = 0; j < k; j++)
        for (size_t i = 0; i < m; i++)
            points[j * m + i] = track_point(tracks[j], first_knot + (int64_t)i);
    return array(std::move(points), {k, m});
}

static const char *const gate_results[] = {"accepted", "late",         "gap",  "far",   "range",
                                           "speed",    "acceleration", "rest", "start", "stale",
                                           "state",    "sink",         "room", "epoch"};

static void check_count(const Points &points) {
    if (points.shape(0) < 3 || points.shape(0) > PLAN_POINTS_MAX)
        throw std::invalid_argument("a plan has 3 .. 128 points");
}

static void bind_kernels(nb::module_ &m) {
    nb::class_<track>(m, "Track")
        .def(nb::init<>())
        .def_ro("written", &track::written)
        .def_ro("end", &track::end)
        .def("copy", [](const track &t) { return track(t); })
        .def(
            "write",
            [](track &t, int64_t first_knot, Points points) {
                check_count(points);
                track_write(&t, first_knot, points.data(), (int32_t)points.shape(0));
            },
            "first_knot"_a, "points"_a)
        .def(
            "points",
            [](const track &t, int64_t first_knot, int32_t count) {
                std::vector<int32_t> points((size_t)(count < 0 ? 0 : count));
                for (size_t i = 0; i < points.size(); i++)
                    points[i] = track_point(&t, first_knot + (int64_t)i);
                size_t n = points.size();
                return array(std::move(points), {n});
            },
            "first_knot"_a, "count"_a)
        .def(
            "past",
            [](const track &t, int64_t time_us, int32_t knot_shift) -> std::optional<int32_t> {
                instant at = instant_at(time_us, knot_shift);
                int32_t value;
                return track_past(&t, &at, &value) ? std::optional(value) : std::nullopt;
            },
            "time_us"_a, "knot_shift"_a)
        .def("evaluate", &evaluate, "times_us"_a, "knot_shift"_a);
    m.def("track_points", &track_points, "tracks"_a, "first_knot"_a, "count"_a);
    m.def(
        "gate_check_track",
        [](const gate_limits &limits, const track &stored, int64_t first_knot, Points points,
           int64_t knot) {
            check_count(points);
            return gate_results[gate_check_track(&limits, &stored, first_knot, points.data(),
                                                 (int32_t)points.shape(0), knot)];
        },
        "limits"_a, "stored"_a, "first_knot"_a, "points"_a, "knot"_a);
    nb::class_<servo>(m, "Servo")
        .def("__init__", [](servo *s) { new (s) servo{}; })
        .def_rw("integral", &servo::integral)
        .def_ro("torque_tq", &servo::torque_tq)
        .def_ro("unclipped_tq", &servo::unclipped_tq)
        .def_prop_ro("saturated", [](servo &s) { return s.saturated != 0; })
        .def(
            "step",
            [](servo &s, const servo_settings &settings, int32_t position_pq, int32_t velocity_pq,
               int32_t torque_tq, int32_t encoder_count, bool integrate) {
                setpoint target{settings.kp_tq, settings.ki_tq, settings.kd_tq,      position_pq,
                                velocity_pq,    torque_tq,      SERVO_FEEDBACK_FREE, integrate};
                return servo_step(&settings, &s, &target, servo_position_pq(encoder_count, false));
            },
            "settings"_a, "position_pq"_a, "velocity_pq"_a, "torque_tq"_a, "encoder_count"_a,
            "integrate"_a = true);
    nb::class_<headway_clock>(m, "Clock")
        .def(
            "__init__",
            [](headway_clock *c, uint32_t count_us) {
                new (c) headway_clock{0, 0, count_us, 0, 0};
            },
            "count_us"_a = 0)
        .def_rw("rate_q32", &headway_clock::rate_q32)
        .def_ro("system_us", &headway_clock::system_us)
        .def_ro("fraction_q32", &headway_clock::fraction_q32)
        .def_ro("count_us", &headway_clock::count_us)
        .def_ro("ticks_us", &headway_clock::ticks_us)
        .def("advance", [](headway_clock &c, uint32_t count_us) { clock_advance(&c, count_us); })
        .def("at", [](const headway_clock &c, uint32_t count_us) { return clock_at(&c, count_us); })
        .def("ticks",
             [](const headway_clock &c, uint32_t count_us) { return clock_ticks(&c, count_us); })
        .def("offset_q16",
             [](const headway_clock &c, int64_t base_us) { return clock_offset_q16(&c, base_us); })
        .def("set", [](headway_clock &c, int64_t base_us, int64_t offset_q16) {
            clock_set(&c, base_us, offset_q16);
        });
    m.def("next_state", [](int state, int event) {
        if (state < 0 || state >= DEVICE_STATES || event < 0 || event >= DEVICE_EVENTS)
            throw std::invalid_argument("no such state or event");
        return (int)next_state((device_state)state, (device_event)event);
    });
    m.def("gap_policy_valid", [](int sink, int policy, bool carries_gravity) {
        return gap_policy_valid((track_sink)sink, (gap_policy)policy, carries_gravity);
    });
    m.def("fault_response", [](int reason) { return (int)fault_response((fault_reason)reason); });
}

// A clock that is synchronized: what a device has of it.
struct synced_clock {
    sync_settings settings;
    headway_clock clock;
    struct sync sync;
};

// Rows in the order of their counts: at each the clock is advanced, stamps are taken if there are
// any (sent_us not 0), and the clock is steered. Tells after each row.
static nb::tuple follow(synced_clock &s, Counts count_us, Counts arrived_us, Counts echo_us,
                        Times received_us, Times sent_us, bool may_step) {
    size_t n = count_us.shape(0);
    if (arrived_us.shape(0) != n || echo_us.shape(0) != n || received_us.shape(0) != n ||
        sent_us.shape(0) != n)
        throw std::invalid_argument("all columns have as many rows");
    std::vector<int64_t> system_us(n);
    std::vector<uint32_t> fraction_q32(n);
    std::vector<int32_t> least_ns(n), most_ns(n);
    std::vector<uint8_t> settled(n);
    for (size_t i = 0; i < n; i++) {
        clock_advance(&s.clock, count_us.data()[i]);
        if (sent_us.data()[i] != 0) {
            stamps st{echo_us.data()[i], received_us.data()[i], sent_us.data()[i], {}};
            sync_source host = sync_host(&s.settings);
            sync_take(&s.sync, &s.settings, &s.clock, &host, &st, arrived_us.data()[i],
                      count_us.data()[i], may_step && !s.sync.settled);
        }
        sync_steer(&s.sync, &s.settings, &s.clock, may_step && !s.sync.settled);
        system_us[i] = s.clock.system_us;
        fraction_q32[i] = s.clock.fraction_q32;
        least_ns[i] = s.sync.least_error_ns;
        most_ns[i] = s.sync.most_error_ns;
        settled[i] = s.sync.settled;
    }
    return nb::make_tuple(array(std::move(system_us), {n}), array(std::move(fraction_q32), {n}),
                          array(std::move(least_ns), {n}), array(std::move(most_ns), {n}),
                          array(std::move(settled), {n}));
}

static void bind_sync(nb::module_ &m) {
    nb::class_<synced_clock>(m, "Sync")
        .def(
            "__init__",
            [](synced_clock *s, const sync_settings &settings, uint32_t count_us) {
                new (s) synced_clock{settings, {0, 0, count_us, 0, 0}, {}};
                sync_restart(&s->sync);
            },
            "settings"_a, "count_us"_a = 0)
        .def_prop_ro(
            "clock", [](synced_clock &s) -> headway_clock & { return s.clock; },
            nb::rv_policy::reference_internal)
        .def_prop_ro("settled", [](synced_clock &s) { return s.sync.settled; })
        .def_prop_ro("excluded", [](synced_clock &s) { return s.sync.excluded; })
        .def_prop_ro("outcast", [](synced_clock &s) { return s.sync.outcast; })
        .def_prop_ro("least_error_ns", [](synced_clock &s) { return s.sync.least_error_ns; })
        .def_prop_ro("most_error_ns", [](synced_clock &s) { return s.sync.most_error_ns; })
        .def_prop_ro("error_us", [](synced_clock &s) { return sync_error_us(&s.sync); })
        .def("restart", [](synced_clock &s) { sync_restart(&s.sync); })
        .def(
            "take",
            [](synced_clock &s, Stamps stamps_us, uint32_t arrived_us, uint32_t now_us,
               bool may_step, int32_t least_error_ns, int32_t most_error_ns) {
                stamps st = make_stamps(stamps_us);
                sync_source source = sync_host(&s.settings);
                source.least_error_ns = least_error_ns;
                source.most_error_ns = most_error_ns;
                return sync_take(&s.sync, &s.settings, &s.clock, &source, &st, arrived_us, now_us,
                                 may_step);
            },
            "stamps_us"_a, "arrived_us"_a, "now_us"_a, "may_step"_a = true, "least_error_ns"_a = 0,
            "most_error_ns"_a = 0)
        .def(
            "steer",
            [](synced_clock &s, uint32_t count_us, bool may_step) {
                clock_advance(&s.clock, count_us);
                return sync_steer(&s.sync, &s.settings, &s.clock, may_step);
            },
            "count_us"_a, "may_step"_a)
        .def("follow", &follow, "count_us"_a, "arrived_us"_a, "echo_us"_a, "received_us"_a,
             "sent_us"_a, "may_step"_a = true);
}

static void bind_stops(nb::module_ &m) {
    nb::class_<Observation>(m, "Observation")
        .def("__init__", [](Observation *o) { new (o) Observation{}; })
        .def_rw("count", &Observation::count)
        .def_rw("position_pq", &Observation::position_pq)
        .def_rw("setpoint_pq", &Observation::setpoint_pq)
        .def_rw("error_pq", &Observation::error_pq)
        .def_rw("torque_tq", &Observation::torque_tq)
        .def_rw("torque_limit_tq", &Observation::torque_limit_tq)
        .def_rw("feedback_tq", &Observation::feedback_tq)
        .def_prop_rw(
            "clipped", [](const Observation &o) { return o.clipped != 0; },
            [](Observation &o, bool clipped) { o.clipped = clipped; })
        .def_rw("supply_mV", &Observation::supply_mV)
        .def_rw("late_us", &Observation::late_us)
        .def_rw("power", &Observation::power)
        .def_rw("driven", &Observation::driven)
        .def_rw("bounded", &Observation::bounded)
        .def_rw("may_stand", &Observation::may_stand)
        .def_rw("heat_shift", &Observation::heat_shift)
        .def_rw("looks", &Observation::looks)
        .def_rw("stuck_periods", &Observation::stuck_periods);
    nb::class_<monitor>(m, "Monitor")
        .def("__init__", [](monitor *w) { new (w) monitor{}; })
        .def_ro("chopper", &monitor::chopper)
        .def_ro("rise_q16", &monitor::rise_q16)
        .def_prop_ro("overload", [](const monitor &w) { return w.overload >> 16; })
        .def_prop_ro("speed_pq", [](const monitor &w) { return monitor_speed_pq(&w); })
        .def("begin", [](monitor &w) { monitor_begin(&w); })
        .def(
            "step",
            [](monitor &w, const monitor_settings &settings, const Observation &o) {
                observation seen = o;
                servo last = o;
                last.effort_tq = (o.torque_tq < 0 ? -o.torque_tq : o.torque_tq) << o.heat_shift;
                seen.servo = &last;
                monitor_step(&settings, &w, &seen);
                if (w.breach.reason == REASON_NONE)
                    return nb::make_tuple((int)REASON_NONE, 0, 0);
                return nb::make_tuple((int)w.breach.reason, w.breach.value, w.breach.limit);
            },
            "settings"_a, "seen"_a);
    nb::class_<stepper>(m, "Stepper")
        .def(
            "__init__",
            [](stepper *s, int32_t position_pq) {
                new (s) stepper{};
                stepper_begin(s, position_pq);
            },
            "position_pq"_a)
        .def(
            "step",
            [](stepper &s, uint32_t least_q16, int32_t target_pq, uint32_t window_us) {
                if (least_q16 == 0 || window_us == 0 || window_us >= 1 << 15)
                    throw std::invalid_argument("a stepper has a rate, and a window of its own");
                pulses p = stepper_step(&s, least_q16, target_pq, window_us);
                return std::make_tuple(p.steps, p.first_q16, p.spacing_q16);
            },
            "least_q16"_a, "target_pq"_a, "window_us"_a)
        .def("shift", [](stepper &s, int32_t by_count) { stepper_shift(&s, by_count); })
        .def_ro("count", &stepper::count)
        .def_ro("target_pq", &stepper::target_pq)
        .def_ro("now_pq", &stepper::now_pq);
    nb::class_<ramp>(m, "Ramp")
        .def(
            "__init__",
            [](ramp *r, int32_t position_pq, int32_t velocity_pq, int32_t torque_tq,
               int32_t end_torque_tq) {
                new (r) ramp{};
                ramp_start(r, position_pq, velocity_pq, torque_tq, end_torque_tq);
            },
            "position_pq"_a, "velocity_pq"_a, "torque_tq"_a, "end_torque_tq"_a)
        .def("step", [](ramp &r, int32_t deceleration_q16,
                        int32_t step_tq) { ramp_step(&r, deceleration_q16, step_tq); })
        .def_prop_ro("position_pq", [](const ramp &r) { return ramp_position_pq(&r); })
        .def_prop_ro("velocity_pq", [](const ramp &r) { return ramp_velocity_pq(&r); })
        .def_ro("position_q16", &ramp::position_q16)
        .def_ro("velocity_q16", &ramp::velocity_q16)
        .def_ro("torque_tq", &ramp::torque_tq)
        .def_ro("resting", &ramp::resting);
}

using Names = std::vector<std::string>;

static void name_numbers(nb::module_ &m) {
    m.attr("GATE_RESULTS") = Names(std::begin(gate_results), std::end(gate_results));
    m.attr("STATES") = Names{"BOOT",  "UNSYNCED", "IDLE", "ARMED", "RUNNING",
                             "COAST", "TAIL",     "HOLD", "FAULT", "ESTOP"};
    m.attr("EVENTS") = Names{"BOOTED", "SYNCED", "SYNC_LOST", "ARM",   "DISARM", "PLAN", "OVERDUE",
                             "RESTED", "RESUME", "STOP",      "FAULT", "CLEAR",  "ESTOP"};
    m.attr("REASONS") =
        Names{"NONE",     "HOST",    "SYNC_LOST",    "CLOCK",       "GAP",       "FOLLOWING",
              "SPEED",    "ROOM",    "TORQUE",       "HOMING",      "GAP_FAULT", "OUTSIDE",
              "I2T",      "WINDING", "UNDERVOLTAGE", "OVERVOLTAGE", "LATE",      "STUCK",
              "REVERSED", "SPIKE",   "SETTINGS"};
    m.attr("RESPONSES") = Names{"TAIL", "FAULT", "BRAKE"};
    m.attr("COMMANDS") =
        Names{"ARM", "DISARM", "RESUME", "STOP", "CLEAR", "HOME", "JOG", "ZERO", "SAVE", "FAULTS"};
    m.attr("COMMAND_RESULTS") =
        Names{"DONE", "NOT_NOW", "UNHOMED", "MOVING", "CAUSE", "BAD", "FAILED", "UNSYNCED"};
    m.attr("GAP_POLICIES") = Names{"interpolate", "ramp", "hold", "zero", "fault"};
    m.attr("HOME_METHODS") = Names{"none", "index", "switch", "stop"};
}

void bind_signals(nb::module_ &m); // module_signals.cpp

NB_MODULE(_core, m) {
    bind_signals(m);
    m.attr("FRAME_SYNC") = (int)FRAME_SYNC;
    m.attr("FRAME_PLAN") = (int)FRAME_PLAN;
    m.attr("FRAME_STATUS") = (int)FRAME_STATUS;
    m.attr("FRAME_COMMAND") = (int)FRAME_COMMAND;
    m.attr("FRAME_FAULTS") = (int)FRAME_FAULTS;
    m.attr("FRAME_HELLO") = (int)FRAME_HELLO;
    m.attr("FRAME_WELCOME") = (int)FRAME_WELCOME;
    m.attr("FRAME_GROUP") = (int)FRAME_GROUP;
    m.attr("FRAME_SETTINGS") = (int)FRAME_SETTINGS;
    m.attr("FRAME_WINDOW") = FRAME_WINDOW;
    m.attr("INBOX_PACKETS") = INBOX_PACKETS;
    m.attr("OFFER_PAUSE_US") = OFFER_PAUSE_US;
    m.attr("OFFER_VALID_US") = OFFER_VALID_US;
    m.attr("NAME_MAX") = SETTINGS_NAME_MAX;
    m.attr("TRACK_POSITION") = (int)TRACK_POSITION;
    m.attr("TRACK_TORQUE") = (int)TRACK_TORQUE;
    m.attr("TRACK_KP") = (int)TRACK_KP;
    m.attr("TRACK_KI") = (int)TRACK_KI;
    m.attr("TRACK_KD") = (int)TRACK_KD;
    m.attr("TRACK_POINTS") = TRACK_POINTS;
    m.attr("PLAN_POINTS_MAX") = PLAN_POINTS_MAX;
    m.attr("PACKET_MAX") = COBS_BOUND(FRAME_MAX);
    m.attr("FRAME_VERSION") = FRAME_VERSION;
    m.attr("LIVE_KNOTS") = GATE_LIVE_KNOTS;
    m.attr("COAST_KNOTS") = DEVICE_COAST_KNOTS;
    m.attr("MARK_OPEN") = MARK_OPEN;
    m.attr("COUNT_BITS") = SERVO_COUNT_BITS;
    m.attr("INTEGRAL_BITS") = SERVO_INTEGRAL_BITS;
    m.attr("POINT_MAX") = GATE_POINT_MAX;
    m.attr("DIFFERENCE_MAX") = GATE_DIFFERENCE_MAX;
    m.attr("TORQUE_MAX") = SERVO_TORQUE_MAX;
    m.attr("DUTY_MAX") = SERVO_DUTY_MAX;
    name_numbers(m);
    bind_codec(m);
    bind_handshake(m);
    bind_payloads(m);
    bind_settings(m);
    bind_kernels(m);
    bind_sync(m);
    bind_stops(m);
}
