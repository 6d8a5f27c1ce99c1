// A stage's state is [x_i; u_i], its control u_{i+1}: the torque runs linearly between nodes. At
// stage 0 x is known, and the control is [u_0; u_1]. There are n axes and w motors.
#include "hpipm.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>

// At rest within this: an equality has no interior, which the method needs.
static constexpr double REST = 1e-5;
// Products of multipliers and distances to begin with where there are rows of the task's own, whose
// multipliers are as large as what cannot be kept. Found by trying: with HPIPM's own 10 such programs
// failed, and others took 14.4 iterations in place of 12.8.
static constexpr double KEPT_PRODUCTS = 1e4;

Hpipm::Hpipm(Stages stages, int max_iterations, double tolerance)
    : p_(std::move(stages)), between_((int)(p_.cubic.size() * p_.driven.size())),
      kept_((int)p_.kept.shape(0)) {
    soft_ = (int)p_.bounded.size() + kept_;
    int n = p_.axes, w = (int)p_.driven.size(), count = p_.intervals;
    auto block = [&](hpipm_size_t size) -> void * {
        memory_.emplace_back(new char[size + 64]());
        auto at = reinterpret_cast<std::uintptr_t>(memory_.back().get());
        return reinterpret_cast<void *>((at + 63) / 64 * 64);
    };
    d_ocp_qp_dim_create(count, &dim_, block(d_ocp_qp_dim_memsize(count)));
    for (int i = 0; i <= count; ++i) {
        d_ocp_qp_dim_set_nx(i, i ? 2 * n + w : 0, &dim_);
        d_ocp_qp_dim_set_nu(i, i == 0 ? 2 * w : i < count ? w : 0, &dim_);
        d_ocp_qp_dim_set_nbx(i, i < 1 ? 0 : i < count - 1 ? w : 2 * w, &dim_); // rest, torque
        d_ocp_qp_dim_set_nbu(i, i ? 0 : w, &dim_);                             // u_0
        d_ocp_qp_dim_set_ng(i, (i < count ? between_ : 0) + (i ? soft_ : 0), &dim_);
        d_ocp_qp_dim_set_ns(i, i ? soft_ : 0, &dim_);
    }
    d_ocp_qp_create(&dim_, &qp_, block(d_ocp_qp_memsize(&dim_)));
    d_ocp_qp_set_all_zero(&qp_);
    d_ocp_qp_sol_create(&dim_, &sol_, block(d_ocp_qp_sol_memsize(&dim_)));
    d_ocp_qp_ipm_arg_create(&dim_, &arg_, block(d_ocp_qp_ipm_arg_memsize(&dim_)));
    d_ocp_qp_ipm_arg_set_default(SPEED, &arg_);
    d_ocp_qp_ipm_arg_set_iter_max(&max_iterations, &arg_);
    double products = KEPT_PRODUCTS;
    if (kept_)
        d_ocp_qp_ipm_arg_set_mu0(&products, &arg_);
    d_ocp_qp_ipm_arg_set_tol_stat(&tolerance, &arg_);
    d_ocp_qp_ipm_arg_set_tol_eq(&tolerance, &arg_);
    d_ocp_qp_ipm_arg_set_tol_ineq(&tolerance, &arg_);
    d_ocp_qp_ipm_arg_set_tol_comp(&tolerance, &arg_);
    work_memory_ = block(d_ocp_qp_ipm_ws_memsize(&dim_, &arg_));
    d_ocp_qp_ipm_ws_create(&dim_, &arg_, &work_, work_memory_);
    buffer_.resize((size_t)(9 * n * n + 9 * n + kept_ * (2 * n + w + 2)));
    offset_.resize((size_t)(between_ * count));
    set_constant();
}

// What is not a number stays where the method only adds to it, or multiplies it by zero.
void Hpipm::forget() {
    std::fill_n(static_cast<char *>(work_memory_), d_ocp_qp_ipm_ws_memsize(&dim_, &arg_), 0);
    d_ocp_qp_ipm_ws_create(&dim_, &arg_, &work_, work_memory_);
}

// Q: what is constant, and what the task's own costs add to it.
void Hpipm::set_states() {
    int x = 2 * p_.axes, w = (int)p_.driven.size(), count = p_.intervals, nx = x + w;
    const double *scale = p_.column_scale.data(), *state = p_.state.data();
    const double *torque = p_.torque.data(), *step = p_.step.data();
    const double *curved = p_.curvature.size() ? p_.curvature.data() : nullptr;
    double *m = buffer_.data();
    for (int i = 1; i <= count; ++i) {
        std::fill_n(m, nx * nx, 0.0);
        for (int c = 0; c < x; ++c) {
            for (int r = 0; curved && r < x; ++r)
                m[c * nx + r] = curved[(i * x + c) * x + r] * scale[c] * scale[r];
            m[c * (nx + 1)] += state[i * x + c];
        }
        for (int j = 0; j < w; ++j)
            m[(x + j) * (nx + 1)] = torque[i * w + j] + (i < count ? step[i * w + j] : 0);
        d_ocp_qp_set_Q(i, m, &qp_);
    }
}

