#include "osqp.hpp"

#include <algorithm>
#include <stdexcept>
#include <string>

static OSQPCscMatrix view(Sparse &m, OSQPInt rows) {
    OSQPCscMatrix csc{};
    OSQPCscMatrix_set_data(&csc, rows, (OSQPInt)m.indptr.size() - 1, (OSQPInt)m.data.size(),
                           m.data.data(), const_cast<OSQPInt *>(m.indices.data()),
                           const_cast<OSQPInt *>(m.indptr.data()));
    return csc;
}

Osqp::Osqp(Sparse hessian, bool hessian_changes, Numbers gradient, Sparse constraints,
           Numbers lower, Numbers upper, int max_iterations, double tolerance)
    : hessian_(hessian.data), hessian_changes_(hessian_changes), gradient_(gradient), lower_(lower),
      upper_(upper), data_(constraints.data), idle_(gradient.size(), 0.0) {
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
    OSQPFloat *hessian = hessian_changes_ ? hessian_.data() : nullptr;
    return osqp_update_data_mat(solver_.get(), hessian, nullptr,
                                hessian ? (OSQPInt)hessian_.size() : 0, data_.data(), nullptr,
                                (OSQPInt)data_.size()) == 0;
}

void Osqp::forget() {
    osqp_cold_start(solver_.get());
    osqp_update_rho(solver_.get(), OSQP_RHO);
}

Answer Osqp::solve(double *z) {
    OSQPSolver *s = solver_.get();
    if (osqp_update_data_vec(s, gradient_.data(), lower_.data(), upper_.data()) ||
        osqp_warm_start(s, idle_.data(), nullptr) || osqp_solve(s))
        return {};
    std::copy_n(s->solution->x, idle_.size(), z);
    OSQPInt status = s->info->status_val;
    bool good = status == OSQP_SOLVED || status == OSQP_SOLVED_INACCURATE ||
                status == OSQP_MAX_ITER_REACHED; // then the residual decides
    return {(int)status, (int)s->info->iter, good};
}
