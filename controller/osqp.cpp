#include "osqp.hpp"

#include <signal.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

static constexpr double FAR = 1e15; // beyond it there is no bound, see UNBOUNDED in ocp.py

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
      gradient_(gradient), lower_(lower), upper_(upper), scale_(scale), slope_(gradient.size()),
      value_(lower.size()), idle_(gradient.size(), 0.0) {
    OSQPSettings settings;
    osqp_set_default_settings(&settings);
    settings.verbose = 0;
    settings.scaling = 0; // the problem is scaled already
    settings.polishing = 0;
    settings.warm_starting = 1;
    settings.max_iter = max_iterations;
    settings.eps_abs = settings.eps_rel = tolerance;
    settings.check_termination = 10;
    settings.adaptive_rho = OSQP_ADAPTIVE_RHO_UPDATE_ITERATIONS; // not by time: the same everywhere
    settings.adaptive_rho_interval = 25;
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
    const Numbers &squares = hessian_.data, &entries = constraints_.data;
    return osqp_update_data_mat(solver_.get(), hessian_changes_ ? squares.data() : nullptr, nullptr,
                                hessian_changes_ ? (OSQPInt)squares.size() : 0, entries.data(),
                                nullptr, (OSQPInt)entries.size()) == 0;
}

void Osqp::forget() {
    osqp_cold_start(solver_.get());
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
    if (osqp_update_data_vec(s, gradient_.data(), lower_.data(), upper_.data()) ||
        osqp_warm_start(s, idle_.data(), nullptr))
        return {};
    if (fails(s))
        return {(int)s->info->status_val};
    std::copy_n(s->solution->x, idle_.size(), z);
    OSQPInt status = s->info->status_val;
    bool good = status == OSQP_SOLVED || status == OSQP_SOLVED_INACCURATE ||
                status == OSQP_MAX_ITER_REACHED; // then the residual decides
    Answer answer{(int)status, (int)s->info->iter, good};
    measure(*s->solution, answer);
    return answer;
}

// Slope P z + q + A' y, and each row's multiplier times its distance from the bound it is of.
void Osqp::measure(const OSQPSolution &solution, Answer &answer) {
    const double *z = solution.x, *y = solution.y, *p = hessian_.data.data();
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
