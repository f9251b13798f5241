// The filter of ekf_quest.h for one node. What the samples say without regard to the state is worked out for
// several of them at once; the state is kept in short vectors, so that a correction is ten products instead of fifty.
#pragma once

#include "ekf_quest.h"

namespace margcal {
namespace MARGCAL_LEVEL {

typedef double Four __attribute__((vector_size(4 * sizeof(double))));

MARGCAL_INLINE double dot(Four a, Four b) {
    const Four c = a * b;
    return (c[0] + c[1]) + (c[2] + c[3]);
}

class EkfQuestOne {
public:
    void begin(const double* params, const double* state) {
        Lanes wide[EkfQuest<double>::PARAMS];
        for (std::size_t i = 0; i < EkfQuest<double>::PARAMS; ++i) wide[i] = fill(params[i]);
        model_.begin(wide);
        const double* P = state + 7;
        w_ = Four{state[0], state[1], state[2], 0};
        q_ = Four{state[3], state[4], state[5], state[6]};
        for (int i = 0; i < 3; ++i) P_ww_[i] = Four{P[7 * i], P[7 * i + 1], P[7 * i + 2], 0};
        for (int i = 0; i < 3; ++i) P_wq_[i] = Four{P[7 * i + 3], P[7 * i + 4], P[7 * i + 5], P[7 * i + 6]};
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j < 4; ++j) P_qq_[i][j] = P[7 * (i < j ? 3 + i : 3 + j) + (i < j ? 3 + j : 3 + i)];
    }

    void end(double* state) const {
        double* P = state + 7;
        for (int i = 0; i < 3; ++i) {
            state[i] = w_[i];
            for (int j = 0; j < 3; ++j) P[7 * i + j] = P_ww_[i][j];
            for (int j = 0; j < 4; ++j) P[7 * i + 3 + j] = P[7 * (3 + j) + i] = P_wq_[i][j];
        }
        for (int i = 0; i < 4; ++i) {
            state[3 + i] = q_[i];
            for (int j = 0; j < 4; ++j) P[7 * (3 + i) + 3 + j] = P_qq_[i][j];
        }
    }

    void run(const FilterJob& job, std::size_t node) {
        const std::size_t n = job.samples, base = node * n;
        for (std::size_t first = 0; first < n; first += LANES) {
            const std::size_t count = n - first < LANES ? n - first : LANES;
            Reading<Lanes> reading{};
            for (std::size_t i = 0; i < LANES; ++i) {
                const std::size_t k = base + first + (i < count ? i : count - 1);
                reading.dt[i] = job.dt[k];
                for (std::size_t c = 0; c < 3; ++c) {
                    reading.gyr[c][i] = job.gyr[3 * k + c];
                    reading.acc[c][i] = job.acc[3 * k + c];
                    reading.mag[c][i] = job.mag[3 * k + c];
                }
            }
            Measured<Lanes> z;
            model_.measure(reading, z);
            for (std::size_t i = 0; i < count; ++i) {
                step(z, i);
                const std::size_t k = base + first + i;
                __builtin_memcpy(job.q + 4 * k, &q_, sizeof q_);
                variance(job.variance + 3 * k);
                job.flags[k] = std::uint8_t(z.flags[i]);
            }
        }
    }

private:
    EkfModel<Lanes> model_;
    Four w_, q_;                          // rate (its last lane is not used), quaternion
    Four P_ww_[3], P_wq_[3], P_qq_[4];    // rows of P: rate by rate, rate by quaternion, quaternion by quaternion

    MARGCAL_INLINE Quaternion<double> attitude() const { return {q_[0], q_[1], q_[2], q_[3]}; }

    MARGCAL_INLINE void step(const Measured<Lanes>& z, std::size_t k) {
        predict(z, k);
        for (int i = 0; i < 3; ++i) correct(P_ww_[i], P_wq_[i], P_ww_[i][i] + z.R_w[k], z.gyr[i][k] - w_[i]);  // (8)
        const Four measured = {z.q[0][k], z.q[1][k], z.q[2][k], z.q[3][k]};
        const double sign = dot(q_, measured) < 0 ? -1.0 : 1.0;
        for (int i = 0; i < 4; ++i) {
            const Four by_rate = {P_wq_[0][i], P_wq_[1][i], P_wq_[2][i], 0};
            correct(by_rate, P_qq_[i], P_qq_[i][i] + z.R_q[k], sign * measured[i] - q_[i]);  // (8)
        }
        if (z.tilt_only[k]) {
            const double up[3] = {z.up[0][k], z.up[1][k], z.up[2][k]};
            correct_tilt(up, z.R_up[k]);
        }
        q_ *= 1.0 / std::sqrt(dot(q_, q_));
    }

