// A simulated node (device and board) inside MuJoCo's plugin state, for Python.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

extern "C" {
#include "board.h"
#include "polls.h"
#include "store.h"
}

namespace nb = nanobind;
using namespace nb::literals;

using State = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// Refers to the array and keeps it alive.
struct Node {
    State state;
    node *operator->() const { return reinterpret_cast<node *>(state.data()); }
};

using Times = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<nb::numpy, uint32_t, nb::ndim<1>>;

static oscillator new_oscillator(int64_t offset, int32_t drift_ppb, int32_t wander_ppb_per_s,
                                 int32_t drift_bound_ppb, uint64_t seed) {
    oscillator o{};
    if (!oscillator_begin(&o, offset, drift_ppb, wander_ppb_per_s, drift_bound_ppb, seed))
        throw std::invalid_argument(
            "an oscillator's drift lies within its bound, bound and wander from 0 to 1000000 ppb");
    return o;
}

static uint32_t count_at(oscillator &o, int64_t true_us) {
    oscillator_seek(&o, true_us);
    return (uint32_t)(uint64_t)oscillator_read(&o, true_us);
}

static Counts counts_at(oscillator &o, Times true_us) {
    size_t size = true_us.shape(0);
    uint32_t *counts = new uint32_t[size];
    nb::capsule owner(counts, [](void *p) noexcept { delete[] static_cast<uint32_t *>(p); });
    for (size_t i = 0; i < size; i++)
        counts[i] = count_at(o, true_us.data()[i]);
    return Counts(counts, {size}, owner);
}

// A power cycle: what is in memory stays, all else is gone.
static void restart(Node &n) {
    for (parcel &p : n->board.inbox)
        p.size = 0;
    for (parcel &p : n->board.outbox)
        p.size = 0;
    n->board.hung = false;
    board_set_power(&n->board, false);
    board_set_brake(&n->board, true);
    board_set_duty(&n->board, 0);
    board_set_chopper(&n->board, false);
    n->board.stepping = stepping{};
    device_boot(&n->device, &n->board, board_count_us(&n->board));
    n->board.stepping.used = n->device.steps;
}

// As a programmer does: settings into the memory, beside what is there, and a power cycle.
static void flash(Node &n, const device_settings &settings, int64_t count_offset, int32_t drift_ppb,
                  int32_t wander_ppb_per_s, int32_t drift_bound_ppb, uint64_t seed) {
    n->board.oscillator =
        new_oscillator(count_offset, drift_ppb, wander_ppb_per_s, drift_bound_ppb, seed);
    store_save_settings(&n->board, &settings);
    restart(n);
}

static void check_record(int record) {
    if (record < 0 || record >= RECORDS)
        throw std::invalid_argument("no such record");
}

static nb::bytes memory_of(Node &n, int record) {
    check_record(record);
    const memory &m = n->board.memory[record];
    return nb::bytes((const char *)m.bytes, (size_t)m.size);
}

static void set_memory(Node &n, int record, nb::bytes bytes) {
    check_record(record);
    if (bytes.size() > BOARD_RECORD_MAX)
        throw std::invalid_argument("too long for a record");
    board_save(&n->board, (board_record)record, reinterpret_cast<const uint8_t *>(bytes.c_str()),
               (int32_t)bytes.size());
}

static void break_encoder(Node &n, int32_t defect, int64_t since_us) {
    if (defect < ENCODER_GOOD || defect > ENCODER_SPIKE)
        throw std::invalid_argument("no such defect of an encoder");
    n->board.encoder_fault = encoder_fault{defect, since_us, 0, false};
}

static void join_bus(Node &n, int64_t phase_ps, int64_t period_ps, uint64_t seed) {
    int64_t ps_per_us = 1000000, now_us = n->board.true_us;
    if (phase_ps < 0 || period_ps <= 0 || now_us > INT64_MAX / ps_per_us / 2)
        throw std::invalid_argument(
            "a bus has a phase from 0 and a period above 0; it is joined in the first 50 days");
    int64_t frame = 0; // the first that starts after now
    if (now_us * ps_per_us >= phase_ps)
        frame = (now_us * ps_per_us - phase_ps) / period_ps + 1;
    int64_t next_ps = phase_ps + frame * period_ps;
    n->board.bus = frame_clock{
        period_ps, next_ps / ps_per_us, next_ps % ps_per_us, (uint32_t)(frame % 2048), false, seed};
}

