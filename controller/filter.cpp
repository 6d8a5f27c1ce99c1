#include "filter.hpp"

#include <algorithm>
#include <stdexcept>
#include <utility>

// Of `slope`; `rate` has the first five.
enum { X, TRACKS, D, LAW, RATE, BY_STATE, BY_TORQUE, ARRAYS };

// The loops over matrices are compiled for several processors; the one at hand is found at load time.
// Where the number of axes is known to the compiler it unrolls them.
#define INLINED static inline __attribute__((always_inline)) void
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define VECTORS __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define VECTORS
#endif

std::vector<int64_t> steps_through(const std::vector<int64_t> &times_us, int64_t longest_us) {
    std::vector<int64_t> steps;
    for (size_t k = 1; k < times_us.size(); ++k) {
        const int64_t from_us = times_us[k - 1], way_us = times_us[k] - from_us;
        const int64_t count = (way_us + longest_us - 1) / longest_us;
        int64_t begin_us = from_us;
        for (int64_t i = 1; i <= count; ++i) {
            const int64_t end_us = from_us + way_us * i / count;
            steps.insert(steps.end(), {begin_us, begin_us + (end_us - begin_us) / 2, end_us});
            begin_us = end_us;
        }
    }
    if (steps.empty())
        steps.assign(3, times_us.back());
    return steps;
}

Filter::Filter(Bound &rate, Bound &slope, Noise noise, Outliers outliers, size_t rows,
               int64_t bundle_us, int64_t step_us)
    : history(noise.reading.size(), rows, bundle_us), step_us(step_us), rate(rate), slope(slope),
      noise(std::move(noise)), outliers(outliers), n(this->noise.reading.size()),
      carried(6 * n * n), column(3 * n), gain(3 * n), after(2 * n), jacobian(6 * n * n),
      s(6 * n * n), ds(6 * n * n), acceleration(n) {
    if (slope.kept.size() != ARRAYS || slope.kept[D].size() != n)
        throw std::invalid_argument("not a slope of as many axes");
    for (size_t i = 0; i < BY_STATE; ++i)
        if (rate.kept.size() != BY_STATE || rate.kept[i].data() != slope.kept[i].data())
            throw std::invalid_argument("a rate on other arrays than the slope's");
    if (this->noise.acceleration.size() != n || this->noise.walk.size() != n ||
        this->noise.start.size() != 3 * n)
        throw std::invalid_argument("noise of another number of axes");
}

size_t Filter::track_rows() const { return slope.kept[TRACKS].size(); }

std::vector<int64_t> Filter::times_to(int64_t now_us) const {
    std::vector<int64_t> times_us;
    for (size_t row = history.filled() - 1; row < history.size(); ++row)
        times_us.push_back(history.time_us(row));
    times_us.push_back(now_us);
    return times_us;
}

void Filter::update(double *z, double *covariance, Steps steps) {
    const size_t known = history.filled() - 1;
    std::copy_n(history.z(known), 3 * n, z);
    std::copy_n(history.covariance(known), 9 * n * n, covariance);
    std::copy_n(history.acceleration(known), n, acceleration.data());
    take_in(z, covariance, steps.times_us[0]);
    for (size_t k = 0; k < steps.count; ++k) {
        predict(z, covariance, {1, steps.times_us + 3 * k, steps.tracks + 3 * track_rows() * k});
        take_in(z, covariance, steps.times_us[3 * k + 2]);
    }
}

// All samples of one bundle that are not yet in.
void Filter::take_in(double *z, double *covariance, int64_t time_us) {
    for (size_t row = history.filled(); row < history.size() && history.time_us(row) == time_us;
         ++row)
        correct(z, covariance, row);
}

void Filter::predict(double *z, double *covariance, Steps steps) {
    for (size_t k = 0; k < steps.count; ++k) {
        const int64_t dt_us = steps.times_us[3 * k + 2] - steps.times_us[3 * k];
        if (dt_us > 0)
            step_on(z, covariance, (double)dt_us * 1e-6, steps.tracks + 3 * track_rows() * k);
    }
}

void Filter::forget(int64_t before_us) {
    const size_t since = history.first_since(before_us), first = since > 0 ? since - 1 : 0;
    for (size_t row = 0; row < first; ++row) {
        const int64_t axis = history.sample(row).axis;
        if (axis < 0)
            continue;
        if (history.rejected(row)[axis])
            ++statistics.outliers;
        else {
            ++statistics.accepted;
            statistics.nis_sum += history.nis(row);
        }
    }
    history.forget(first);
}

