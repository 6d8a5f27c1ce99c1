// What a tick computes, for Python: no argument is looked at in a call, and the GIL is released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "along.hpp"
#include "filter.hpp"
#include "hpipm.hpp"
#include "osqp.hpp"
#include "riccati.hpp"
#include "sample.hpp"
#include "tick.hpp"

NB_MAKE_OPAQUE(Samples) // as in devices/module.cpp

namespace nb = nanobind;
using namespace nb::literals;
using free_gil = nb::call_guard<nb::gil_scoped_release>;

// A function of Python's in a solver's place: () -> (variables, Answer). Tests have such.
struct Stranger : Solver {
    Stranger(int size, nb::callable answer) : size_((size_t)size), answer_(std::move(answer)) {}
    bool update() override { return true; }
    Answer solve(double *z) override {
        nb::gil_scoped_acquire gil;
        auto [values, answer] = nb::cast<std::pair<Numbers, Answer>>(answer_());
        if (values.size() != size_)
            throw std::invalid_argument("the variables are of another size");
        std::copy_n(values.data(), size_, z);
        return answer;
    }

  private:
    size_t size_;
    nb::callable answer_;
};

using Table = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const double, nb::ndim<2>, nb::device::cpu>;
using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Square = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

template <typename T> static auto array(std::vector<T> &&values, size_t rows, size_t columns) {
    auto *owned = new std::vector<T>(std::move(values));
    nb::capsule owner(owned, [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return nb::ndarray<nb::numpy, T, nb::ndim<2>>(owned->data(), {rows, columns}, owner);
}

template <typename T> static auto vector(std::vector<T> &&values) {
    auto *owned = new std::vector<T>(std::move(values));
    nb::capsule owner(owned, [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return nb::ndarray<nb::numpy, T, nb::ndim<1>>(owned->data(), {owned->size()}, owner);
}

// Steps through times, and the tracks at their starts, middles and ends.
struct Way {
    // `tracks`: what knows the tracks without Python, or has a method `at` as that has.
    Way(const Filter &filter, std::vector<int64_t> through_us, const double *near,
        nb::object tracks)
        : width(filter.track_rows()), times_us(std::move(through_us)),
          rows(times_us.size() * width) {
        const Along *along;
        if (!nb::try_cast(tracks, along))
            ask(filter, near, tracks);
        else if (along->width() == width)
            along->at(times_us.data(), times_us.size(), near, rows.data());
        else
            throw std::invalid_argument("tracks of another size than the steps");
    }
    Steps steps() const { return {times_us.size() / 3, times_us.data(), rows.data()}; }
    std::vector<double> last() const { return {rows.end() - (std::ptrdiff_t)width, rows.end()}; }

  private:
    void ask(const Filter &filter, const double *near, const nb::object &tracks) {
        auto begin = vector(std::vector<double>(near, near + filter.axes()));
        auto times = vector(std::vector<int64_t>(times_us));
        auto table = nb::cast<Table>(tracks.attr("at")(times, begin));
        if (table.shape(0) != times_us.size() || table.shape(1) != width)
            throw std::invalid_argument("tracks of another size than the steps");
        std::copy_n(table.data(), rows.size(), rows.data());
    }

    size_t width;
    std::vector<int64_t> times_us;
    std::vector<double> rows;
};

static nb::tuple told(std::vector<double> &&z, std::vector<double> &&covariance, const Way &way) {
    size_t n = z.size();
    return nb::make_tuple(vector(std::move(z)), array(std::move(covariance), n, n),
                          vector(way.last()));
}

static void check(const Filter &filter, const Vector &z, const Square &covariance) {
    size_t n = 3 * filter.axes();
    if (z.size() != n || covariance.shape(0) != n || covariance.shape(1) != n)
        throw std::invalid_argument("a state of another size than the filter's");
}

// Takes in the samples up to now, and out of the list.
static void take(Filter &filter, Samples &samples, int64_t now_us) {
    for (const Sample &each : samples)
        if (each.axis < 0 || each.axis >= (int64_t)filter.axes())
            throw std::invalid_argument("a sample of an axis that there is not");
    auto early = std::stable_partition(samples.begin(), samples.end(),
                                       [=](const Sample &each) { return each.time_us <= now_us; });
    filter.statistics.taken += (int64_t)filter.history.insert({samples.begin(), early});
    samples.erase(samples.begin(), early);
}

static nb::tuple update(Filter &filter, Samples &samples, int64_t now_us,
                        const nb::object &tracks) {
    take(filter, samples, now_us);
    const double *begin = filter.history.z(filter.history.filled() - 1);
    Way way(filter, steps_through(filter.times_to(now_us), filter.step_us), begin, tracks);
    size_t n = 3 * filter.axes();
    std::vector<double> z(n), covariance(n * n);
    filter.update(z.data(), covariance.data(), way.steps());
    return told(std::move(z), std::move(covariance), way);
}

static nb::tuple predict(Filter &filter, const Vector &z, const Square &covariance,
                         const std::vector<int64_t> &times_us, const nb::object &tracks) {
    check(filter, z, covariance);
    Way way(filter, steps_through(times_us, filter.step_us), z.data(), tracks);
    std::vector<double> state(z.data(), z.data() + z.size());
    std::vector<double> spread(covariance.data(), covariance.data() + covariance.size());
    filter.predict(state.data(), spread.data(), way.steps());
    return told(std::move(state), std::move(spread), way);
}

static nb::tuple step(Filter &filter, const Vector &z, const Table &tracks, double dt_s) {
    const size_t n = filter.axes();
    if (z.size() != 3 * n || tracks.shape(0) != 3 || tracks.shape(1) != filter.track_rows())
        throw std::invalid_argument("a state or tracks of another size than the filter's");
    std::vector<double> after(2 * n), by_columns(6 * n * n), jacobian;
    filter.step(z.data(), tracks.data(), dt_s, after.data(), by_columns.data());
    for (size_t i = 0; i < 2 * n; ++i)
        for (size_t j = 0; j < 3 * n; ++j)
            jacobian.push_back(by_columns[i + 2 * n * j]);
    return nb::make_tuple(vector(std::move(after)), array(std::move(jacobian), 2 * n, 3 * n));
}

static bool all_finite(const Rows &rows) {
    for (size_t i = 0; i < rows.shape(0); ++i)
        for (size_t j = 0; j < rows.shape(1); ++j)
            if (!std::isfinite(rows(i, j)))
                return false;
    return true;
}

static void bind_filter(nb::module_ &m) {
    nb::class_<Filter>(m, "Filter", "An extended Kalman filter over z = [q, v, d].")
        .def(
            "__init__",
            [](Filter *self, Bound &rate, Bound &slope, Array acceleration, Array walk,
               Array reading, Array start, double nis_max, int64_t in_a_row, size_t rows,
               int64_t bundle_us, int64_t step_us) {
                if (bundle_us < 1 || step_us < 1)
                    throw std::invalid_argument("bundles or steps of no length");
                new (self) Filter(rate, slope, {acceleration, walk, reading, start},
                                  {nis_max, in_a_row}, rows, bundle_us, step_us);
            },
            "rate"_a, "slope"_a, "acceleration"_a, "walk"_a, "reading"_a, "start"_a, "nis_max"_a,
            "in_a_row"_a, "rows"_a, "bundle_us"_a, "step_us"_a, nb::keep_alive<1, 2>(),
            nb::keep_alive<1, 3>(),
            "rows: room for so many samples at first; bundle_us, step_us: the longest bundle and "
            "step. Raises ValueError for arrays of other sizes than the slope's, and for a rate "
            "that "
            "does not share them.")
        .def(
            "reset",
            [](Filter &filter, int64_t time_us, const Vector &z, const Square &covariance) {
                check(filter, z, covariance);
                filter.history.restart(time_us, z.data(), covariance.data());
            },
            "time_us"_a, "z"_a, "covariance"_a, "Forgets all samples.")
        .def("update", &update, "samples"_a, "now_us"_a, "tracks"_a,
             "Takes the samples up to now in, but for known ones and those older than all that is "
             "remembered, with those that were taken in before and are later than a new one; and "
             "out "
             "of the list. Returns z and its covariance then, and "
             "the tracks there. Raises ValueError for tracks of another size and samples of no "
             "axis.")
        .def("predict", &predict, "z"_a, "covariance"_a, "times_us"_a, "tracks"_a,
             "The two carried through times, and the tracks there. Raises ValueError for other "
             "sizes.")
        .def("step", &step, "z"_a, "tracks"_a, "dt_s"_a,
             "One step by itself, through tracks (3, 5n) at its start, middle and end: x after it "
             "(2n,) and its Jacobian in z (2n, 3n). Raises ValueError for other sizes.")
        .def("forget", &Filter::forget, "before_us"_a,
             "Forgets the samples before the last one that is older than a time: they enter the "
             "statistics.")
        .def_prop_ro("taken", [](const Filter &f) { return f.statistics.taken; })
        .def_prop_ro("accepted", [](const Filter &f) { return f.statistics.accepted; })
        .def_prop_ro("outliers", [](const Filter &f) { return f.statistics.outliers; })
        .def_prop_ro("nis_sum", [](const Filter &f) { return f.statistics.nis_sum; });
}

NB_MODULE(_tick, m) {
    nb::module_::import_("headway.models._generated"); // knows Bound
    nb::module_::import_("headway.devices._tracks");   // knows Along
    m.doc() = "What a tick computes: generated functions and a QP solver, in one call.";
    nb::class_<Answer>(m, "Answer", "What a solver says of its answer.")
        .def(
            "__init__",
            [](Answer *self, int status, int iterations, bool good) {
                new (self) Answer{status, iterations, good};
            },
            "status"_a, "iterations"_a, "good"_a);
    nb::class_<Solver>(m, "Solver", "A QP solver on arrays that others fill.")
        .def("update", &Solver::update, free_gil(), "Takes new matrices; False if it cannot.")
        .def(
            "solve", [](Solver &solver, Numbers z) { return solver.solve(z.data()); }, "z"_a,
            "Solves for new vectors, into z.");
    nb::class_<Stranger, Solver>(m, "Stranger", "A function in a solver's place.")
        .def(nb::init<int, nb::callable>(), "size"_a, "answer"_a,
             "size: of the variables; answer: () -> (variables, Answer).");
    nb::class_<Osqp, Solver>(m, "Osqp").def(
        "__init__",
        [](Osqp *self, Numbers p, Indices pi, Indices pp, bool p_changes, Numbers q, Numbers a,
           Indices ai, Indices ap, Numbers l, Numbers u, Numbers scale, int max_iterations,
           double tolerance) {
            new (self) Osqp({p, pi, pp}, p_changes, q, {a, ai, ap}, l, u, scale, max_iterations,
                            tolerance);
        },
        "hessian"_a, "hessian_indices"_a, "hessian_indptr"_a, "hessian_changes"_a, "gradient"_a,
        "constraints"_a, "constraints_indices"_a, "constraints_indptr"_a, "lower"_a, "upper"_a,
        "scale"_a, "max_iterations"_a, "tolerance"_a,
        "The Hessian's upper half and the constraints by columns. Raises ValueError for data "
        "that OSQP refuses.");
    nb::class_<Stages>(m, "Stages", "A problem by stages, in arrays that others fill.")
        .def(
            "__init__",
            [](Stages *self, std::vector<std::array<double, 3>> cubic, std::vector<int> driven,
               std::vector<int> bounded, Matrix a, Matrix b0, Matrix b1, Matrix gradient,
               Matrix lower, Matrix upper, Matrix column_scale, Matrix row_scale, Matrix state,
               Matrix torque, Matrix step, Matrix curvature, Matrix kept, Matrix kept_slope,
               Matrix approach_s, Matrix soft) {
                int axes = (int)approach_s.size(), intervals = (int)step.shape(1);
                new (self)
                    Stages{axes,   intervals, cubic,     driven, bounded,      a,          b0,
                           b1,     gradient,  lower,     upper,  column_scale, row_scale,  state,
                           torque, step,      curvature, kept,   kept_slope,   approach_s, soft};
            },
            "cubic"_a, "driven"_a, "bounded"_a, "a"_a, "b0"_a, "b1"_a, "gradient"_a, "lower"_a,
            "upper"_a, "column_scale"_a, "row_scale"_a, "state"_a, "torque"_a, "step"_a,
            "curvature"_a, "kept"_a, "kept_slope"_a, "approach_s"_a, "soft"_a,
            "Arrays in Fortran order, see stages.hpp; `driven`: the axes with a motor; `bounded`: "
            "those with soft limits.");
    nb::class_<Hpipm, Solver>(m, "Hpipm")
        .def(nb::init<Stages, int, double>(), "stages"_a, "max_iterations"_a, "tolerance"_a);
    nb::class_<Riccati, Solver>(m, "Riccati")
        .def(nb::init<std::string, Stages, int, double>(), "library"_a, "stages"_a,
             "max_iterations"_a, "tolerance"_a,
             "library: riccati.c, compiled for the machine and its horizon. Raises RuntimeError if "
             "it is something else.");
    nb::class_<Feedback>(m, "Feedback", "What became of a tick's problem.")
        .def_prop_ro("status", [](const Feedback &f) { return f.answer.status; })
        .def_prop_ro("iterations", [](const Feedback &f) { return f.answer.iterations; })
        .def_prop_ro("stationarity", [](const Feedback &f) { return f.answer.stationarity; })
        .def_prop_ro("complementarity", [](const Feedback &f) { return f.answer.complementarity; })
        .def_ro("residual", &Feedback::residual)
        .def_ro("accepted", &Feedback::accepted)
        .def_ro("solve_us", &Feedback::solve_us);
    nb::class_<Encoding>(m, "Encoding", "From a motion to tracks, and to what servos make of them.")
        .def(
            "__init__",
            [](Encoding *self, Bound &encode, Bound &rollout, Bound &relieve, Array relief,
               Array next,
               Array over) { new (self) Encoding{encode, rollout, relieve, relief, next, over}; },
            "encode"_a, "rollout"_a, "relieve"_a, "relief"_a, "next"_a, "over"_a,
            nb::keep_alive<1, 2>(), nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>())
        .def("run", &Encoding::run, free_gil());
    nb::class_<Tick>(m, "Tick", "A problem's way from an estimate to tracks.")
        .def(
            "__init__",
            [](Tick *self, std::vector<Bound *> before, Solver &solver, Bound &vectors, Array z,
               Bound &judge, Array residual, Encoding *encoding, int sqp_iterations,
               std::vector<int> driven, Array scale, Array x, Array u, Array assumed, Array around,
               Array d) {
                size_t torques = u.size() / d.size() * driven.size();
                if (scale.size() < x.size() + torques || z.size() < scale.size() ||
                    around.size() != u.size() || assumed.size() != d.size())
                    throw std::invalid_argument("a guess of another size than the variables");
                new (self)
                    Tick{before,   solver,
                         vectors,  z,
                         judge,    residual,
                         encoding, {sqp_iterations, driven, scale, x, u, assumed, around, d}};
            },
            "before"_a, "solver"_a, "vectors"_a, "z"_a, "judge"_a, "residual"_a,
            "encoding"_a.none(), "sqp_iterations"_a, "driven"_a, "scale"_a, "x"_a, "u"_a,
            "assumed"_a, "around"_a, "d"_a, nb::keep_alive<1, 2>(), nb::keep_alive<1, 3>(),
            nb::keep_alive<1, 4>(), nb::keep_alive<1, 6>(), nb::keep_alive<1, 8>())
        .def("prepare", &Tick::prepare, free_gil(),
             "Runs `before`, then has the solver take the matrices.")
        .def("feedback", &Tick::feedback, free_gil());
    bind_filter(m);
    m.def("finite", &all_finite, "rows"_a,
          "Whether all of them (m, n) are: numpy takes six times as long.");
}