static nb::object frame_start(Node &n) {
    uint16_t number;
    uint32_t count_us;
    if (!board_frame_start(&n->board, &number, &count_us))
        return nb::none();
    return nb::make_tuple(number, count_us);
}

static int32_t checked_port(int32_t port) {
    if (port < 0 || port >= BOARD_PORTS)
        throw std::invalid_argument("no such port");
    return port;
}

static bool deliver(Node &n, int64_t arrival_us, nb::bytes packet, int32_t port) {
    return board_deliver(&n->board, checked_port(port), arrival_us,
                         reinterpret_cast<const uint8_t *>(packet.c_str()), (int32_t)packet.size());
}

static std::vector<std::tuple<int64_t, nb::bytes>> collect(Node &n, int32_t port) {
    checked_port(port);
    std::vector<std::tuple<int64_t, nb::bytes>> packets;
    for (parcel &p : n->board.outbox) {
        if (p.size == 0 || p.port != port)
            continue;
        packets.emplace_back(p.time_us, nb::bytes((const char *)p.bytes, (size_t)p.size));
        p.size = 0;
    }
    return packets;
}

// Returns whether there is something to collect.
static bool poll(Node &n, int64_t true_us, int32_t encoder_count) {
    board_advance(&n->board, true_us);
    board_set_encoder(&n->board, encoder_count);
    node_run(n.operator->());
    for (const parcel &p : n->board.outbox)
        if (p.size != 0)
            return true;
    return false;
}

// Some nodes on their own, between what happens to them.
struct Polled {
    std::vector<Node> nodes;
    std::vector<polls> schedules;
};

static void add_polled(Polled &p, Node &n, uint32_t pause_us, uint64_t random) {
    polls schedule;
    if (n->device.settings.servo_period_us == 0)
        throw std::invalid_argument("a node needs settings to be polled");
    polls_begin(&schedule, &n->board.oscillator, n->device.settings.servo_period_us, pause_us,
                random);
    p.nodes.push_back(n);
    p.schedules.push_back(schedule);
}

// Polls all in the order of time, up to `until_us`, until one has something to send: returns which.
static std::optional<size_t> run_polled(Polled &p, int64_t until_us, nb::dict encoders) {
    while (!p.nodes.empty()) {
        size_t first = 0;
        for (size_t i = 1; i < p.nodes.size(); i++)
            if (polls_next_us(&p.schedules[i]) < polls_next_us(&p.schedules[first]))
                first = i;
        int64_t now_us = polls_next_us(&p.schedules[first]);
        if (now_us > until_us)
            break;
        Node &n = p.nodes[first];
        nb::int_ key(first);
        int32_t count = 0;
        if (encoders.size() > 0 && encoders.contains(key))
            count = nb::cast<int32_t>(encoders[key](now_us));
        polls_pass(&p.schedules[first]);
        if (poll(n, now_us, count))
            return first;
    }
    return std::nullopt;
}

// Position and torque setpoints [pq, pq/knot, tq]: at a system time from the device's own tracks
// while it executes them, else those of the last servo period.
static std::tuple<int32_t, int32_t, int32_t> setpoint(Node &n, int64_t time_us) {
    const struct setpoint &last = n->device.setpoint;
    if (n->device.state != DEVICE_RUNNING && n->device.state != DEVICE_COAST)
        return {last.position_pq, last.velocity_pq, last.torque_tq};
    int32_t shift = n->device.settings.knot_shift;
    const struct track *position = &n->device.tracks[TRACK_POSITION];
    const struct track *torque = &n->device.tracks[TRACK_TORQUE];
    instant at = instant_at(time_us, shift);
    return {track_value(position, &at), track_rate(position, &at), track_value(torque, &at)};
}

static int64_t system_us(Node &n, int64_t true_us) {
    return clock_at(&n->device.clock, board_count_at(&n->board, true_us));
}

static auto truth(Node &n, int64_t true_us, int64_t time_us) {
    const servo &s = n->device.servo;
    return std::tuple_cat(setpoint(n, time_us),
                          std::tuple(s.torque_tq, s.unclipped_tq, system_us(n, true_us) - time_us));
}