    // The solution of (7).
    MARGCAL_INLINE void predict(const Measured<Lanes>& z, std::size_t k) {
        const double keep = z.keep[k], reach = z.reach[k], Q_wt = z.Q_wt[k], Q_tt = 0.25 * z.Q_tt[k];
        const Quaternion<double> turn = rotation_step(reach * w_[0], reach * w_[1], reach * w_[2]);
        const Quaternion<double> q = product(attitude(), turn);  // (6)
        w_ *= keep;
        q_ = Four{q.w, q.x, q.y, q.z};
        const Four half[3] = {0.5 * Four{-q.x, q.w, q.z, -q.y}, 0.5 * Four{-q.y, -q.z, q.w, q.x},
                              0.5 * Four{-q.z, q.y, -q.x, q.w}};
        const Four g[3] = {reach * half[0], reach * half[1], reach * half[2]};
        // columns of multiplication by `turn` from the right
        const Four Rt[4] = {{turn.w, turn.x, turn.y, turn.z},
                            {-turn.x, turn.w, -turn.z, turn.y},
                            {-turn.y, turn.z, turn.w, -turn.x},
                            {-turn.z, -turn.y, turn.x, turn.w}};
        Four A[3], C[4];  // columns of the lower half of F P: of the rate, of the quaternion
        for (int j = 0; j < 3; ++j) {
            A[j] = g[0] * P_ww_[j][0] + g[1] * P_ww_[j][1] + g[2] * P_ww_[j][2];
            for (int i = 0; i < 4; ++i) A[j] += Rt[i] * P_wq_[j][i];
        }
        for (int j = 0; j < 4; ++j) {
            C[j] = g[0] * P_wq_[0][j] + g[1] * P_wq_[1][j] + g[2] * P_wq_[2][j];
            for (int i = 0; i < 4; ++i) C[j] += Rt[i] * P_qq_[j][i];
        }
        const double keep_square = keep * keep;
        for (int i = 0; i < 3; ++i) {
            P_ww_[i] *= keep_square;
            P_ww_[i][i] += z.Q_ww[k];
            P_wq_[i] = keep * A[i] + Q_wt * half[i];
        }
        Four full[4];
        for (int j = 0; j < 4; ++j) {
            full[j] = A[0] * g[0][j] + A[1] * g[1][j] + A[2] * g[2][j];
            for (int i = 0; i < 4; ++i) full[j] += C[i] * Rt[i][j];
            full[j][j] += Q_tt;
        }
        // rounding must not pull the two halves apart
        for (int i = 0; i < 4; ++i) {
            const Four across = {full[0][i], full[1][i], full[2][i], full[3][i]};
            P_qq_[i] = 0.5 * (full[i] + across);
        }
    }

    // Kalman correction by a scalar: p_w, p_q are P times its row, S its variance.
    MARGCAL_INLINE void correct(const Four p_w, const Four p_q, double S, double innovation) {
        const double inverse = 1.0 / S;
        const Four gain_w = p_w * inverse, gain_q = p_q * inverse;
        w_ += gain_w * innovation;
        q_ += gain_q * innovation;
        for (int i = 0; i < 3; ++i) {
            P_ww_[i] -= gain_w[i] * p_w;
            P_wq_[i] -= gain_w[i] * p_q;
        }
        for (int i = 0; i < 4; ++i) P_qq_[i] -= gain_q[i] * p_q;
    }

    // Not in the paper: the vertical alone; see EkfQuest::correct_tilt.
    void correct_tilt(const double up[3], double R) {
        const Quaternion<double> q = attitude();
        const Four before = q_;
        double f[3], t[3][4];
        to_earth(q, up, f);
        earth_tangents(q, t);
        const double sine = std::hypot(f[0], f[1]), half = 0.5 * std::atan2(sine, f[2]);
        const double scale = sine > 1e-9 ? half / sine : 0.5;
        const double miss[2] = {scale * f[1], -scale * f[0]};
        for (int i = 0; i < 2; ++i) {
            const Four h = {t[i][0], t[i][1], t[i][2], t[i][3]};
            const Four p_w = {dot(P_wq_[0], h), dot(P_wq_[1], h), dot(P_wq_[2], h), 0};
            const Four p_q = P_qq_[0] * h[0] + P_qq_[1] * h[1] + P_qq_[2] * h[2] + P_qq_[3] * h[3];
            correct(p_w, p_q, dot(p_q, h) + R, miss[i] - dot(q_ - before, h));
        }
    }

    MARGCAL_INLINE void variance(double* out) const {
        double t[3][4];
        earth_tangents(attitude(), t);
        for (int i = 0; i < 3; ++i) {
            const Four h = {t[i][0], t[i][1], t[i][2], t[i][3]};
            out[i] = 4.0 * dot(P_qq_[0] * h[0] + P_qq_[1] * h[1] + P_qq_[2] * h[2] + P_qq_[3] * h[3], h);
        }
    }
};

inline void ekf_quest_one(const FilterJob& job, std::size_t node) {
    EkfQuestOne filter;
    double* state = job.state + node * EkfQuest<double>::STATE;
    filter.begin(job.params + node * EkfQuest<double>::PARAMS, state);
    filter.run(job, node);
    filter.end(state);
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
