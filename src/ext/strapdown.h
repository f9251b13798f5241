// The gyroscope alone, integrated: methods/strapdown.py.
#pragma once

#include "filters.h"

namespace margcal {
namespace MARGCAL_LEVEL {

template <class Real> class Strapdown {
public:
    static constexpr std::size_t PARAMS = 3, STATE = 4 + 3;

    void begin(const Real* params, const Real* state) {
        rate_variance_ = params[0] * params[0];
        unknown_rate_ = params[1];
        gap_ = params[2];
        q_ = {state[0], state[1], state[2], state[3]};
        for (int i = 0; i < 3; ++i) variance_[i] = state[4 + i];
    }

    void end(Real* state) const {
        state[0] = q_.w, state[1] = q_.x, state[2] = q_.y, state[3] = q_.z;
        for (int i = 0; i < 3; ++i) state[4 + i] = variance_[i];
    }

    MARGCAL_INLINE Quaternion<Real> attitude() const { return q_; }

    MARGCAL_INLINE void variance(Real out[3]) const {
        for (int i = 0; i < 3; ++i) out[i] = variance_[i];
    }

    MARGCAL_INLINE Real step(const Reading<Real>& reading) {
        const Real zero = splat<Real>(0), dt = usable_step(reading.dt);
        const Bool<Real> measured = measured_rate(reading.gyr), gap = dt > gap_, known = measured & no(gap);
        Real turn[3];
        for (int i = 0; i < 3; ++i) turn[i] = select(known, reading.gyr[i], zero) * dt;
        q_ = unit(product(q_, rotation_step(turn[0], turn[1], turn[2])));
        const Real blind = unknown_rate_ * dt, grown = select(known, rate_variance_ * dt, blind * blind);
        for (Real& v : variance_) v += grown;
        return when<Real>(no(measured), FLAG_NO_GYR) + when<Real>(gap, FLAG_GAP);
    }

private:
    Quaternion<Real> q_;
    Real variance_[3], rate_variance_, unknown_rate_, gap_;
};

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
