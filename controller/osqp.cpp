#include "osqp.hpp"

#include <signal.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

static constexpr double FAR = 1e15; // beyond it there is no bound, see UNBOUNDED in ocp.py
// After so many iterations the rows are weighted anew, by this factor up or down.
static constexpr int ROUND = 25;
static constexpr double FACTOR = 2;
static constexpr double PULL = 1e-9; // a row with a smaller multiplier is not active

static OSQPCscMatrix view(Sparse &m, OSQPInt rows) {
    OSQPCscMatrix csc{};
    OSQPCscMatrix_set_data(&csc, rows, (OSQPInt)m.indptr.size() - 1, (OSQPInt)m.data.size(),
                           m.data.data(), const_cast<OSQPInt *>(m.indices.data()),
                           const_cast<OSQPInt *>(m.indptr.data()));
    return csc;
}

Osqp::Osqp(Sparse hessian, bool hessian_changes, Numbers gradient, Sparse constraints,
           Numbers lower, Numbers upper, Numbers scale, int max_iterations, double tolerance)
    : hessian_(hessian), hessian_changes_(hessian_changes), constraints_(constraints),
      gradient_(gradient), lower_(lower), upper_(upper), scale_(scale),
      max_iterations_(max_iterations), round_(std::min(max_iterations, ROUND)),
      slope_(gradient.size()), value_(lower.size()), idle_(gradient.size(), 0.0),
      multiplier_(lower.size(), 0.0), weight_(lower.size(), 1.0),
      weighted_(constraints.data.size()), low_(lower.size()), high_(lower.size()),
      own_(lower.size()) {
    OSQPSettings settings;
    osqp_set_default_settings(&settings);
    settings.verbose = 0;
    settings.scaling = 0; // the problem is scaled already
    settings.polishing = 0;
    settings.warm_starting = 1;
    settings.max_iter = round_;
    settings.eps_abs = settings.eps_rel = tolerance;
    settings.check_termination = 5;
    settings.adaptive_rho = OSQP_ADAPTIVE_RHO_UPDATE_ITERATIONS; // not by time: the same everywhere
    settings.adaptive_rho_interval = 10;
    settings.adaptive_rho_tolerance = 2;
    settings.alpha = 1.4; // where no limit is active more only swings
    OSQPCscMatrix p = view(hessian, (OSQPInt)gradient.size());
    OSQPCscMatrix a = view(constraints, (OSQPInt)lower.size());
    OSQPSolver *solver = nullptr;
    OSQPInt error = osqp_setup(&solver, &p, gradient.data(), &a, lower.data(), upper.data(), a.m,
                               p.n, &settings);
    solver_.reset(solver);
    if (error)
        throw std::invalid_argument(std::string("OSQP: ") + osqp_error_message(error));
}

bool Osqp::update() {
    std::fill(weight_.begin(), weight_.end(), 1.0);
    return take_matrices(hessian_changes_);
}

bool Osqp::take_matrices(bool hessian) {
    const Numbers &squares = hessian_.data, &entries = constraints_.data;
    for (size_t k = 0; k < weighted_.size(); ++k)
        weighted_[k] = entries.data()[k] * weight_[(size_t)constraints_.indices.data()[k]];
    return osqp_update_data_mat(solver_.get(), hessian ? squares.data() : nullptr, nullptr,
                                hessian ? (OSQPInt)squares.size() : 0, weighted_.data(), nullptr,
                                (OSQPInt)weighted_.size()) == 0;
}

// `from`: where the solution is looked for, with the multipliers that are known.
bool Osqp::take_vectors(const double *from) {
    for (size_t i = 0; i < weight_.size(); ++i) {
        low_[i] = lower_.data()[i] * weight_[i];
        high_[i] = upper_.data()[i] * weight_[i];
        own_[i] = multiplier_[i] / weight_[i];
    }
    return osqp_update_data_vec(solver_.get(), gradient_.data(), low_.data(), high_.data()) == 0 &&
           osqp_warm_start(solver_.get(), from, own_.data()) == 0;
}

