// The filter that selects its vectors, methods/vector_selection.py: its words and equation numbers hold here.
#pragma once

#include "filters.h"

namespace margcal {
namespace MARGCAL_LEVEL {

template <class Real> class VectorSelection {
public:
    static constexpr std::size_t PARAMS = 11, STATE = 4 + 9;

    void begin(const Real* params, const Real* state) {
        gravity_ = params[0];
        field_ = params[1];
        dip_ = params[2];
        acc_gate_ = params[3];
        mag_gate_ = params[4];
        dip_gate_ = params[5];
        rate_variance_ = params[6] * params[6];
        acc_variance_ = params[7] * params[7];
        mag_variance_ = params[8] * params[8];
        unknown_rate_ = params[9];
        gap_ = params[10];
        const auto cosine = [](double a) { return std::cos(a); };
        cos_dip_ = each(dip_, cosine);
        sin_dip_ = each(dip_, [](double a) { return std::sin(a); });
        cos_gate_ = each(dip_gate_, cosine);
        plain_ = (absolute(dip_) < splat<Real>(1.57)) & (dip_gate_ >= splat<Real>(0)) & (dip_gate_ < splat<Real>(1.57));
        q_ = {state[0], state[1], state[2], state[3]};
        const Real* P = state + 4;
        P_[0] = P[0], P_[1] = P[1], P_[2] = P[2], P_[3] = P[4], P_[4] = P[5], P_[5] = P[8];
    }

    void end(Real* state) const {
        state[0] = q_.w, state[1] = q_.x, state[2] = q_.y, state[3] = q_.z;
        const Real full[9] = {P_[0], P_[1], P_[2], P_[1], P_[3], P_[4], P_[2], P_[4], P_[5]};
        for (int i = 0; i < 9; ++i) state[4 + i] = full[i];
    }

    MARGCAL_INLINE Quaternion<Real> attitude() const { return q_; }

    MARGCAL_INLINE void variance(Real out[3]) const { out[0] = P_[0], out[1] = P_[3], out[2] = P_[5]; }

    MARGCAL_INLINE Real step(const Reading<Real>& reading) {
        const Real dt = usable_step(reading.dt);
        Real flags = predict(reading, dt);
        const Real density = splat<Real>(1) / greatest(least(dt, gap_), splat<Real>(SHORTEST_STEP));
        flags += correct_tilt(reading.acc, density);
        return flags + correct_heading(reading.mag, density);
    }

private:
    Quaternion<Real> q_;
    Real P_[6];  // upper triangle, row by row
    Real gravity_, field_, dip_, acc_gate_, mag_gate_, dip_gate_, rate_variance_, acc_variance_, mag_variance_;
    Real unknown_rate_, gap_, cos_dip_, sin_dip_, cos_gate_;
    Bool<Real> plain_;  // an angle's cosine says whether it is within the gate of the dip

    MARGCAL_INLINE Real predict(const Reading<Real>& reading, Real dt) {
        const Real zero = splat<Real>(0);
        const Bool<Real> measured = measured_rate(reading.gyr), gap = dt > gap_, known = measured & no(gap);
        Real turn[3];
        for (int i = 0; i < 3; ++i) turn[i] = select(known, reading.gyr[i], zero) * dt;
        q_ = product(q_, rotation_step(turn[0], turn[1], turn[2]));  // (i)
        const Real blind = unknown_rate_ * dt, grown = select(known, rate_variance_ * dt, blind * blind);
        P_[0] += grown;  // (iv)
        P_[3] += grown;
        P_[5] += grown;
        return when<Real>(no(measured), FLAG_NO_GYR) + when<Real>(gap, FLAG_GAP);
    }

    MARGCAL_INLINE Real correct_tilt(const Real acc[3], Real density) {
        const Real zero = splat<Real>(0), one = splat<Real>(1), never = splat<Real>(__builtin_inf());
        Real b[3], f[3], length;
        const Bool<Real> good = unit_sample(acc, 1e-12, b, &length);
        const Bool<Real> use = good & (absolute(length / gravity_ - 1.0) < acc_gate_);
        const Real R = select(use, acc_variance_ * density, never);
        // not a unit vector: f_x and f_y are linear in the acceleration of the node, which averages to zero
        const Real scale = select(use, length / gravity_, one);
        for (Real& x : b) x = x * scale;
        to_earth(q_, b, f);
        Real theta[3] = {zero, zero, zero};
        const Real first[3] = {zero, one, zero}, second[3] = {-one, zero, zero};
        correct(theta, f[0], first, R);   // (v)
        correct(theta, f[1], second, R);  // (vi)
        turn(theta);
        return when<Real>(use, FLAG_ACC);
    }

    MARGCAL_INLINE Real correct_heading(const Real mag[3], Real density) {
        const Real zero = splat<Real>(0), one = splat<Real>(1), never = splat<Real>(__builtin_inf());
        Real b[3], h[3], length;
        const Bool<Real> good = unit_sample(mag, 1e-12, b, &length);
        to_earth(q_, b, h);
        const Real level = square_root(h[0] * h[0] + h[1] * h[1]);
        const Bool<Real> points = level > splat<Real>(1e-3);
        const Bool<Real> use =
            good & points & (absolute(length / field_ - 1.0) < mag_gate_) & dip_within(level, h[2], good & points);
        const Real R = select(use, mag_variance_ * density, never), safe = select(points, level, one);
        Real theta[3] = {zero, zero, zero};
        const Real row[3] = {zero, zero, -0.5 * (1.0 + h[1] / safe)};
        correct(theta, h[0] / safe, row, R);  // (vii)
        turn(theta);
        return when<Real>(use, FLAG_MAG);
    }

    // Whether the dip is within the gate: by its cosine, and by the angle itself where rounding could decide.
    MARGCAL_INLINE Bool<Real> dip_within(Real level, Real up, Bool<Real> matters) const {
        const Real cosine = level * cos_dip_ - up * sin_dip_;
        const Bool<Real> inside = cosine > cos_gate_;
        const Bool<Real> sure = plain_ & (absolute(cosine - cos_gate_) > splat<Real>(1e-12));
        if (!any(matters & no(sure))) return inside;
        const Real dip = each(-up, level, [](double y, double x) { return std::atan2(y, x); });
        return absolute(dip - dip_) < dip_gate_;
    }

    // Kalman correction by the scalar 0 = miss + row . theta + noise of variance R (infinite: not taken).
    MARGCAL_INLINE void correct(Real theta[3], Real miss, const Real row[3], Real R) {
        const Real p[3] = {P_[0] * row[0] + P_[1] * row[1] + P_[2] * row[2],
                           P_[1] * row[0] + P_[3] * row[1] + P_[4] * row[2],
                           P_[2] * row[0] + P_[4] * row[1] + P_[5] * row[2]};
        const Real inverse = splat<Real>(1) / (row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + R);
        const Real innovation = -(miss + row[0] * theta[0] + row[1] * theta[1] + row[2] * theta[2]);
        Real gain[3];
        for (int i = 0; i < 3; ++i) gain[i] = p[i] * inverse;
        for (int i = 0; i < 3; ++i) theta[i] += gain[i] * innovation;
        P_[0] -= gain[0] * p[0];
        P_[1] -= gain[0] * p[1];
        P_[2] -= gain[0] * p[2];
        P_[3] -= gain[1] * p[1];
        P_[4] -= gain[1] * p[2];
        P_[5] -= gain[2] * p[2];
    }

    MARGCAL_INLINE void turn(const Real theta[3]) {
        q_ = unit(product({splat<Real>(1), 0.5 * theta[0], 0.5 * theta[1], 0.5 * theta[2]}, q_));
    }
};

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