void Hpipm::set_constant() {
    int n = p_.axes, w = (int)p_.driven.size(), count = p_.intervals;
    const double *torque = p_.torque.data(), *step = p_.step.data();
    double *m = buffer_.data();
    set_states();
    std::vector<int> boxes;
    for (int axis : p_.driven)
        boxes.push_back(n + axis); // of [q; v; u]
    for (int j = 0; j < w; ++j)
        boxes.push_back(2 * n + j);
    for (int i = 0; i <= count; ++i) {
        int nu = i == 0 ? 2 * w : i < count ? w : 0;
        std::fill(buffer_.begin(), buffer_.end(), 0.0);
        if (i) {
            if (i < count) {
                for (int j = 0; j < w; ++j)
                    m[j * (nu + 1)] = step[i * w + j];
                d_ocp_qp_set_R(i, m, &qp_);
                std::fill(buffer_.begin(), buffer_.end(), 0.0);
                for (int j = 0; j < w; ++j)
                    m[(2 * n + j) * nu + j] = -step[i * w + j];
                d_ocp_qp_set_S(i, m, &qp_);
            }
            d_ocp_qp_set_idxbx(i, boxes.data() + (i < count - 1 ? w : 0), &qp_);
        } else {
            for (int j = 0; j < w; ++j) {
                m[j * (nu + 1)] = torque[j] + step[j];
                m[(w + j) * (nu + 1)] = step[j];
                m[j * nu + w + j] = m[(w + j) * nu + j] = -step[j];
            }
            d_ocp_qp_set_R(0, m, &qp_);
            std::vector<int> first;
            for (int j = 0; j < w; ++j)
                first.push_back(j);
            d_ocp_qp_set_idxbu(0, first.data(), &qp_);
        }
        if (i && soft_) { // the last rows of the general constraints
            std::vector<int> softened;
            for (int j = 0; j < soft_; ++j)
                softened.push_back(dim_.nbx[i] + dim_.ng[i] - soft_ + j); // behind the boxes
            d_ocp_qp_set_idxs(i, softened.data(), &qp_);
            std::vector<double> weight;
            for (int axis : p_.bounded)
                weight.push_back(2 * p_.soft.data()[axis]);
            weight.resize((size_t)soft_, 2.0); // of the task's own a slack costs its square
            d_ocp_qp_set_Zl(i, weight.data(), &qp_);
            d_ocp_qp_set_Zu(i, weight.data(), &qp_);
            if (kept_) { // which are not kept above anything
                std::vector<double> mask((size_t)dim_.ng[i], 1.0);
                std::fill_n(mask.end() - kept_, kept_, 0.0);
                d_ocp_qp_set_lg_mask(i, mask.data(), &qp_);
                d_ocp_qp_set_lls_mask(i, mask.data() + dim_.ng[i] - soft_, &qp_);
            }
        }
    }
}

// Rows of C with slacks, in the buffer, behind the first ones.
void Hpipm::set_soft(int i, int first) {
    int n = p_.axes, ng = dim_.ng[i];
    const double *scale = p_.column_scale.data();
    double *row = buffer_.data() + first;
    for (int axis : p_.bounded) {
        row[axis * ng] = scale[axis];
        row[(n + axis) * ng] = p_.approach_s.data()[axis] * scale[n + axis];
        ++row;
    }
    const double *kept = p_.kept_slope.data() + (i - 1) * 2 * n * kept_;
    for (int r = 0; r < kept_; ++r)
        for (int c = 0; c < 2 * n; ++c)
            row[c * ng + r] = kept[c * kept_ + r] * scale[c];
}