// An active row converges faster with a larger weight, one that is not with a smaller one. Weights are
// what rho by row would be (Stellato et al., Math. Program. Comput. 12, 2020, section 5.2), for which
// OSQP's interface has no place.
void Osqp::weigh() {
    for (size_t i = 0; i < weight_.size(); ++i)
        if (lower_.data()[i] < upper_.data()[i])
            weight_[i] *= std::abs(own_[i]) > PULL ? FACTOR : 1 / FACTOR;
}

void Osqp::forget() {
    std::fill(multiplier_.begin(), multiplier_.end(), 0.0);
    osqp_update_rho(solver_.get(), OSQP_RHO);
}

// While it solves OSQP has a handler for Ctrl-C of its own, which prints, and which forgets one that
// comes after its last look. Held back, as in all other threads (devices/interrupts.py), it reaches
// the handler that is there afterwards.
static bool fails(OSQPSolver *solver) {
    sigset_t interrupt, before;
    sigemptyset(&interrupt);
    sigaddset(&interrupt, SIGINT);
    pthread_sigmask(SIG_BLOCK, &interrupt, &before);
    bool failed = osqp_solve(solver);
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
    return failed;
}

Answer Osqp::solve(double *z) {
    OSQPSolver *s = solver_.get();
    Answer answer;
    if (!take_vectors(idle_.data()))
        return answer;
    for (;;) {
        bool failed = fails(s);
        OSQPInt status = s->info->status_val;
        answer.status = (int)status;
        if (failed)
            return answer;
        answer.iterations += (int)s->info->iter;
        answer.good = status == OSQP_SOLVED || status == OSQP_SOLVED_INACCURATE ||
                      status == OSQP_MAX_ITER_REACHED; // then the residual decides
        std::copy_n(s->solution->x, idle_.size(), z);
        if (!answer.good)
            return answer;
        std::copy_n(s->solution->y, own_.size(), own_.begin());
        for (size_t i = 0; i < own_.size(); ++i)
            multiplier_[i] = own_[i] * weight_[i];
        if (status == OSQP_SOLVED || answer.iterations + round_ > max_iterations_)
            break;
        weigh();
        if (!take_matrices(false) || !take_vectors(z))
            break; // no factors with these weights: the residual decides
    }
    measure(z, answer);
    return answer;
}

// Slope P z + q + A' y, and each row's multiplier times its distance from the bound it is of.
void Osqp::measure(const double *z, Answer &answer) {
    const double *y = multiplier_.data(), *p = hessian_.data.data();
    const double *a = constraints_.data.data();
    const OSQPInt *p_row = hessian_.indices.data(), *p_first = hessian_.indptr.data();
    const OSQPInt *a_row = constraints_.indices.data(), *a_first = constraints_.indptr.data();
    std::copy_n(gradient_.data(), slope_.size(), slope_.begin());
    std::fill(value_.begin(), value_.end(), 0.0);
    for (size_t column = 0; column < slope_.size(); ++column) {
        for (OSQPInt k = p_first[column]; k < p_first[column + 1]; ++k) {
            size_t row = (size_t)p_row[k];
            slope_[row] += p[k] * z[column];
            if (row != column)
                slope_[column] += p[k] * z[row];
        }
        for (OSQPInt k = a_first[column]; k < a_first[column + 1]; ++k) {
            slope_[column] += a[k] * y[a_row[k]];
            value_[(size_t)a_row[k]] += a[k] * z[column];
        }
    }
    answer.stationarity = answer.complementarity = 0;
    for (size_t i = 0; i < slope_.size(); ++i)
        answer.stationarity = std::max(answer.stationarity, std::abs(slope_[i]) / scale_.data()[i]);
    for (size_t i = 0; i < value_.size(); ++i) {
        double distance = y[i] > 0 ? upper_.data()[i] - value_[i] : value_[i] - lower_.data()[i];
        if (distance < FAR) // a multiplier's last bits say nothing of a row without a bound
            answer.complementarity = std::max(answer.complementarity, std::abs(y[i] * distance));
    }
}
