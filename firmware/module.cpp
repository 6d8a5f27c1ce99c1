// The firmware core for Python: the same C that runs on the board, called by the host's codec, by
// the encoder's checks and by the tests.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

extern "C" {
#include "cobs.h"
#include "device.h"
}

namespace nb = nanobind;
using namespace nb::literals;

using Points = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Times = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

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

static stamps make_stamps(const std::tuple<int64_t, int64_t, int64_t> &t) {
    return {std::get<0>(t), std::get<1>(t), std::get<2>(t)};
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
    nb::class_<session>(m, "Session")
        .def(
            "__init__",
            [](session *s, nb::bytes key, uint32_t number, bool at_device) {
                new (s) session{};
                copy_key(s->key, key);
                s->number = number;
                s->send_direction = at_device ? TO_HOST : TO_DEVICE;
            },
            "key"_a, "number"_a, "at_device"_a = false)
        .def_rw("sent", &session::sent)
        .def_rw("received", &session::received)
        .def(
            "seal",
            [](session &s, int type, nb::bytes payload) {
                if (payload.size() > FRAME_PAYLOAD_MAX)
                    throw std::invalid_argument("payload too long for a frame");
                std::vector<uint8_t> frame(FRAME_MAX), packet(COBS_BOUND(FRAME_MAX));
                std::memcpy(frame.data() + FRAME_HEADER_BYTES, payload.c_str(), payload.size());
                int32_t size =
                    frame_seal(&s, (frame_type)type, frame.data(), (int32_t)payload.size());
                return to_bytes(packet, cobs_encode(frame.data(), size, packet.data()));
            },
            "type"_a, "payload"_a)
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

static nb::bytes encode_plan(std::tuple<int64_t, int64_t, int64_t> stamps_us, uint32_t number,
                             int64_t first_knot, nb::dict tracks) {
    plan p{};
    p.number = number;
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
    stamps st = make_stamps(stamps_us);
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
    auto times = nb::make_tuple(st.status_us, st.status_received_us, st.sent_us);
    return nb::make_tuple(times, p.number, p.first_knot, tracks);
}

static void bind_payloads(nb::module_ &m) {
    m.def("plan_encode", &encode_plan, "stamps_us"_a, "number"_a, "first_knot"_a, "tracks"_a);
    m.def("plan_decode", &decode_plan, "payload"_a);
    m.def(
        "sync_encode",
        [](std::tuple<int64_t, int64_t, int64_t> stamps_us) {
            stamps st = make_stamps(stamps_us);
            std::vector<uint8_t> payload(FRAME_PAYLOAD_MAX);
            return to_bytes(payload, sync_encode(&st, payload.data(), FRAME_PAYLOAD_MAX));
        },
        "stamps_us"_a);
    nb::class_<status>(m, "Status")
        .def_ro("sent_us", &status::sent_us)
        .def_ro("state", &status::state)
        .def_ro("refusal", &status::refusal)
        .def_ro("synced", &status::synced)
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
            [](gate_limits *l, int32_t low, int32_t high, int32_t d, int32_t d2) {
                bool ok = low <= high && low >= -GATE_POINT_MAX && high <= GATE_POINT_MAX &&
                          d > 0 && d <= GATE_DIFFERENCE_MAX && d2 > 0;
                if (!ok)
                    throw std::invalid_argument("gate limits outside the range of the gate");
                new (l) gate_limits{low, high, d, d2};
            },
            "point_min"_a, "point_max"_a, "difference_max"_a, "second_difference_max"_a)
        .def_ro("point_min", &gate_limits::point_min)
        .def_ro("point_max", &gate_limits::point_max)
        .def_ro("difference_max", &gate_limits::difference_max)
        .def_ro("second_difference_max", &gate_limits::second_difference_max);
    nb::class_<servo_settings>(m, "ServoSettings")
        .def(nb::init<>())
        .def_rw("kp_tq", &servo_settings::kp_tq)
        .def_rw("ki_tq", &servo_settings::ki_tq)
        .def_rw("kd_tq", &servo_settings::kd_tq)
        .def_rw("velocity_tq", &servo_settings::velocity_tq)
        .def_rw("resistance_mV", &servo_settings::resistance_mV)
        .def_rw("emf_mV", &servo_settings::emf_mV)
        .def_rw("emf_tq", &servo_settings::emf_tq)
        .def_rw("supply_duty", &servo_settings::supply_duty)
        .def_rw("torque_limit_tq", &servo_settings::torque_limit_tq)
        .def_rw("integrate_running", &servo_settings::integrate_running);
    nb::class_<device_settings>(m, "DeviceSettings")
        .def(nb::init<>())
        .def_prop_rw(
            "key",
            [](device_settings &s) { return nb::bytes((const char *)s.key, SIPHASH_KEY_BYTES); },
            [](device_settings &s, nb::bytes key) { copy_key(s.key, key); })
        .def_rw("session", &device_settings::session)
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
        track_value v = track_evaluate(&t, times_us.data()[i], knot_shift);
        value[i] = v.value;
        rate[i] = v.rate;
        curve[i] = v.curve;
    }
    return nb::make_tuple(array(std::move(value), {n}), array(std::move(rate), {n}),
                          array(std::move(curve), {n}));
}

