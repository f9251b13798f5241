// Integration of the gyroscope over one turn, and its derivatives: methods/preintegration.py, equation by equation.
//
// The product of rotations is associative, so a turn is cut into as many stretches of time as there are lanes; what the stretches
// amount to is put together at the end. `pack` lays the samples out that way, once for all sensors that are tried on it:
// for each step x, y, z of the readings and the interval, all lanes of each.
#pragma once

#include "kernels.h"
#include "lanes.h"
#include "quaternion.h"

namespace margcal {
namespace MARGCAL_LEVEL {

inline void pack(const TurnView& turn, double* packed) {
    const std::size_t steps = (turn.n + LANES - 1) / LANES;
    for (std::size_t lane = 0; lane < LANES; ++lane) {
        for (std::size_t i = 0; i < steps; ++i) {
            const std::size_t k = lane * steps + i, last = turn.n - 1;
            const double* reading = turn.y + 3 * (k < turn.n ? k : last);
            double* place = packed + 4 * LANES * i + lane;
            for (std::size_t c = 0; c < 3; ++c) place[LANES * c] = reading[c];
            place[3 * LANES] = k < turn.n ? turn.dt[k] : 0.0;  // no time: no rotation
        }
    }
}

struct Sensor {
    Lanes H[9], B[3];

    explicit Sensor(const SensorView& s) {
        for (int i = 0; i < 9; ++i) H[i] = fill(s.H[i]);
        for (int i = 0; i < 3; ++i) B[i] = fill(s.B[i]);
    }
};

struct Sample {
    Lanes z[3];    // readings less bias
    Lanes phi[3];  // rotation vector (52), or `part` of it
    Lanes dt;

    MARGCAL_INLINE Sample(const double* packed, const Sensor& s, double part = 1.0) {
        dt = part * load(packed + 3 * LANES);
        for (std::size_t c = 0; c < 3; ++c) z[c] = load(packed + LANES * c) - s.B[c];
        for (int i = 0; i < 3; ++i) phi[i] = (s.H[3 * i] * z[0] + s.H[3 * i + 1] * z[1] + s.H[3 * i + 2] * z[2]) * dt;
    }
};

// The stretches one after the other.
inline void join(const Quaternion<Lanes>& stretch, double q[4]) {
    Quaternion<double> total{stretch.w[0], stretch.x[0], stretch.y[0], stretch.z[0]};
    for (std::size_t i = 1; i < LANES; ++i)
        total = product(total, Quaternion<double>{stretch.w[i], stretch.x[i], stretch.y[i], stretch.z[i]});
    q[0] = total.w;
    q[1] = total.x;
    q[2] = total.y;
    q[3] = total.z;
}

// False if a sample turns further than the series reaches: then q says nothing.
template <int TERMS> inline bool integrate_series(const double* packed, std::size_t n, const Sensor& s, double q[4]) {
    const Lanes limit = fill(TERMS == SHORT_TERMS ? SHORT_LIMIT : LONG_LIMIT);
    Quaternion<Lanes> total{fill(1), fill(0), fill(0), fill(0)};
    Mask beyond = fill(0) > limit;
    const std::size_t steps = (n + LANES - 1) / LANES;
    for (std::size_t i = 0; i < steps; ++i) {
        const Sample half(packed + 4 * LANES * i, s, 0.5);
        const Lanes x = half.phi[0], y = half.phi[1], z = half.phi[2];
        const Lanes square = x * x + y * y + z * z;
        beyond |= square > limit;
        const Lanes sinc = series<TERMS, 1>(square);
        total = product(total, {series<TERMS, 0>(square), sinc * x, sinc * y, sinc * z});  //            (53), (54)
    }
    join(total, q);
    return !any(beyond);
}

// Turns of more than two radians a sample: nothing that a gyroscope does, but not a reason to be wrong.
inline void integrate_any(const double* packed, std::size_t n, const Sensor& s, double q[4]) {
    Quaternion<Lanes> total{fill(1), fill(0), fill(0), fill(0)};
    const std::size_t steps = (n + LANES - 1) / LANES;
    for (std::size_t i = 0; i < steps; ++i) {
        const Sample half(packed + 4 * LANES * i, s, 0.5);
        const Lanes x = half.phi[0], y = half.phi[1], z = half.phi[2];
        const Lanes angle = square_root(x * x + y * y + z * z);
        Lanes sinc, cosine;
        for (std::size_t k = 0; k < LANES; ++k) {
            sinc[k] = angle[k] == 0 ? 1.0 : std::sin(angle[k]) / angle[k];
            cosine[k] = std::cos(angle[k]);
        }
        total = product(total, {cosine, sinc * x, sinc * y, sinc * z});
    }
    join(total, q);
}

inline void integrate(const double* packed, std::size_t n, const SensorView& view, double q[4]) {
    const Sensor sensor(view);
    if (integrate_series<SHORT_TERMS>(packed, n, sensor, q)) return;
    if (integrate_series<LONG_TERMS>(packed, n, sensor, q)) return;
    integrate_any(packed, n, sensor, q);
}

// 3 x 3 matrices, row by row.
template <class Real> MARGCAL_INLINE void multiply(const Real* a, const Real* b, Real* out) {
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) out[3 * i + k] = a[3 * i] * b[k] + a[3 * i + 1] * b[3 + k] + a[3 * i + 2] * b[6 + k];
}

template <class Real> MARGCAL_INLINE void transpose_multiply(const Real* a, const Real* b, Real* out) {
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) out[3 * i + k] = a[i] * b[k] + a[3 + i] * b[3 + k] + a[6 + i] * b[6 + k];
}