// P becomes F P F', where F's upper 2n rows, by columns, are f and the others those of the identity.
// `carried` (2n, 3n) is working memory.
INLINED propagate_of(double *__restrict p, const double *__restrict f, double *__restrict carried,
                     size_t n) {
    const size_t nx = 2 * n, nz = 3 * n;
    for (size_t i = 0; i < nx; ++i) {
        double *row = carried + i * nz;
        std::fill_n(row, nz, 0.0);
        for (size_t k = 0; k < nz; ++k)
            for (size_t j = 0; j < nz; ++j)
                row[j] += f[i + nx * k] * p[k * nz + j];
    }
    for (size_t i = 0; i < nx; ++i) {
        double *row = p + i * nz;
        std::fill_n(row, nx, 0.0);
        for (size_t k = 0; k < nz; ++k)
            for (size_t j = 0; j < nx; ++j)
                row[j] += carried[i * nz + k] * f[j + nx * k];
        std::copy_n(carried + i * nz + nx, nz - nx, row + nx);
    }
}

VECTORS static void propagate(double *p, const double *f, double *carried, size_t n) {
    switch (n) {
    case 2:
        return propagate_of(p, f, carried, 2);
    case 6:
        return propagate_of(p, f, carried, 6);
    default:
        return propagate_of(p, f, carried, n);
    }
}

// P becomes (I - K H) P (I - K H)' + K R K', Joseph's form, in its upper half: `column` is P H',
// `spread` H P H'.
VECTORS static void narrow(double *p, const double *column, const double *gain, double reading,
                           double spread, size_t nz) {
    for (size_t i = 0; i < nz; ++i) {
        const double mine = gain[i], left = column[i] - mine * spread; // (I - K H) P H'
        double *row = p + i * nz;
        for (size_t j = i; j < nz; ++j)
            row[j] = row[j] - mine * column[j] - left * gain[j] + mine * reading * gain[j];
    }
}

// The upper half's entries in the lower one: a covariance stays symmetric to the last bit.
static void mirror(double *p, size_t nz) {
    for (size_t i = 1; i < nz; ++i)
        for (size_t j = 0; j < i; ++j)
            p[i * nz + j] = p[j * nz + i];
}

// The rate of S, x's Jacobian in z, by rows (2n, 3n): that of the positions' rows is the velocities';
// that of the velocities' is A S and B where d is, with A (n, 2n) and B (n, n) by columns.
INLINED vary_of(const double *__restrict s, const double *__restrict a, const double *__restrict b,
                double *__restrict ds, size_t n) {
    const size_t nx = 2 * n, nz = 3 * n;
    std::copy_n(s + n * nz, n * nz, ds);
    for (size_t i = 0; i < n; ++i) {
        double *row = ds + (n + i) * nz;
        std::fill_n(row, nx, 0.0);
        for (size_t j = 0; j < n; ++j)
            row[nx + j] = b[i + n * j];
        for (size_t k = 0; k < nx; ++k)
            for (size_t j = 0; j < nz; ++j)
                row[j] += a[i + n * k] * s[k * nz + j];
    }
}

VECTORS static void vary(const double *s, const double *a, const double *b, double *ds, size_t n) {
    switch (n) {
    case 2:
        return vary_of(s, a, b, ds, 2);
    case 6:
        return vary_of(s, a, b, ds, 6);
    default:
        return vary_of(s, a, b, ds, n);
    }
}

// S = I + share * its rate.
VECTORS static void grow(const double *ds, double share, double *s, size_t n) {
    const size_t nx = 2 * n, nz = 3 * n;
    for (size_t i = 0; i < nx * nz; ++i)
        s[i] = share * ds[i];
    for (size_t i = 0; i < nx; ++i)
        s[i * nz + i] += 1.0;
}