static const char *const gate_results[] = {"accepted", "late",  "gap",          "far",
                                           "range",    "speed", "acceleration", "rest",
                                           "start",    "stale", "state",        "sink"};

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
        .def("evaluate", &evaluate, "times_us"_a, "knot_shift"_a);
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
        .def_ro("saturated", &servo::saturated)
        .def(
            "step",
            [](servo &s, const servo_settings &settings, int32_t position_pq, int32_t velocity_pq,
               int32_t torque_tq, int32_t encoder_count, bool integrate) {
                setpoint target{position_pq,    velocity_pq,    torque_tq, settings.kp_tq,
                                settings.ki_tq, settings.kd_tq, integrate};
                return servo_step(&settings, &s, &target, encoder_count);
            },
            "settings"_a, "position_pq"_a, "velocity_pq"_a, "torque_tq"_a, "encoder_count"_a,
            "integrate"_a = true);
    nb::class_<headway_clock>(m, "Clock")
        .def("__init__", [](headway_clock *c) { new (c) headway_clock{}; })
        .def_ro("synced", &headway_clock::synced)
        .def_rw("skew_q32", &headway_clock::skew_q32)
        .def_rw("system_us", &headway_clock::system_us)
        .def_rw("count_us", &headway_clock::count_us)
        .def("advance", [](headway_clock &c, uint32_t count_us) { clock_advance(&c, count_us); })
        .def("at", [](const headway_clock &c, uint32_t count_us) { return clock_at(&c, count_us); })
        .def("sample", [](headway_clock &c, int64_t offset_us) { clock_sample(&c, offset_us); });
}

NB_MODULE(_core, m) {
    m.attr("FRAME_SYNC") = (int)FRAME_SYNC;
    m.attr("FRAME_PLAN") = (int)FRAME_PLAN;
    m.attr("FRAME_STATUS") = (int)FRAME_STATUS;
    m.attr("TRACK_POSITION") = (int)TRACK_POSITION;
    m.attr("TRACK_TORQUE") = (int)TRACK_TORQUE;
    m.attr("TRACK_KP") = (int)TRACK_KP;
    m.attr("TRACK_KI") = (int)TRACK_KI;
    m.attr("TRACK_KD") = (int)TRACK_KD;
    m.attr("TRACK_POINTS") = TRACK_POINTS;
    m.attr("PLAN_POINTS_MAX") = PLAN_POINTS_MAX;
    m.attr("LIVE_KNOTS") = GATE_LIVE_KNOTS;
    m.attr("COAST_KNOTS") = DEVICE_COAST_KNOTS;
    m.attr("COUNT_BITS") = SERVO_COUNT_BITS;
    m.attr("INTEGRAL_BITS") = SERVO_INTEGRAL_BITS;
    m.attr("POINT_MAX") = GATE_POINT_MAX;
    m.attr("DIFFERENCE_MAX") = GATE_DIFFERENCE_MAX;
    m.attr("TORQUE_MAX") = SERVO_TORQUE_MAX;
    m.attr("DUTY_MAX") = SERVO_DUTY_MAX;
    m.attr("GATE_RESULTS") =
        std::vector<std::string>(std::begin(gate_results), std::end(gate_results));
    m.attr("STATES") = std::vector<std::string>{"UNSYNCED", "IDLE", "RUNNING", "COAST", "HOLD"};
    bind_codec(m);
    bind_payloads(m);
    bind_settings(m);
    bind_kernels(m);
}