// I + first [v]x + second [v]x^2
MARGCAL_INLINE void rodrigues(const Lanes v[3], Lanes first, Lanes second, Lanes out[9]) {
    const Lanes fx = first * v[0], fy = first * v[1], fz = first * v[2];
    const Lanes xx = v[0] * v[0], yy = v[1] * v[1], zz = v[2] * v[2];
    const Lanes xy = second * v[0] * v[1], xz = second * v[0] * v[2], yz = second * (v[1] * v[2]);
    out[0] = 1.0 - second * (yy + zz);
    out[1] = xy - fz;
    out[2] = xz + fy;
    out[3] = xy + fz;
    out[4] = 1.0 - second * (xx + zz);
    out[5] = yz - fx;
    out[6] = xz - fy;
    out[7] = yz + fx;
    out[8] = 1.0 - second * (xx + yy);
}

constexpr double ANGLE_LIMIT = 0.1;  // square of the angle up to which six terms leave out less than 2e-16

template <int FIRST> MARGCAL_INLINE Lanes sinc_term(Lanes x) {
    double factor[6];
    factor[0] = FIRST == 1 ? 1.0 : FIRST == 2 ? 1.0 / 2 : 1.0 / 6;
    for (int k = 1; k < 6; ++k) factor[k] = -factor[k - 1] / ((2 * k + FIRST) * (2 * k + FIRST - 1));
    Lanes sum = fill(factor[5]);
    for (int k = 4; k >= 0; --k) sum = sum * x + factor[k];
    return sum;
}

// sin(a) / a, (1 - cos a) / a^2, (a - sin a) / a^3 from the square of a
MARGCAL_INLINE void sinc_terms(Lanes square, Lanes out[3]) {
    out[0] = sinc_term<1>(square);
    out[1] = sinc_term<2>(square);
    out[2] = sinc_term<3>(square);
    if (!any(square > fill(ANGLE_LIMIT))) return;
    for (std::size_t k = 0; k < LANES; ++k) {
        if (!(square[k] > ANGLE_LIMIT)) continue;
        const double a = std::sqrt(square[k]), half = std::sin(a / 2);
        out[0][k] = std::sin(a) / a;
        out[1][k] = 2 * half * half / square[k];
        out[2][k] = (a - std::sin(a)) / (a * square[k]);
    }
}

// Sums over the samples of one stretch in the frame at its start: dR, sum A z^T, sum A, sum A noise A^T.
template <class Real> struct Sums {
    Real P[9], Az[27], A[9], gram[9];
};