NB_MODULE(_board, m) {
    nb::module_::import_("headway.firmware._core"); // Python's type for the settings
    m.attr("RECORD_SETTINGS_A") = (int)RECORD_SETTINGS_A;
    m.attr("RECORD_BOOTS_A") = (int)RECORD_BOOTS_A;
    m.attr("RECORD_FAULTS_A") = (int)RECORD_FAULTS_A;
    m.attr("RECORD_MAX") = BOARD_RECORD_MAX;
    m.attr("NODE_NUMBERS") = (sizeof(node) + sizeof(double) - 1) / sizeof(double);
    m.attr("OSCILLATOR_PPB_MAX") = OSCILLATOR_PPB_MAX;
    nb::class_<oscillator>(m, "Oscillator")
        .def(
            "__init__",
            [](oscillator *o, int64_t offset, int32_t drift_ppb, int32_t wander_ppb_per_s,
               int32_t drift_bound_ppb, uint64_t seed) {
                new (o) oscillator(
                    new_oscillator(offset, drift_ppb, wander_ppb_per_s, drift_bound_ppb, seed));
            },
            "offset"_a = 0, "drift_ppb"_a = 0, "wander_ppb_per_s"_a = 0,
            "drift_bound_ppb"_a = OSCILLATOR_PPB_MAX, "seed"_a = 0)
        .def("count_at", &count_at, "true_us"_a)
        .def("counts", &counts_at, "true_us"_a)
        .def("step", &oscillator_step, "true_us"_a, "step_us"_a);
    nb::class_<Polled>(m, "Polled")
        .def(nb::init<>())
        .def("add", &add_polled, "node"_a, "pause_us"_a, "random"_a)
        .def("run", &run_polled, "until_us"_a, "encoders"_a);
    nb::class_<Node>(m, "Node")
        .def(
            "__init__",
            [](Node *n, State state) {
                if (state.shape(0) * sizeof(double) < sizeof(node))
                    throw std::invalid_argument("the array is too small for a node");
                new (n) Node{state};
            },
            "state"_a)
        .def("restart", &restart)
        .def("memory", &memory_of, "record"_a)
        .def("set_memory", &set_memory, "record"_a, "bytes"_a)
        .def("break_encoder", &break_encoder, "defect"_a, "since_us"_a)
        .def("flash", &flash, "settings"_a, "count_offset"_a = 0, "drift_ppb"_a = 0,
             "wander_ppb_per_s"_a = 0, "drift_bound_ppb"_a = OSCILLATOR_PPB_MAX,
             "oscillator_seed"_a = 0)
        .def("join_bus", &join_bus, "phase_ps"_a, "period_ps"_a, "seed"_a = 0)
        .def_prop_ro("sof", &frame_start)
        .def(
            "step_clock",
            [](Node &n, int32_t step_us) {
                oscillator_step(&n->board.oscillator, n->board.true_us, step_us);
            },
            "step_us"_a)
        .def("deliver", &deliver, "arrival_us"_a, "packet"_a, "port"_a = BOARD_HOST)
        .def("collect", &collect, "port"_a = BOARD_HOST)
        .def("setpoint", &setpoint, "time_us"_a)
        .def("poll", &poll, "true_us"_a, "encoder_count"_a)
        .def_prop_ro("state", [](Node &n) { return (int)n->device.state; })
        .def_prop_ro("boots", [](Node &n) { return n->device.boots; })
        .def_prop_ro("session",
                     [](Node &n) -> nb::object {
                         if (!n->device.session.begun)
                             return nb::none();
                         return nb::int_(n->device.session.number);
                     })
        .def_prop_ro("received", [](Node &n) { return n->device.session.received; })
        .def_prop_ro("settings", [](Node &n) { return n->device.settings; })
        .def_prop_ro("synced", [](Node &n) { return n->device.sync.settled; })
        .def_prop_ro("lineage", [](Node &n) { return n->device.sync.lineage; })
        .def_prop_ro("excluded", [](Node &n) { return n->device.sync.excluded; })
        .def_prop_ro("error_ns",
                     [](Node &n) {
                         const struct sync &s = n->device.sync;
                         return std::make_tuple(s.least_error_ns, s.most_error_ns);
                     })
        .def_prop_ro("true_us", [](Node &n) { return n->board.true_us; })
        .def_prop_ro("duty_q15", [](Node &n) { return n->board.duty_q15; })
        .def(
            "steps",
            [](Node &n, int64_t true_us) {
                return board_steps(&n->board, board_count_at(&n->board, true_us));
            },
            "true_us"_a)
        .def_prop_ro("trains",
                     [](Node &n) {
                         const struct stepping &s = n->board.stepping;
                         std::vector<std::tuple<uint32_t, int32_t, uint32_t, uint32_t>> found;
                         for (uint32_t i = s.trains > BOARD_TRAINS ? s.trains - BOARD_TRAINS : 0;
                              i < s.trains; i++) {
                             const pulse_train &t = s.ring[i % BOARD_TRAINS];
                             found.emplace_back(t.count_us, t.steps, t.first_q16, t.spacing_q16);
                         }
                         return found;
                     })
        .def_prop_ro("brake", [](Node &n) { return n->board.brake != 0; })
        .def_prop_ro("power", [](Node &n) { return n->board.power != 0; })
        .def_prop_ro("tripped", [](Node &n) { return n->device.guard.verdict != GUARD_LETS; })
        .def_prop_ro("chopper", [](Node &n) { return n->board.chopper != 0; })
        .def_prop_rw(
            "stop_line", [](Node &n) { return n->board.stop_line != 0; },
            [](Node &n, bool value) { n->board.stop_line = value; })
        .def_prop_rw(
            "hung", [](Node &n) { return n->board.hung != 0; },
            [](Node &n, bool value) { n->board.hung = value; })
        .def_prop_rw(
            "supply_V", [](Node &n) { return n->board.supply_V; },
            [](Node &n, double value) { n->board.supply_V = value; })
        .def_prop_rw(
            "feed_V", [](Node &n) { return n->board.feed_V; },
            [](Node &n, double value) { n->board.feed_V = value; })
        .def_prop_rw(
            "capacitance_F", [](Node &n) { return n->board.capacitance_F; },
            [](Node &n, double value) { n->board.capacitance_F = value; })
        .def_prop_rw(
            "encoder_offset", [](Node &n) { return n->board.encoder_offset; },
            [](Node &n, int32_t value) { n->board.encoder_offset = value; })
        .def_prop_rw(
            "index_every", [](Node &n) { return n->board.index_every; },
            [](Node &n, int32_t value) { n->board.index_every = value; })
        .def_prop_rw(
            "index_at", [](Node &n) { return n->board.index_at; },
            [](Node &n, int32_t value) { n->board.index_at = value; })
        .def_prop_rw(
            "switch_from", [](Node &n) { return n->board.switch_from; },
            [](Node &n, int32_t value) { n->board.switch_from = value; })
        .def_prop_rw(
            "switch_to", [](Node &n) { return n->board.switch_to; },
            [](Node &n, int32_t value) { n->board.switch_to = value; })
        .def_prop_rw(
            "switch_every", [](Node &n) { return n->board.switch_every; },
            [](Node &n, int32_t value) { n->board.switch_every = value; })
        .def_prop_rw(
            "random", [](Node &n) { return n->board.random; },
            [](Node &n, uint64_t value) { n->board.random = value; })
        .def_prop_rw(
            "digital_in", [](Node &n) { return (int)n->board.digital_in; },
            [](Node &n, uint8_t value) { n->board.digital_in = value; })
        .def_prop_ro("pwm_q15",
                     [](Node &n) {
                         return std::vector<int32_t>(n->board.pwm_q15,
                                                     n->board.pwm_q15 + BOARD_PWM);
                     })
        .def_prop_ro("flips",
                     [](Node &n) {
                         std::vector<std::tuple<int64_t, int32_t, bool>> found;
                         uint32_t all = n->board.flips;
                         for (uint32_t i = all > BOARD_FLIPS ? all - BOARD_FLIPS : 0; i < all;
                              i++) {
                             const flip &f = n->board.flip[i % BOARD_FLIPS];
                             if (f.output != FLIP_FORGOTTEN)
                                 found.emplace_back(f.time_us, f.output, f.on != 0);
                         }
                         return found;
                     })
        .def(
            "flips_from",
            [](Node &n, uint32_t number) {
                std::vector<std::tuple<int64_t, int32_t, bool>> found;
                if (n->board.flips - number > BOARD_FLIPS)
                    throw std::invalid_argument("more changes than the board remembers");
                for (uint32_t i = number; i != n->board.flips; i++) {
                    const flip &f = n->board.flip[i % BOARD_FLIPS];
                    found.emplace_back(f.time_us, f.output, f.on != 0);
                }
                return found;
            },
            "number"_a)
        .def_prop_ro("dropped", [](Node &n) { return n->board.dropped; })
        .def_prop_ro("torque_tq", [](Node &n) { return n->device.servo.torque_tq; })
        .def_prop_ro("unclipped_tq", [](Node &n) { return n->device.servo.unclipped_tq; })
        .def_prop_ro("status", [](Node &n) { return n->device.status; })
        .def("system_us", &system_us, "true_us"_a)
        .def("truth", &truth, "true_us"_a, "time_us"_a);
}
