// A simulated node (device and board) inside MuJoCo's plugin state, for Python.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <stdexcept>
#include <tuple>
#include <vector>

extern "C" {
#include "board.h"
}

namespace nb = nanobind;
using namespace nb::literals;

using State = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// Refers to the array and keeps it alive.
struct Node {
    State state;
    node *operator->() const { return reinterpret_cast<node *>(state.data()); }
};

static void flash(Node &n, const device_settings &settings, int64_t count_offset, int32_t drift) {
    if (settings.knot_shift < 9 || settings.knot_shift > 15 || settings.servo_period_us == 0 ||
        settings.sample_every == 0)
        throw std::invalid_argument("a device needs a knot shift of 9 .. 15 and periods above 0");
    n->board.count_offset = count_offset;
    n->board.drift_ppb = drift;
    device_init(&n->device, &settings, board_count_at(&n->board, n->board.true_us));
}

static bool deliver(Node &n, int64_t arrival_us, nb::bytes packet) {
    return board_deliver(&n->board, arrival_us, reinterpret_cast<const uint8_t *>(packet.c_str()),
                         (int32_t)packet.size());
}

static std::vector<std::tuple<int64_t, nb::bytes>> collect(Node &n) {
    std::vector<std::tuple<int64_t, nb::bytes>> packets;
    for (parcel &p : n->board.outbox) {
        if (p.size > 0)
            packets.emplace_back(p.time_us, nb::bytes((const char *)p.bytes, (size_t)p.size));
        p.size = 0;
    }
    return packets;
}

// Position and torque setpoints [pq, pq/knot, tq] at a system time, from the device's own tracks.
static std::tuple<int32_t, int32_t, int32_t> setpoint(Node &n, int64_t time_us) {
    int32_t shift = n->device.settings.knot_shift;
    track_value position = track_evaluate(&n->device.tracks[TRACK_POSITION], time_us, shift);
    track_value torque = track_evaluate(&n->device.tracks[TRACK_TORQUE], time_us, shift);
    return {position.value, position.rate, torque.value};
}

NB_MODULE(_board, m) {
    nb::module_::import_("headway.firmware._core"); // Python's type for the settings
    m.attr("NODE_NUMBERS") = (sizeof(node) + sizeof(double) - 1) / sizeof(double);
    nb::class_<Node>(m, "Node")
        .def(
            "__init__",
            [](Node *n, State state) {
                if (state.shape(0) * sizeof(double) < sizeof(node))
                    throw std::invalid_argument("the array is too small for a node");
                new (n) Node{state};
            },
            "state"_a)
        .def("flash", &flash, "settings"_a, "count_offset"_a = 0, "drift_ppb"_a = 0)
        .def("deliver", &deliver, "arrival_us"_a, "packet"_a)
        .def("collect", &collect)
        .def("setpoint", &setpoint, "time_us"_a)
        .def(
            "poll",
            [](Node &n, int64_t true_us, int32_t encoder_count) {
                n->board.true_us = true_us;
                n->board.encoder_count = encoder_count;
                device_poll(&n->device, &n->board);
            },
            "true_us"_a, "encoder_count"_a)
        .def_prop_ro("state", [](Node &n) { return (int)n->device.state; })
        .def_prop_ro("synced", [](Node &n) { return n->device.clock.synced; })
        .def_prop_ro("true_us", [](Node &n) { return n->board.true_us; })
        .def_prop_ro("duty_q15", [](Node &n) { return n->board.duty_q15; })
        .def_prop_ro("brake", [](Node &n) { return n->board.brake != 0; })
        .def_prop_ro("dropped", [](Node &n) { return n->board.dropped; })
        .def_prop_ro("torque_tq", [](Node &n) { return n->device.servo.torque_tq; })
        .def_prop_ro("unclipped_tq", [](Node &n) { return n->device.servo.unclipped_tq; })
        .def_prop_ro("status", [](Node &n) { return n->device.status; })
        .def(
            "system_us",
            [](Node &n, int64_t true_us) {
                return clock_at(&n->device.clock, board_count_at(&n->board, true_us));
            },
            "true_us"_a);
}