inline void add_sample(Sums<Lanes>& sums, const Sample& sample, const Lanes noise[9]) {
    Lanes terms[3], E[9], J[9], A[9], next[9];
    sinc_terms(sample.phi[0] * sample.phi[0] + sample.phi[1] * sample.phi[1] + sample.phi[2] * sample.phi[2], terms);
    rodrigues(sample.phi, terms[0], terms[1], E);
    rodrigues(sample.phi, terms[1], terms[2], J);
    multiply(sums.P, J, A);
    for (int i = 0; i < 9; ++i) {
        A[i] = A[i] * sample.dt;
        sums.A[i] += A[i];
    }
    for (int i = 0; i < 3; ++i)
        for (int a = 0; a < 3; ++a)
            for (int k = 0; k < 3; ++k) sums.Az[9 * i + 3 * a + k] += A[3 * i + a] * sample.z[k];
    Lanes half[9];
    multiply(A, noise, half);
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            sums.gram[3 * i + k] += half[3 * i] * A[3 * k] + half[3 * i + 1] * A[3 * k + 1] + half[3 * i + 2] * A[3 * k + 2];
    multiply(sums.P, E, next);
    for (int i = 0; i < 9; ++i) sums.P[i] = next[i];
}

// The stretches one after the other, each turned by those before it.
inline void join(const Sums<Lanes>& stretches, Sums<double>& total) {
    total = Sums<double>{};
    total.P[0] = total.P[4] = total.P[8] = 1;
    double turned[27], part[27], back[9];
    for (std::size_t lane = 0; lane < LANES; ++lane) {
        for (int i = 0; i < 27; ++i) part[i] = stretches.Az[i][lane];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 9; ++j)
                total.Az[9 * i + j] += total.P[3 * i] * part[j] + total.P[3 * i + 1] * part[9 + j] + total.P[3 * i + 2] * part[18 + j];
        for (int i = 0; i < 9; ++i) part[i] = stretches.A[i][lane];
        multiply(total.P, part, turned);
        for (int i = 0; i < 9; ++i) total.A[i] += turned[i];
        for (int i = 0; i < 9; ++i) part[i] = stretches.gram[i][lane];
        multiply(total.P, part, turned);
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) back[3 * i + k] = total.P[3 * k + i];
        multiply(turned, back, part);
        for (int i = 0; i < 9; ++i) total.gram[i] += part[i];
        for (int i = 0; i < 9; ++i) part[i] = stretches.P[i][lane];
        multiply(total.P, part, turned);
        for (int i = 0; i < 9; ++i) total.P[i] = turned[i];
    }
}

inline void preintegrate(const double* packed, std::size_t n, const SensorView& view, const double noise[9],
                         Rotation& out) {
    const Sensor sensor(view);
    Lanes wide_noise[9];
    for (int i = 0; i < 9; ++i) wide_noise[i] = fill(noise[i]);
    Sums<Lanes> sums;
    for (int i = 0; i < 27; ++i) sums.Az[i] = fill(0);
    for (int i = 0; i < 9; ++i) {
        sums.P[i] = fill(i % 4 ? 0 : 1);
        sums.A[i] = sums.gram[i] = fill(0);
    }
    const std::size_t steps = (n + LANES - 1) / LANES;
    for (std::size_t i = 0; i < steps; ++i) add_sample(sums, Sample(packed + 4 * LANES * i, sensor), wide_noise);

    Sums<double> total;
    join(sums, total);
    double turned[9];
    for (int i = 0; i < 9; ++i) out.dR[i] = total.P[i];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 9; ++j)
            out.J_H[9 * i + j] =
                total.P[i] * total.Az[j] + total.P[3 + i] * total.Az[9 + j] + total.P[6 + i] * total.Az[18 + j];
    transpose_multiply(total.P, total.A, turned);
    multiply(turned, view.H, out.J_B);
    for (double& x : out.J_B) x = -x;
    transpose_multiply(total.P, total.gram, turned);
    multiply(turned, total.P, out.C);
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
