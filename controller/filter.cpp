#include "filter.hpp"

#include <algorithm>
#include <stdexcept>
#include <utility>

enum { X, D, START, MIDDLE, END, DT, LAW, AFTER, JACOBIAN, ARRAYS }; // of `step`

std::vector<int64_t> steps_through(const std::vector<int64_t> &times_us, int64_t longest_us) {
    std::vector<int64_t> steps;
    for (size_t k = 1; k < times_us.size(); ++k) {
        const int64_t from_us = times_us[k - 1], way_us = times_us[k] - from_us;
        const int64_t count = std::max<int64_t>(1, (way_us + longest_us - 1) / longest_us);
        int64_t begin_us = from_us;
        for (int64_t i = 1; i <= count; ++i) {
            const int64_t end_us = from_us + way_us * i / count;
            steps.insert(steps.end(), {begin_us, begin_us + (end_us - begin_us) / 2, end_us});
            begin_us = end_us;
        }
    }
    return steps;
}

Filter::Filter(Bound &step, Noise noise, Outliers outliers)
    : step(step), noise(std::move(noise)), outliers(outliers), n(this->noise.reading.size()),
      carried(6 * n * n), column(3 * n), gain(3 * n) {
    if (step.kept.size() != ARRAYS || step.kept[D].size() != n)
        throw std::invalid_argument("not a step of as many axes");
    if (this->noise.acceleration.size() != n || this->noise.walk.size() != n ||
        this->noise.start.size() != 3 * n)
        throw std::invalid_argument("noise of another number of axes");
}

size_t Filter::track_rows() const { return step.kept[START].size(); }

void Filter::run(double *z, double *covariance, Steps steps, const Rows &rows, size_t first,
                 size_t last) {
    for (size_t k = 0; k < steps.count; ++k) {
        const int64_t *times_us = steps.times_us + 3 * k;
        if (times_us[2] > times_us[0])
            predict(z, covariance, (double)(times_us[2] - times_us[0]) * 1e-6,
                    steps.tracks + 3 * track_rows() * k);
        for (; first < last && rows.time_us.data()[first] == times_us[2]; ++first)
            correct(z, covariance, rows, first);
    }
}

// P becomes F P F' + Q, where F's upper 2n rows are the step's Jacobian and the others those of the
// identity. Its halves are computed once: they stay equal to the last bit.
void Filter::predict(double *z, double *covariance, double dt_s, const double *tracks) {
    const size_t nx = 2 * n, nz = 3 * n, rows = track_rows();
    std::copy_n(z, nx, step.kept[X].data());
    std::copy_n(z + nx, n, step.kept[D].data());
    for (int at : {START, MIDDLE, END})
        std::copy_n(tracks + rows * (size_t)(at - START), rows, step.kept[at].data());
    step.kept[DT].data()[0] = dt_s;
    generated_run(&step.generated);
    std::copy_n(step.kept[AFTER].data(), nx, z);

    const double *f = step.kept[JACOBIAN].data(); // by columns
    for (size_t i = 0; i < nx; ++i)
        for (size_t j = 0; j < nz; ++j) {
            double sum = 0;
            for (size_t k = 0; k < nz; ++k)
                sum += f[i + nx * k] * covariance[k * nz + j];
            carried[i * nz + j] = sum;
        }
    for (size_t i = 0; i < nx; ++i) {
        for (size_t j = i; j < nx; ++j) {
            double sum = 0;
            for (size_t k = 0; k < nz; ++k)
                sum += carried[i * nz + k] * f[j + nx * k];
            covariance[i * nz + j] = covariance[j * nz + i] = sum;
        }
        for (size_t j = nx; j < nz; ++j)
            covariance[i * nz + j] = covariance[j * nz + i] = carried[i * nz + j];
    }
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

// A reading observes one entry of z, so the gain K is that column of P over the innovation's
// variance. The new P is Joseph's form, (I - K H) P (I - K H)' + K R K', which stays positive.
void Filter::correct(double *z, double *covariance, const Rows &rows, size_t row) {
    const size_t nz = 3 * n, axis = (size_t)rows.axis.data()[row];
    const double reading = noise.reading.data()[axis];
    const double innovation = rows.position.data()[row] - z[axis];
    const double variance = covariance[axis * nz + axis] + reading;
    const double nis = innovation * innovation / variance;

    int64_t *rejected = rows.rejected.data() + row * n;
    std::copy_n(rejected - n, n, rejected); // as after the sample before
    rejected[axis] = nis > outliers.nis_max ? rejected[axis] + 1 : 0;
    if (rejected[axis] == 0) {
        for (size_t i = 0; i < nz; ++i) {
            column[i] = covariance[i * nz + axis];
            gain[i] = column[i] / variance;
            z[i] += gain[i] * innovation;
        }
        for (size_t i = 0; i < nz; ++i) {
            const double left = column[i] - gain[i] * column[axis]; // (I - K H) P H'
            for (size_t j = i; j < nz; ++j)
                covariance[i * nz + j] = covariance[j * nz + i] =
                    covariance[i * nz + j] - gain[i] * column[j] - left * gain[j] +
                    gain[i] * reading * gain[j];
        }
    } else if (rejected[axis] % outliers.in_a_row == 0) {
        for (size_t i = 0; i < nz; ++i)
            covariance[i * nz + i] += noise.start.data()[i];
    }
    rows.nis.data()[row] = nis;
    std::copy_n(z, nz, rows.z.data() + row * nz);
    std::copy_n(covariance, nz * nz, rows.covariance.data() + row * nz * nz);
}
