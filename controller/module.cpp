// What a tick computes, for Python: no argument is looked at in a call, and the GIL is released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <stdexcept>

#include "filter.hpp"
#include "hpipm.hpp"
#include "osqp.hpp"
#include "riccati.hpp"
#include "tick.hpp"

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

using Times = nb::ndarray<const int64_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Tracks = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using State = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Square = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

static void run(Filter &filter, const State &z, const Square &covariance, const Times &times_us,
                const Tracks &tracks, const Rows &rows, size_t first, size_t last) {
    size_t n = filter.axes(), count = times_us.shape(0);
    if (z.size() != 3 * n || covariance.shape(0) != 3 * n || covariance.shape(1) != 3 * n ||
        tracks.shape(0) != 3 * count || tracks.shape(1) != filter.track_rows())
        throw std::invalid_argument("a state or tracks of another size than the filter's");
    if (first < last && (first == 0 || last > rows.position.size()))
        throw std::invalid_argument("no such rows");
    nb::gil_scoped_release free;
    filter.run(z.data(), covariance.data(), {count, times_us.data(), tracks.data()}, rows, first,
               last);
}

static auto steps(const std::vector<int64_t> &times_us, int64_t longest_us) {
    auto *made = new std::vector<int64_t>(steps_through(times_us, longest_us));
    nb::capsule owner(made, [](void *p) noexcept { delete static_cast<decltype(made)>(p); });
    return nb::ndarray<nb::numpy, int64_t>(made->data(), {made->size() / 3, 3}, owner);
}

static void bind_filter(nb::module_ &m) {
    m.def("steps", &steps, "times_us"_a, "longest_us"_a,
          "Start, middle and end (m, 3) of steps from time to time, as many between two as keep "
          "them short.");
    nb::class_<Rows>(m, "Rows", "Samples in order and the filter after each, a row a sample.")
        .def(
            "__init__",
            [](Rows *self, Integers time_us, Integers axis, Array position, Array z,
               Array covariance, Array nis, Integers rejected) {
                new (self) Rows{time_us, axis, position, z, covariance, nis, rejected};
            },
            "time_us"_a, "axis"_a, "position"_a, "z"_a, "covariance"_a, "nis"_a, "rejected"_a);
    nb::class_<Filter>(m, "Filter", "An extended Kalman filter over z = [q, v, d].")
        .def(
            "__init__",
            [](Filter *self, Bound &step, Array acceleration, Array walk, Array reading,
               Array start, double nis_max, int64_t in_a_row) {
                new (self) Filter(step, {acceleration, walk, reading, start}, {nis_max, in_a_row});
            },
            "step"_a, "acceleration"_a, "walk"_a, "reading"_a, "start"_a, "nis_max"_a, "in_a_row"_a,
            nb::keep_alive<1, 2>(), "Raises ValueError for arrays of other sizes than the step's.")
        .def(
            "run", &run, "z"_a.noconvert(), "covariance"_a.noconvert(), "times_us"_a, "tracks"_a,
            "rows"_a, "first"_a, "last"_a,
            "Carries z and its covariance, in place, through steps whose start, middle and end are "
            "`times_us` (m, 3), along `tracks` (3 m, 5n) at those. Rows first .. last - 1 are "
            "taken "
            "in, and filled in, where a step ends at their time. Raises ValueError for other "
            "sizes.");
}

NB_MODULE(_tick, m) {
    nb::module_::import_("headway.models._generated"); // knows Bound
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
            [](Stages *self, std::vector<int> driven, std::vector<int> bounded, Matrix a, Matrix b0,
               Matrix b1, Matrix gradient, Matrix lower, Matrix upper, Matrix column_scale,
               Matrix row_scale, Matrix state, Matrix torque, Matrix step, Matrix curvature,
               Matrix approach_s, Matrix soft) {
                int axes = (int)approach_s.size(), intervals = (int)step.shape(1);
                new (self)
                    Stages{axes,     intervals, driven,     bounded,      a,         b0,    b1,
                           gradient, lower,     upper,      column_scale, row_scale, state, torque,
                           step,     curvature, approach_s, soft};
            },
            "driven"_a, "bounded"_a, "a"_a, "b0"_a, "b1"_a, "gradient"_a, "lower"_a, "upper"_a,
            "column_scale"_a, "row_scale"_a, "state"_a, "torque"_a, "step"_a, "curvature"_a,
            "approach_s"_a, "soft"_a,
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
}