// The classical Runge-Kutta step of x. Its Jacobian is that of a linear system with the slope's
// Jacobians half-way, the exponential's series to the fourth order by Horner's rule: a covariance asks
// for no more, and Jacobians at all four stages took twice as long.
void Filter::step(const double *z, const double *tracks, double dt_s, double *end,
                  double *end_jacobian) {
    const size_t nx = 2 * n, nz = 3 * n, rows = track_rows();
    double *x = slope.kept[X].data(), *along = slope.kept[TRACKS].data();
    const double *dx = slope.kept[RATE].data();
    std::copy_n(z, nx, x);
    std::copy_n(z, nx, end);
    std::copy_n(z + nx, n, slope.kept[D].data());
    for (int stage = 0; stage < 4; ++stage) {
        const size_t at = stage == 0 ? 0 : stage < 3 ? 1 : 2; // start, middle, end
        std::copy_n(tracks + rows * at, rows, along);
        generated_run(stage == 2 ? &slope.generated : &rate.generated);
        const double share = stage < 2 ? dt_s / 2 : dt_s; // of the way to the next one
        const double weight = dt_s / (stage % 3 == 0 ? 6 : 3);
        for (size_t i = 0; i < nx; ++i) {
            x[i] = z[i] + share * dx[i];
            end[i] += weight * dx[i];
        }
    }
    std::fill(ds.begin(), ds.end(), 0.0);
    grow(ds.data(), 0.0, s.data(), n);
    for (int order = 4; order > 0; --order) {
        vary(s.data(), slope.kept[BY_STATE].data(), slope.kept[BY_TORQUE].data(), ds.data(), n);
        grow(ds.data(), dt_s / order, s.data(), n);
    }
    for (size_t i = 0; i < nx; ++i)
        for (size_t j = 0; j < nz; ++j)
            end_jacobian[i + nx * j] = s[i * nz + j];
}

void Filter::step_on(double *z, double *covariance, double dt_s, const double *tracks) {
    const size_t nx = 2 * n, nz = 3 * n;
    step(z, tracks, dt_s, after.data(), jacobian.data());
    for (size_t i = 0; i < n; ++i)
        acceleration[i] = (after[n + i] - z[n + i]) / dt_s;
    std::copy_n(after.data(), nx, z);

    propagate(covariance, jacobian.data(), carried.data(), n);
    mirror(covariance, nz);
    for (size_t i = 0; i < n; ++i) {
        const size_t q = i, v = n + i, d = nx + i;
        const double a = noise.acceleration.data()[i];
        covariance[q * nz + q] += a * dt_s * dt_s * dt_s / 3;
        covariance[q * nz + v] += a * dt_s * dt_s / 2;
        covariance[v * nz + q] += a * dt_s * dt_s / 2;
        covariance[v * nz + v] += a * dt_s;
        covariance[d * nz + d] += noise.walk.data()[i] * dt_s;
    }
}

// A reading is of q + v dt + a dt^2 / 2, dt after its bundle's time, with the acceleration on the way
// there, give or take what white acceleration makes of it meanwhile.
void Filter::correct(double *z, double *covariance, size_t row) {
    const Sample &sample = history.sample(row);
    const size_t nz = 3 * n, axis = (size_t)sample.axis, speed = n + axis;
    const double dt_s = (double)(sample.time_us - history.time_us(row)) * 1e-6;
    const double wander = noise.acceleration.data()[axis] * dt_s * dt_s * dt_s / 3;
    const double reading = noise.reading.data()[axis] + wander;
    for (size_t i = 0; i < nz; ++i)
        column[i] = covariance[i * nz + axis] + dt_s * covariance[i * nz + speed];
    const double way = dt_s * (z[speed] + dt_s / 2 * acceleration[axis]);
    const double innovation = sample.position - z[axis] - way;
    const double spread = column[axis] + dt_s * column[speed];
    const double variance = spread + reading;
    const double nis = innovation * innovation / variance;

    int64_t *rejected = history.rejected(row);
    std::copy_n(history.rejected(row - 1), n, rejected);
    rejected[axis] = nis > outliers.nis_max ? rejected[axis] + 1 : 0;
    if (rejected[axis] == 0) {
        for (size_t i = 0; i < nz; ++i) {
            gain[i] = column[i] / variance;
            z[i] += gain[i] * innovation;
        }
        narrow(covariance, column.data(), gain.data(), reading, spread, nz);
        mirror(covariance, nz);
    } else if (rejected[axis] % outliers.in_a_row == 0) {
        for (size_t i = 0; i < nz; ++i)
            covariance[i * nz + i] += noise.start.data()[i];
    }
    history.nis(row) = nis;
    std::copy_n(z, nz, history.z(row));
    std::copy_n(covariance, nz * nz, history.covariance(row));
    std::copy_n(acceleration.data(), n, history.acceleration(row));
    history.fill(row);
}