bool Hpipm::update() {
    int n = p_.axes, w = (int)p_.driven.size(), count = p_.intervals;
    const double *scale = p_.column_scale.data(), *torque = scale + 2 * n * (count + 1);
    const int *driven = p_.driven.data();
    double *m = buffer_.data();
    for (int i = 0; i < count; ++i) {
        const double *a = p_.a.data() + i * 4 * n * n;
        const double *b0 = p_.b0.data() + i * 2 * n * n, *b1 = p_.b1.data() + i * 2 * n * n;
        int rows = 2 * n + w, ng = dim_.ng[i];
        if (i) {
            std::fill(buffer_.begin(), buffer_.end(), 0.0);
            for (int c = 0; c < 2 * n; ++c)
                for (int r = 0; r < 2 * n; ++r)
                    m[c * rows + r] = a[c * 2 * n + r] * scale[c] / scale[r];
            for (int c = 0; c < w; ++c)
                for (int r = 0; r < 2 * n; ++r)
                    m[(2 * n + c) * rows + r] = b0[driven[c] * 2 * n + r] * torque[c] / scale[r];
            d_ocp_qp_set_A(i, m, &qp_);
            std::fill(buffer_.begin(), buffer_.end(), 0.0); // C: the cubic, then what is soft
            for (int r = 0; r < between_; ++r) {
                auto [lever, begins, ends] = p_.cubic[(size_t)(r / w)];
                int q = driven[r % w], v = n + q;
                for (int c = 0; c < 2 * n; ++c) {
                    double own = c == q ? -lever : c == v ? begins : 0;
                    m[c * ng + r] =
                        (own + lever * a[c * 2 * n + q] + ends * a[c * 2 * n + v]) * scale[c];
                }
                for (int c = 0; c < w; ++c) {
                    const double *column = b0 + driven[c] * 2 * n;
                    m[(2 * n + c) * ng + r] = (lever * column[q] + ends * column[v]) * torque[c];
                }
            }
            set_soft(i, between_);
            d_ocp_qp_set_C(i, m, &qp_);
        }
        std::fill(buffer_.begin(), buffer_.end(), 0.0);
        int first = i ? 0 : w; // column of u_{i+1}
        for (int c = 0; c < w; ++c) {
            for (int r = 0; r < 2 * n; ++r) {
                m[(first + c) * rows + r] = b1[driven[c] * 2 * n + r] * torque[c] / scale[r];
                if (i == 0)
                    m[c * rows + r] = b0[driven[c] * 2 * n + r] * torque[c] / scale[r];
            }
            m[(first + c) * rows + 2 * n + c] = 1;
        }
        d_ocp_qp_set_B(i, m, &qp_);
        std::fill(buffer_.begin(), buffer_.end(), 0.0); // D
        for (int c = 0; c < w; ++c)
            for (int r = 0; r < between_; ++r) {
                auto [lever, _, ends] = p_.cubic[(size_t)(r / w)];
                int q = driven[r % w], v = n + q;
                const double *of0 = b0 + driven[c] * 2 * n, *of1 = b1 + driven[c] * 2 * n;
                m[(first + c) * ng + r] = (lever * of1[q] + ends * of1[v]) * torque[c];
                if (i == 0)
                    m[c * ng + r] = (lever * of0[q] + ends * of0[v]) * torque[c];
            }
        d_ocp_qp_set_D(i, m, &qp_);
    }
    if (soft_) {
        std::fill(buffer_.begin(), buffer_.end(), 0.0);
        set_soft(count, 0);
        d_ocp_qp_set_C(count, m, &qp_);
    }
    if (p_.curvature.size())
        set_states();
    return true;
}

