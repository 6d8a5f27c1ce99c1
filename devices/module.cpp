// Tracks and encoders as the host has them, for Python.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/bind_vector.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "course.hpp"
#include "holding.hpp"
#include "odometer.hpp"
#include "sample.hpp"
#include "unwrap.hpp"

extern "C" {
#include "frame.h"
#include "gate.h"
#include "stamps.h"
}

NB_MAKE_OPAQUE(Samples) // a list of Python's would be made of them

namespace nb = nanobind;
using namespace nb::literals;

using Points = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const int32_t, nb::ndim<2>, nb::device::cpu>; // each in one piece
using Plans = nb::ndarray<const int32_t, nb::ndim<3>, nb::device::cpu>;
using Instants = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Columns = nb::ndarray<double, nb::ndim<2>, nb::f_contig, nb::device::cpu>;
using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

static auto array(std::vector<double> &&values, std::initializer_list<size_t> shape) {
    auto *owned = new std::vector<double>(std::move(values));
    nb::capsule owner(owned,
                      [](void *p) noexcept { delete static_cast<std::vector<double> *>(p); });
    return nb::ndarray<nb::numpy, double>(owned->data(), shape, owner);
}

static auto unwrap(Points values, double near) {
    size_t n = values.shape(0);
    std::vector<double> ways;
    ways.reserve(n);
    Unwrap unwrap(n ? values.data()[0] : 0, near);
    for (size_t i = 0; i < n; i++)
        ways.push_back(unwrap(values.data()[i]));
    return array(std::move(ways), {n});
}

using Stamps = std::tuple<uint32_t, int64_t, int64_t>;
using Mark = std::tuple<uint16_t, uint16_t, int64_t>; // number, width, least

template <typename Array> static void in_pieces(const Array &rows) {
    if (rows.stride(rows.ndim() - 1) != 1)
        throw std::invalid_argument("each row of points is to be in one piece");
}

static nb::bytes send(Holding &holding, Stamps stamps_us, Mark m, uint32_t number, uint16_t epoch,
                      int64_t first_knot, Rows points) {
    Sent sent{std::get<2>(stamps_us), {}};
    plan &p = sent.plan;
    const size_t sinks = points.shape(0), count = points.shape(1);
    if (sinks > TRACK_COUNT || count < 3 || count > PLAN_POINTS_MAX)
        throw std::invalid_argument("a plan has known sinks, all with the same 3 .. 128 points");
    in_pieces(points);
    p.number = number, p.epoch = epoch, p.first_knot = first_knot;
    p.tracks = (uint8_t)((1 << sinks) - 1), p.count = (uint8_t)count;
    for (size_t sink = 0; sink < sinks; ++sink)
        std::copy_n(&points(sink, 0), count, p.points[sink]);
    stamps told{std::get<0>(stamps_us),
                std::get<1>(stamps_us),
                std::get<2>(stamps_us),
                {std::get<0>(m), std::get<1>(m), std::get<2>(m)}};
    uint8_t payload[FRAME_PAYLOAD_MAX];
    int32_t size = plan_encode(&told, &p, payload, FRAME_PAYLOAD_MAX);
    if (size < 0)
        throw std::invalid_argument("the plan does not fit a frame");
    holding.send(sent);
    return nb::bytes((const char *)payload, (size_t)size);
}

static void bind_holding(nb::module_ &m) {
    nb::class_<Holding>(m, "Holding", "The tracks that a device holds.")
        .def(nb::init<>())
        .def("forget", &Holding::forget, "A new epoch: the device drops its tracks.")
        .def(
            "send", &send, "stamps_us"_a, "mark"_a, "number"_a, "epoch"_a, "first_knot"_a,
            "points"_a.noconvert(),
            "The payload of a plan, a row of points a sink, which from now on is under way. Raises "
            "ValueError for points that a frame cannot carry.")
        .def("settle", &Holding::settle, "status"_a, "patience_us"_a,
             "Settles those plans that a status has an answer for; one without an answer after "
             "`patience_us` counts as lost.")
        .def(
            "track",
            [](const Holding &holding, int sink) {
                if (sink < 0 || sink >= TRACK_COUNT)
                    throw std::invalid_argument("no such sink");
                return &holding.presumed(sink);
            },
            "sink"_a, nb::rv_policy::reference_internal,
            "The track as it will be once what is under way has arrived: always the same object.")
        .def_prop_ro("waiting_since_us", &Holding::waiting_since_us,
                     "When the first of the plans under way was sent; far in the future if there "
                     "is none.");
}

