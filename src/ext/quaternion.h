// Quaternions (scalar first, Hamilton) and sines by series, for one node (double) or several (Lanes).
#pragma once

#include "lanes.h"

namespace margcal {
namespace MARGCAL_LEVEL {

template <class Real> struct Quaternion {
    Real w, x, y, z;
};

template <class Real> MARGCAL_INLINE Quaternion<Real> product(const Quaternion<Real>& a, const Quaternion<Real>& b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

template <class Real> MARGCAL_INLINE Quaternion<Real> unit(const Quaternion<Real>& q) {
    const Real scale = splat<Real>(1) / square_root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    return {q.w * scale, q.x * scale, q.y * scale, q.z * scale};
}

// Cosine and sin(a) / a of half the angle by series in its square: so many terms leave out less than 2e-16 up to so
// large a square. The short one is good for 360 deg/s at 100 samples a second.
constexpr double SHORT_LIMIT = 0.001, LONG_LIMIT = 1.0;
constexpr int SHORT_TERMS = 4, LONG_TERMS = 10;

// sum over k of (-x)^k / (2 k + FIRST)!, FIRST 0: cosine, 1: sine over angle
template <int TERMS, int FIRST, class Real> MARGCAL_INLINE Real series(Real x) {
    double factor[TERMS];
    factor[0] = 1.0;
    for (int k = 1; k < TERMS; ++k) factor[k] = -factor[k - 1] / ((2 * k + FIRST) * (2 * k + FIRST - 1));
    Real sum = splat<Real>(factor[TERMS - 1]);
    for (int k = TERMS - 2; k >= 0; --k) sum = sum * x + factor[k];
    return sum;
}

// Quaternion of the rotation vector (x, y, z), rad.
template <class Real> MARGCAL_INLINE Quaternion<Real> rotation_step(Real x, Real y, Real z) {
    const Real square = 0.25 * (x * x + y * y + z * z);
    if (!any(square > splat<Real>(SHORT_LIMIT))) {
        const Real sinc = 0.5 * series<SHORT_TERMS, 1>(square);
        return {series<SHORT_TERMS, 0>(square), sinc * x, sinc * y, sinc * z};
    }
    if (!any(square > splat<Real>(LONG_LIMIT))) {
        const Real sinc = 0.5 * series<LONG_TERMS, 1>(square);
        return {series<LONG_TERMS, 0>(square), sinc * x, sinc * y, sinc * z};
    }
    const Real half = square_root(square);
    const Real sinc = 0.5 * each(half, [](double a) { return a < 1e-8 ? 1.0 : std::sin(a) / a; });
    return {each(half, [](double a) { return std::cos(a); }), sinc * x, sinc * y, sinc * z};
}

// q v q+
template <class Real> MARGCAL_INLINE void to_earth(const Quaternion<Real>& q, const Real v[3], Real out[3]) {
    const Real p = 2.0 * (q.y * v[2] - q.z * v[1]), r = 2.0 * (q.z * v[0] - q.x * v[2]);
    const Real s = 2.0 * (q.x * v[1] - q.y * v[0]);
    out[0] = v[0] + q.w * p + q.y * s - q.z * r;
    out[1] = v[1] + q.w * r + q.z * p - q.x * s;
    out[2] = v[2] + q.w * s + q.x * r - q.y * p;
}

// Rows: the unit 4-vectors along which q moves when turned about east, north, up.
template <class Real> MARGCAL_INLINE void earth_tangents(const Quaternion<Real>& q, Real t[3][4]) {
    t[0][0] = -q.x, t[0][1] = q.w, t[0][2] = -q.z, t[0][3] = q.y;
    t[1][0] = -q.y, t[1][1] = q.z, t[1][2] = q.w, t[1][3] = -q.x;
    t[2][0] = -q.z, t[2][1] = -q.y, t[2][2] = q.x, t[2][3] = q.w;
}

// Rows: the same when turned about the node's own axes.
template <class Real> MARGCAL_INLINE void body_tangents(const Quaternion<Real>& q, Real t[3][4]) {
    t[0][0] = -q.x, t[0][1] = q.w, t[0][2] = q.z, t[0][3] = -q.y;
    t[1][0] = -q.y, t[1][1] = -q.z, t[1][2] = q.w, t[1][3] = q.x;
    t[2][0] = -q.z, t[2][1] = q.y, t[2][2] = -q.x, t[2][3] = q.w;
}

// Unit vector (zero if there is no direction), its length (zero then), and whether it has a direction.
template <class Real> MARGCAL_INLINE Bool<Real> unit_sample(const Real v[3], double least, Real out[3], Real* length) {
    const Real zero = splat<Real>(0), one = splat<Real>(1);
    const Real size = square_root(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    const Bool<Real> good = (size > splat<Real>(least)) & (size < splat<Real>(__builtin_inf()));
    *length = select(good, size, zero);
    const Real scale = one / select(good, size, one);
    for (int i = 0; i < 3; ++i) out[i] = select(good, v[i] * scale, zero);
    return good;
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