void Hpipm::set_vectors() {
    int n = p_.axes, w = (int)p_.driven.size(), count = p_.intervals;
    int x = 2 * n;
    const int *driven = p_.driven.data();
    const double *scale = p_.column_scale.data(), *torque = scale + x * (count + 1);
    const double *low = p_.lower.data(), *up = p_.upper.data(), *rows = p_.row_scale.data();
    const double *gradient = p_.gradient.data(), *torques = gradient + x * (count + 1);
    int torque_row = x * (count + 1) + 2 * w, speed_row = torque_row + w * (count + 1);
    int soft_row = speed_row + between_ * count, soft = (int)p_.bounded.size();
    double *m = buffer_.data(), *l = m + 3 * n, *u = l + 3 * n + kept_;
    for (int i = 0; i <= count; ++i) {
        if (i < count) { // b
            const double *a = p_.a.data() + i * x * x;
            for (int r = 0; r < x; ++r) {
                m[r] = low[x * (i + 1) + r];
                if (i == 0)
                    for (int c = 0; c < x; ++c)
                        m[r] += a[c * x + r] * scale[c] / scale[r] * low[c];
            }
            std::fill_n(m + x, w, 0.0);
            d_ocp_qp_set_b(i, m, &qp_);
            for (int r = 0; r < between_; ++r) { // of the cubic; dx_0 is known
                auto [lever, begins, ends] = p_.cubic[(size_t)(r / w)];
                int q = driven[r % w], v = n + q;
                double own = i ? 0 : begins * low[v] * scale[v] - lever * low[q] * scale[q];
                offset_[(size_t)(i * between_ + r)] =
                    own + lever * m[q] * scale[q] + ends * m[v] * scale[v];
            }
        }
        if (i) {
            std::copy_n(gradient + i * x, x, m);
            std::copy_n(torques + i * w, w, m + x);
            d_ocp_qp_set_q(i, m, &qp_);
            int rests = i < count - 1 ? 0 : w;
            for (int r = 0; r < rests; ++r) {
                int at = x * (count + 1) + (i - count + 1) * w + r;
                double still = low[at] / rows[at], unit = scale[n + driven[r]]; // -v
                l[r] = (still - REST) / unit;
                u[r] = (still + REST) / unit;
            }
            for (int r = 0; r < w; ++r) {
                int at = torque_row + i * w + r;
                l[rests + r] = low[at] / rows[at] / torque[r];
                u[rests + r] = up[at] / rows[at] / torque[r];
            }
            d_ocp_qp_set_lbx(i, l, &qp_);
            d_ocp_qp_set_ubx(i, u, &qp_);
        } else {
            std::copy_n(torques, w, m);
            std::fill_n(m + w, w, 0.0);
            d_ocp_qp_set_r(0, m, &qp_);
            for (int r = 0; r < w; ++r) {
                int at = torque_row + r;
                l[r] = low[at] / rows[at] / torque[r];
                u[r] = up[at] / rows[at] / torque[r];
            }
            d_ocp_qp_set_lbu(0, l, &qp_);
            d_ocp_qp_set_ubu(0, u, &qp_);
        }
        int here = i < count ? between_ : 0;
        for (int r = 0; r < here; ++r) {
            int row = speed_row + (r / w * count + i) * w + r % w;
            double own = offset_[(size_t)(i * between_ + r)];
            l[r] = low[row] / rows[row] - own;
            u[r] = up[row] / rows[row] - own;
        }
        for (int r = 0; i && r < soft; ++r) {
            int above = soft_row + (i - 1) * soft + r, below = above + soft * count;
            l[here + r] = -up[below] / rows[below];
            u[here + r] = up[above] / rows[above];
        }
        for (int r = 0; i && r < kept_; ++r) {
            l[here + soft + r] = 0; // masked
            u[here + soft + r] = -p_.kept.data()[(i - 1) * kept_ + r];
        }
        d_ocp_qp_set_lg(i, l, &qp_);
        d_ocp_qp_set_ug(i, u, &qp_);
    }
}

Answer Hpipm::solve(double *z) {
    set_vectors();
    d_ocp_qp_ipm_solve(&qp_, &sol_, &arg_, &work_);
    int status, iterations, n = p_.axes, w = (int)p_.driven.size(), count = p_.intervals;
    d_ocp_qp_ipm_get_status(&work_, &status);
    d_ocp_qp_ipm_get_iter(&work_, &iterations);
    double *m = buffer_.data(), *torques = z + 2 * n * (count + 1);
    std::copy_n(p_.lower.data(), 2 * n, z); // dx_0
    d_ocp_qp_sol_get_u(0, &sol_, m);
    std::copy_n(m, w, torques);
    for (int i = 1; i <= count; ++i) {
        d_ocp_qp_sol_get_x(i, &sol_, m);
        std::copy_n(m, 2 * n, z + i * 2 * n);
        std::copy_n(m + 2 * n, w, torques + i * w);
    }
    double *slacks = std::fill_n(torques + w * (count + 1), n, 0.0); // of soft limits, stay with it
    for (int i = 1; i <= count; ++i) {
        d_ocp_qp_sol_get_su(i, &sol_, m);
        slacks = std::copy_n(m + soft_ - kept_, kept_, slacks);
    }
    // At its limit of iterations the residual decides.
    Answer answer{status, iterations, status == SUCCESS || status == MAX_ITER};
    measure(answer);
    return answer;
}

// From the residuals at the answer, as the method has them: of a stage first its controls, then
// its state; what is left are slacks.
void Hpipm::measure(Answer &answer) const {
    int x = 2 * p_.axes, w = (int)p_.driven.size(), count = p_.intervals;
    const double *scale = p_.column_scale.data(), *torque = scale + x * (count + 1);
    answer.stationarity = answer.complementarity = 0;
    for (int i = 0; i <= count; ++i) {
        int nu = dim_.nu[i], nx = dim_.nx[i];
        const double *slope = work_.res->res_g[i].pa;
        for (int k = 0; k < nu + nx; ++k) {
            bool state = k >= nu && k < nu + x;
            double of = state ? scale[k - nu] : torque[(k < nu ? k : k - nu - x) % w];
            answer.stationarity = std::max(answer.stationarity, std::abs(slope[k]) / of);
        }
        const blasfeo_dvec &product = work_.res->res_m[i];
        for (int k = 0; k < product.m; ++k)
            answer.complementarity = std::max(answer.complementarity, std::abs(product.pa[k]));
    }
}