// The gate of several tracks.
struct Gate {
    std::vector<nb::object> kept;
    std::vector<const gate_limits *> limits;
    std::vector<const track *> stored;
};

static std::optional<std::pair<size_t, int>> refusal(const Gate &gate, int64_t first_knot,
                                                     Plans points, int64_t knot) {
    const size_t sinks = points.shape(1), count = points.shape(2);
    if (points.shape(0) * sinks != gate.stored.size())
        throw std::invalid_argument("not as many rows of points as tracks");
    if (count < 3 || count > PLAN_POINTS_MAX)
        throw std::invalid_argument("a plan has 3 .. 128 points");
    in_pieces(points);
    for (size_t i = 0; i < gate.stored.size(); i++) {
        int result = gate_check_track(gate.limits[i], gate.stored[i], first_knot,
                                      &points(i / sinks, i % sinks, 0), (int32_t)count, knot);
        if (result != GATE_ACCEPTED)
            return std::pair{i, result};
    }
    return std::nullopt;
}

static void bind_gate(nb::module_ &m) {
    nb::class_<Gate>(m, "Gate", "The gate, as on the devices, of several tracks.")
        .def(
            "__init__",
            [](Gate *self, const std::vector<nb::object> &limits,
               const std::vector<nb::object> &stored) {
                if (limits.size() != stored.size())
                    throw std::invalid_argument("not as many limits as tracks");
                new (self) Gate{limits, {}, {}};
                for (const nb::object &each : limits)
                    self->limits.push_back(nb::cast<const gate_limits *>(each));
                for (const nb::object &each : stored)
                    self->stored.push_back(nb::cast<const track *>(each));
                self->kept.insert(self->kept.end(), stored.begin(), stored.end());
            },
            "limits"_a, "stored"_a)
        .def("refusal", &refusal, "first_knot"_a, "points"_a.noconvert(), "knot"_a,
             "Of points from a knot on (devices, sinks, m), a row a track, at a knot: the first "
             "row that it would not take, and why, as in firmware/gate.h; None if it takes all.");
}

// A course with the tracks that it reads.
struct Kept : Course {
    Kept(Course course, std::vector<nb::object> tracks)
        : Course(std::move(course)), tracks(std::move(tracks)) {}
    std::vector<nb::object> tracks;
};

static void append(std::vector<nb::object> &kept, const std::vector<nb::object> &more) {
    kept.insert(kept.end(), more.begin(), more.end());
}

