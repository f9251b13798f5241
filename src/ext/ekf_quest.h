// The filter of R-BSN, methods/ekf_quest.py, step by step: its words hold here. P is kept as the upper triangle.
#pragma once

#include "filters.h"

namespace margcal {
namespace MARGCAL_LEVEL {

// QUEST of two directions, up and the field, with the weights 1 and w: methods/wahba.py `quest`.
template <class Real> struct Quest {
    Real a1, a2, north, up;  // weights that sum to one; the field's direction (0, north, up) in the earth frame
    Real squares, twice, along, across_square;
    Bool<Real> weighted;

    void begin(Real dip, Real weight) {
        const Real zero = splat<Real>(0), one = splat<Real>(1);
        weighted = is_finite(weight) & (weight > zero);
        const Real w = select(weighted, weight, zero);
        a1 = one / (one + w);
        a2 = w / (one + w);
        north = each(dip, [](double a) { return std::cos(a); });
        up = -each(dip, [](double a) { return std::sin(a); });
        const Real length = square_root(north * north + up * up);
        north = north / length;
        up = up / length;
        squares = a1 * a1 + a2 * a2;
        twice = 2.0 * a1 * a2;
        along = up;
        across_square = north * north;
    }

    // The quaternion of the unit vectors b and m (zero if it is not determined), not negative, and whether it is
    // determined.
    MARGCAL_INLINE Bool<Real> solve(Bool<Real> usable, const Real b[3], const Real m[3], Quaternion<Real>* out) const {
        const Real zero = splat<Real>(0);
        // eigenvalues, Shuster & Oh (72)
        const Real cx = b[1] * m[2] - b[2] * m[1], cy = b[2] * m[0] - b[0] * m[2], cz = b[0] * m[1] - b[1] * m[0];
        const Real cosines = (b[0] * m[0] + b[1] * m[1] + b[2] * m[2]) * along;
        const Real sines = square_root((cx * cx + cy * cy + cz * cz) * across_square);
        const Real lam = square_root(greatest(squares + twice * (cosines + sines), zero));
        const Real second = square_root(greatest(squares + twice * (cosines - sines), zero));
        const Real gap = 2.0 * twice * sines / greatest(lam + second, splat<Real>(1e-300));
        const Bool<Real> determined = usable & weighted & (gap > splat<Real>(1e-6));

        // K - lam, symmetric; B has the rows 0, a2 north m, a1 b + a2 up m
        const Real s = a2 * north;
        const Real u[3] = {a1 * b[0] + a2 * up * m[0], a1 * b[1] + a2 * up * m[1], a1 * b[2] + a2 * up * m[2]};
        const Real trace = s * m[1] + u[2];
        const Real k00 = trace - lam, k01 = u[1] - s * m[2], k02 = -u[0], k03 = s * m[0];
        const Real k11 = -trace - lam, k12 = s * m[0], k13 = u[0];
        const Real k22 = 2.0 * (s * m[1]) - trace - lam, k23 = s * m[2] + u[1], k33 = 2.0 * u[2] - trace - lam;

        // adjugate from 2x2 minors of the upper (p) and the lower (r) two rows
        const Real p01 = k00 * k11 - k01 * k01, p02 = k00 * k12 - k02 * k01, p03 = k00 * k13 - k03 * k01;
        const Real p12 = k01 * k12 - k02 * k11, p13 = k01 * k13 - k03 * k11, p23 = k02 * k13 - k03 * k12;
        const Real r02 = k02 * k23 - k22 * k03, r03 = k02 * k33 - k23 * k03, r12 = k12 * k23 - k22 * k13;
        const Real r13 = k12 * k33 - k23 * k13, r23 = k22 * k33 - k23 * k23;
        const Real d0 = k11 * r23 - k12 * r13 + k13 * r12, d1 = k00 * r23 - k02 * r03 + k03 * r02;
        const Real d2 = k03 * p13 - k13 * p03 + k33 * p01, d3 = k02 * p12 - k12 * p02 + k22 * p01;
        const Real e01 = -(k01 * r23 - k02 * r13 + k03 * r12);
        const Real e02 = k13 * p23 - k23 * p13 + k33 * p12, e03 = -(k12 * p23 - k22 * p13 + k23 * p12);
        const Real e12 = -(k03 * p23 - k23 * p03 + k33 * p02), e13 = k02 * p23 - k22 * p03 + k23 * p02;
        const Real e23 = -(k02 * p13 - k12 * p03 + k23 * p01);

        // the largest column
        Real best = absolute(d0);
        Quaternion<Real> q{d0, e01, e02, e03};
        const Real diagonal[3] = {absolute(d1), absolute(d2), absolute(d3)};
        const Quaternion<Real> column[3] = {{e01, d1, e12, e13}, {e02, e12, d2, e23}, {e03, e13, e23, d3}};
        for (int i = 0; i < 3; ++i) {
            const Bool<Real> larger = diagonal[i] > best;
            best = select(larger, diagonal[i], best);
            q.w = select(larger, column[i].w, q.w);
            q.x = select(larger, column[i].x, q.x);
            q.y = select(larger, column[i].y, q.y);
            q.z = select(larger, column[i].z, q.z);
        }
        const Real length = square_root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
        const Real signed_length = select(q.w < zero, -length, length);
        const Real scale = select(length > zero, splat<Real>(1) / signed_length, zero);
        out->w = select(determined, q.w * scale, zero);
        out->x = select(determined, q.x * scale, zero);
        out->y = select(determined, q.y * scale, zero);
        out->z = select(determined, q.z * scale, zero);
        return determined;
    }
};

// What a sample says without regard to the state: the step of (7), and the measurements (8) with their variances,
// infinite where there is none.
template <class Real> struct Measured {
    Real keep, reach, Q_ww, Q_wt, Q_tt;  // factor of the rate, seconds that the old rate turns on for; covariances
    Real gyr[3], R_w;
    Real q[4], R_q;          // QUEST's quaternion, zero without one
    Real up[3], R_up;        // unit vector of the accelerometer, where it is all there is
    Real flags;
    Bool<Real> tilt_only;
};

template <class Real> class EkfModel {
public:
    void begin(const Real* params) {
        gravity_ = params[0];
        field_ = params[1];
        mag_gate_ = params[3];
        tau_ = params[4];
        D_ = params[5];
        rate_variance_ = params[6] * params[6];
        quest_variance_ = 0.25 * (params[7] * params[7]);
        gap_ = params[9];
        quest_.begin(params[2], params[8]);
    }

    MARGCAL_INLINE void measure(const Reading<Real>& reading, Measured<Real>& out) const {
        const Real zero = splat<Real>(0), one = splat<Real>(1), never = splat<Real>(__builtin_inf());
        const Real dt = usable_step(reading.dt);
        rate_model(dt, out);
        const Bool<Real> seen = measured_rate(reading.gyr);
        for (int i = 0; i < 3; ++i) out.gyr[i] = select(seen, reading.gyr[i], zero);

        Real m[3], size, length;
        const Bool<Real> any_acc = unit_sample(reading.acc, 1e-100, out.up, &size);
        const Bool<Real> any_mag = unit_sample(reading.mag, 1e-100, m, &length);
        const Bool<Real> has_acc = size > splat<Real>(1e-12);
        length = select(length > splat<Real>(1e-12), length, zero);
        // not in the paper: densities; and the longer the specific force, the more its direction counts
        const Real density = one / greatest(least(dt, gap_), splat<Real>(SHORTEST_STEP));
        const Real R = quest_variance_ * density * gravity_ / select(has_acc, size, one);
        Quaternion<Real> z;
        const Bool<Real> fit = absolute(length / field_ - 1.0) < mag_gate_;
        const Bool<Real> both = quest_.solve(any_acc & any_mag, out.up, m, &z) & fit;  // (10)
        out.q[0] = select(both, z.w, zero);
        out.q[1] = select(both, z.x, zero);
        out.q[2] = select(both, z.y, zero);
        out.q[3] = select(both, z.z, zero);
        out.tilt_only = has_acc & no(both);
        const Bool<Real> gap = dt > gap_;  // a reading after a gap is no mean rate over it
        out.R_w = select(seen & no(gap), rate_variance_ * density, never);
        out.R_q = select(both, R, never);
        out.R_up = select(out.tilt_only, R, never);
        out.flags = when<Real>(has_acc, FLAG_ACC) + when<Real>(both, FLAG_MAG) + when<Real>(no(seen), FLAG_NO_GYR) +
                    when<Real>(gap, FLAG_GAP);
    }

private:
    Real gravity_, field_, mag_gate_, tau_, D_, rate_variance_, quest_variance_, gap_;
    Quest<Real> quest_;

    // 1 - exp(-a), by series where a is small enough
    static MARGCAL_INLINE Real forgotten(Real a) {
        if (any(a > splat<Real>(0.05))) return -each(a, [](double x) { return std::expm1(-x); });
        Real sum = splat<Real>(1.0 / 362880);
        for (int k = 8; k >= 1; --k) {
            double factorial = 1;
            for (int i = 2; i <= k; ++i) factorial *= i;
            sum = 1.0 / factorial - a * sum;
        }
        return a * sum;
    }

    // The angle is dt times the new rate: the gyroscope's reading is the mean rate since the last one.
    MARGCAL_INLINE void rate_model(Real dt, Measured<Real>& out) const {
        const Real u = forgotten(dt / tau_), variance = 0.5 * D_ / tau_ * u * (2.0 - u);
        out.keep = 1.0 - u;
        out.reach = dt * out.keep;
        out.Q_ww = variance;
        out.Q_wt = dt * variance;
        out.Q_tt = dt * dt * variance;
    }
};

template <class Real> class EkfQuest {
public:
    static constexpr std::size_t PARAMS = 10, STATE = 7 + 49;

    void begin(const Real* params, const Real* state) {
        model_.begin(params);
        for (int i = 0; i < 7; ++i) x_[i] = state[i];
        for (int i = 0; i < 7; ++i)
            for (int j = i; j < 7; ++j) P_[at(i, j)] = state[7 + 7 * i + j];
    }

    void end(Real* state) const {
        for (int i = 0; i < 7; ++i) state[i] = x_[i];
        for (int i = 0; i < 7; ++i)
            for (int j = 0; j < 7; ++j) state[7 + 7 * i + j] = P_[at(i < j ? i : j, i < j ? j : i)];
    }

    MARGCAL_INLINE Quaternion<Real> attitude() const { return {x_[3], x_[4], x_[5], x_[6]}; }

    MARGCAL_INLINE void variance(Real out[3]) const {
        Real t[3][4];
        earth_tangents(attitude(), t);
        MARGCAL_UNROLL
        for (int i = 0; i < 3; ++i) {
            Real cross = splat<Real>(0), square = splat<Real>(0);
            MARGCAL_UNROLL
            for (int a = 0; a < 4; ++a) {
                square += t[i][a] * t[i][a] * P_[at(3 + a, 3 + a)];
                MARGCAL_UNROLL
                for (int b = a + 1; b < 4; ++b) cross += t[i][a] * t[i][b] * P_[at(3 + a, 3 + b)];
            }
            out[i] = 4.0 * (square + 2.0 * cross);
        }
    }

    Real step(const Reading<Real>& reading) {
        Measured<Real> z;
        model_.measure(reading, z);
        advance(z);
        return z.flags;
    }

    void advance(const Measured<Real>& z) {
        predict(z);
        correct<0>(z.gyr[0], z.R_w);
        correct<1>(z.gyr[1], z.R_w);
        correct<2>(z.gyr[2], z.R_w);
        const Real same = x_[3] * z.q[0] + x_[4] * z.q[1] + x_[5] * z.q[2] + x_[6] * z.q[3];
        const Real sign = select(same < splat<Real>(0), splat<Real>(-1), splat<Real>(1));
        correct<3>(sign * z.q[0], z.R_q);
        correct<4>(sign * z.q[1], z.R_q);
        correct<5>(sign * z.q[2], z.R_q);
        correct<6>(sign * z.q[3], z.R_q);
        if (any(z.tilt_only)) correct_tilt(z.up, z.R_up);
        const Quaternion<Real> q = unit(attitude());
        x_[3] = q.w;
        x_[4] = q.x;
        x_[5] = q.y;
        x_[6] = q.z;
    }

private:
    Real x_[7], P_[28];
    EkfModel<Real> model_;

    // place of row i, column j >= i of the upper triangle
    static constexpr int at(int i, int j) { return i * 7 - i * (i - 1) / 2 + j - i; }
    static constexpr int sym(int i, int j) { return i < j ? at(i, j) : at(j, i); }

    // The solution of (7) over dt.
    MARGCAL_INLINE void predict(const Measured<Real>& z) {
        const Real keep = z.keep, reach = z.reach;
        const Quaternion<Real> turn = rotation_step(reach * x_[0], reach * x_[1], reach * x_[2]);
        const Quaternion<Real> q = product(attitude(), turn);  // (6)
        MARGCAL_UNROLL
        for (int i = 0; i < 3; ++i) x_[i] = keep * x_[i];
        x_[3] = q.w;
        x_[4] = q.x;
        x_[5] = q.y;
        x_[6] = q.z;

        // F = [keep 0; reach half, Rt], rows of half^T in h, Rt: multiplication by `turn` from the right
        Real h[3][4];
        body_tangents(q, h);
        MARGCAL_UNROLL
        for (int i = 0; i < 3; ++i)
            MARGCAL_UNROLL
            for (int k = 0; k < 4; ++k) h[i][k] = 0.5 * h[i][k];
        const Real Rt[4][4] = {{turn.w, -turn.x, -turn.y, -turn.z},
                               {turn.x, turn.w, turn.z, -turn.y},
                               {turn.y, -turn.z, turn.w, turn.x},
                               {turn.z, turn.y, -turn.x, turn.w}};
        Real A[4][3], C[4][4];  // second row of F times P: columns of the rate, of the quaternion
        MARGCAL_UNROLL
        for (int i = 0; i < 4; ++i) {
            const Real g[3] = {reach * h[0][i], reach * h[1][i], reach * h[2][i]};
            MARGCAL_UNROLL
            for (int j = 0; j < 3; ++j) {
                Real sum = g[0] * P_[sym(0, j)] + g[1] * P_[sym(1, j)] + g[2] * P_[sym(2, j)];
                MARGCAL_UNROLL
                for (int k = 0; k < 4; ++k) sum += Rt[i][k] * P_[at(j, 3 + k)];
                A[i][j] = sum;
            }
            MARGCAL_UNROLL
            for (int j = 0; j < 4; ++j) {
                Real sum = g[0] * P_[at(0, 3 + j)] + g[1] * P_[at(1, 3 + j)] + g[2] * P_[at(2, 3 + j)];
                MARGCAL_UNROLL
                for (int k = 0; k < 4; ++k) sum += Rt[i][k] * P_[sym(3 + k, 3 + j)];
                C[i][j] = sum;
            }
        }
        const Real keep_square = keep * keep;
        MARGCAL_UNROLL
        for (int i = 0; i < 3; ++i) {
            MARGCAL_UNROLL
            for (int j = i; j < 3; ++j) P_[at(i, j)] = keep_square * P_[at(i, j)];
            P_[at(i, i)] += z.Q_ww;
            MARGCAL_UNROLL
            for (int k = 0; k < 4; ++k) P_[at(i, 3 + k)] = keep * A[k][i] + z.Q_wt * h[i][k];
        }
        MARGCAL_UNROLL
        for (int i = 0; i < 4; ++i)
            MARGCAL_UNROLL
            for (int j = i; j < 4; ++j) {
                Real sum = reach * (A[i][0] * h[0][j] + A[i][1] * h[1][j] + A[i][2] * h[2][j]);
                MARGCAL_UNROLL
                for (int k = 0; k < 4; ++k) sum += C[i][k] * Rt[j][k];
                P_[at(3 + i, 3 + j)] = sum;
            }
        MARGCAL_UNROLL
        for (int i = 3; i < 7; ++i) P_[at(i, i)] += 0.25 * z.Q_tt;
    }

    // Kalman correction by z = x[ROW] + noise of variance R (infinite: not taken), (8).
    template <int ROW> MARGCAL_INLINE void correct(Real z, Real R) {
        Real p[7];
        MARGCAL_UNROLL
        for (int i = 0; i < 7; ++i) p[i] = P_[sym(i, ROW)];
        apply_gain(p, splat<Real>(1) / (p[ROW] + R), z - x_[ROW]);
    }

    MARGCAL_INLINE void apply_gain(const Real p[7], Real inverse, Real innovation) {
        Real gain[7];
        MARGCAL_UNROLL
        for (int i = 0; i < 7; ++i) gain[i] = p[i] * inverse;
        MARGCAL_UNROLL
        for (int i = 0; i < 7; ++i) x_[i] += gain[i] * innovation;
        MARGCAL_UNROLL
        for (int i = 0; i < 7; ++i)
            MARGCAL_UNROLL
            for (int j = i; j < 7; ++j) P_[at(i, j)] -= gain[i] * p[j];
    }

    // Not in the paper: the vertical alone, along the two 4-vectors that turn q about east and north.
    void correct_tilt(const Real b[3], Real R) {
        const Quaternion<Real> q = attitude();
        const Real before[4] = {q.w, q.x, q.y, q.z};
        Real f[3], t[3][4];
        to_earth(q, b, f);
        earth_tangents(q, t);
        const Real sine = each(f[0], f[1], [](double x, double y) { return std::hypot(x, y); });
        const Real half = 0.5 * each(sine, f[2], [](double x, double y) { return std::atan2(x, y); });
        const Bool<Real> sure = sine > splat<Real>(1e-9);
        const Real scale = select(sure, half / select(sure, sine, splat<Real>(1)), splat<Real>(0.5));
        const Real miss[2] = {scale * f[1], -scale * f[0]};
        for (int i = 0; i < 2; ++i) {
            Real p[7], S = R, done = splat<Real>(0);
            for (int j = 0; j < 7; ++j) {
                p[j] = splat<Real>(0);
                for (int k = 0; k < 4; ++k) p[j] += P_[sym(j, 3 + k)] * t[i][k];
            }
            for (int k = 0; k < 4; ++k) S += p[3 + k] * t[i][k];
            for (int k = 0; k < 4; ++k) done += (x_[3 + k] - before[k]) * t[i][k];
            apply_gain(p, splat<Real>(1) / S, miss[i] - done);
        }
    }
};

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