static void bind_course(nb::module_ &m) {
    using Tracks = std::vector<nb::object>;
    nb::class_<Along>(m, "Along", "What devices execute, as a function of system time.")
        .def(
            "at",
            [](const Along &course, Instants times_us, Vector near) {
                size_t count = times_us.shape(0);
                if (count == 0 || 5 * near.size() != course.width())
                    throw std::invalid_argument("no times, or another number of axes");
                std::vector<double> rows(count * course.width());
                course.at(times_us.data(), count, near.data(), rows.data());
                return array(std::move(rows), {count, course.width()});
            },
            "times_us"_a, "near"_a,
            "Rows (m, 5n) at system times (m,), close together. near (n,): where the axes are at "
            "the first of them, give or take some turns.");
    nb::class_<Kept, Along>(m, "Course",
                            "What the devices execute, as far as the host knows, in SI.")
        .def(
            "__init__",
            [](Kept *self, const std::vector<size_t> &axes, Tracks position, Tracks torque,
               const std::vector<double> &pq_per_unit, const std::vector<double> &tq_per_effort,
               const std::vector<bool> &continuous, int32_t knot_shift, std::vector<double> still,
               Tracks kp, Tracks kd, const std::vector<double> &kp_per_mantissa,
               const std::vector<double> &kd_per_mantissa, const std::vector<double> &emf) {
                size_t w = axes.size(), gains = kp.size();
                if (position.size() != w || torque.size() != w || pq_per_unit.size() != w ||
                    tq_per_effort.size() != w || continuous.size() != w || still.size() % 5)
                    throw std::invalid_argument("not as many tracks and quanta as axes");
                if ((gains != 0 && gains != w) || kd.size() != gains ||
                    kp_per_mantissa.size() != gains || kd_per_mantissa.size() != gains ||
                    emf.size() != gains)
                    throw std::invalid_argument("not as many gains as axes");
                std::vector<Driven> driven;
                for (size_t i = 0; i < w; ++i) {
                    if (axes[i] >= still.size() / 5)
                        throw std::invalid_argument("no such axis");
                    driven.push_back({axes[i], nb::cast<const track *>(position[i]),
                                      nb::cast<const track *>(torque[i]), pq_per_unit[i],
                                      tq_per_effort[i], continuous[i]});
                    if (gains) {
                        Driven &d = driven.back();
                        d.kp = nb::cast<const track *>(kp[i]);
                        d.kd = nb::cast<const track *>(kd[i]);
                        d.kp_per_mantissa = kp_per_mantissa[i];
                        d.kd_per_mantissa = kd_per_mantissa[i];
                        d.emf = emf[i];
                    }
                }
                for (const Tracks &more : {torque, kp, kd})
                    append(position, more);
                new (self) Kept({driven, knot_shift, std::move(still)}, std::move(position));
            },
            "axes"_a, "position"_a, "torque"_a, "pq_per_unit"_a, "tq_per_effort"_a, "continuous"_a,
            "knot_shift"_a, "still"_a, "kp"_a, "kd"_a, "kp_per_mantissa"_a, "kd_per_mantissa"_a,
            "emf"_a,
            "axes: those with a motor; the next five lists are of these. still: a row [r, r', f, "
            "Kp, Kd + c] (5n), of which `at` replaces what tracks tell. The last five lists are of "
            "gain tracks, or empty.")
        .def(
            "points",
            [](const Kept &course, int64_t first_knot, Vector near, Columns position,
               Columns torque) {
                size_t count = position.shape(1);
                if (near.size() != course.axes() || position.shape(0) != course.moved() ||
                    torque.shape(0) != course.moved() || torque.shape(1) != count)
                    throw std::invalid_argument("points of another number of axes");
                course.points(first_knot, count, near.data(), position.data(), torque.data());
            },
            "first_knot"_a, "near"_a, "position"_a.noconvert(), "torque"_a.noconvert(),
            "Control points from a knot on, a row a driven axis, into arrays in Fortran order. "
            "near (n,): as in `at`.");
}

static void bind_samples(nb::module_ &m) {
    nb::class_<Sample>(m, "Sample", "One encoder reading.")
        .def(
            "__init__",
            [](Sample *self, int64_t time_us, int64_t axis, double position) {
                new (self) Sample{time_us, axis, position};
            },
            "time_us"_a, "axis"_a, "position"_a)
        .def_ro("time_us", &Sample::time_us, "System time.")
        .def_ro("axis", &Sample::axis)
        .def_ro("position", &Sample::position, "[rad or m]");
    nb::bind_vector<Samples>(m, "Samples", "A list of them.");
    nb::class_<Odometer>(m, "Odometer", "Follows one encoder beyond 32 bits.")
        .def(nb::init<int64_t, double>(), "axis"_a, "unit_per_count"_a)
        .def("read", &Odometer::read, "status"_a, "samples"_a, "Appends a status' samples.");
}

NB_MODULE(_tracks, m) {
    nb::module_::import_("headway.firmware._core"); // knows tracks and statuses
    m.doc() = "Tracks and encoders as the host has them.";
    m.def("unwrap", &unwrap, "values"_a, "near"_a,
          "Values modulo 2^32, each less than half of that from the one before, without bounds; of "
          "all that the first may stand for the one next to `near`.");
    bind_holding(m);
    bind_gate(m);
    bind_course(m);
    bind_samples(m);
}
