// u = H (y - B), row by row. On long recordings memory is the limit: results then go past the cache.
#pragma once

#include "kernels.h"
#include "lanes.h"

#if defined(__AVX__)
#include <immintrin.h>
#elif defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace margcal {
namespace MARGCAL_LEVEL {

// B is subtracted first: raw counts are large, and H y - H B would lose their last digits.
inline void apply_row(const double* y, const double* H, const double* B, double* u) {
    const double x0 = y[0] - B[0], x1 = y[1] - B[1], x2 = y[2] - B[2];
    u[0] = H[0] * x0 + H[1] * x1 + H[2] * x2;
    u[1] = H[3] * x0 + H[4] * x1 + H[5] * x2;
    u[2] = H[6] * x0 + H[7] * x1 + H[8] * x2;
}

constexpr std::size_t BEYOND_CACHE = 1 << 18;  // rows: 6 MB of results

#if defined(__AVX__)

// Four rows as three vectors of which each half holds a pair of values of one or two neighbouring rows.
constexpr std::size_t GROUP = 4;
using Vector = __m256d;
MARGCAL_INLINE Vector all(double x) { return _mm256_set1_pd(x); }
MARGCAL_INLINE Vector take(const double* y) {
    return _mm256_insertf128_pd(_mm256_castpd128_pd256(_mm_loadu_pd(y)), _mm_loadu_pd(y + 6), 1);
}
template <bool STREAM> MARGCAL_INLINE void put(double* u, Vector v) {
    const __m128d low = _mm256_castpd256_pd128(v), high = _mm256_extractf128_pd(v, 1);
    STREAM ? _mm_stream_pd(u, low) : _mm_store_pd(u, low);
    STREAM ? _mm_stream_pd(u + 6, high) : _mm_store_pd(u + 6, high);
}
MARGCAL_INLINE Vector first_second(Vector a, Vector b) { return _mm256_shuffle_pd(a, b, 0b1010); }
MARGCAL_INLINE Vector second_first(Vector a, Vector b) { return _mm256_shuffle_pd(a, b, 0b0101); }
MARGCAL_INLINE Vector firsts(Vector a, Vector b) { return _mm256_unpacklo_pd(a, b); }
MARGCAL_INLINE Vector seconds(Vector a, Vector b) { return _mm256_unpackhi_pd(a, b); }

#elif defined(__SSE2__)

constexpr std::size_t GROUP = 2;
using Vector = __m128d;
MARGCAL_INLINE Vector all(double x) { return _mm_set1_pd(x); }
MARGCAL_INLINE Vector take(const double* y) { return _mm_loadu_pd(y); }
template <bool STREAM> MARGCAL_INLINE void put(double* u, Vector v) {
    STREAM ? _mm_stream_pd(u, v) : _mm_store_pd(u, v);
}
MARGCAL_INLINE Vector first_second(Vector a, Vector b) { return _mm_shuffle_pd(a, b, 0b10); }
MARGCAL_INLINE Vector second_first(Vector a, Vector b) { return _mm_shuffle_pd(a, b, 0b01); }
MARGCAL_INLINE Vector firsts(Vector a, Vector b) { return _mm_unpacklo_pd(a, b); }
MARGCAL_INLINE Vector seconds(Vector a, Vector b) { return _mm_unpackhi_pd(a, b); }

#endif

#if defined(__SSE2__)
// GROUP rows at a time, in the order of `apply_row`; u is on a multiple of 16 bytes.
template <bool STREAM> inline void apply_groups(const double* y, std::size_t n, const double* H, const double* B, double* u) {
    Vector h[9], b[3];
    for (int i = 0; i < 9; ++i) h[i] = all(H[i]);
    for (int i = 0; i < 3; ++i) b[i] = all(B[i]);
    for (std::size_t k = 0; k + GROUP <= n; k += GROUP, y += 3 * GROUP, u += 3 * GROUP) {
        const Vector a0 = take(y), a1 = take(y + 2), a2 = take(y + 4);  // x0 y0, z0 x1, y1 z1 of each two rows
        const Vector x[3] = {first_second(a0, a1) - b[0], second_first(a0, a2) - b[1], first_second(a1, a2) - b[2]};
        Vector r[3];
        for (int i = 0; i < 3; ++i) r[i] = h[3 * i] * x[0] + h[3 * i + 1] * x[1] + h[3 * i + 2] * x[2];
        put<STREAM>(u, firsts(r[0], r[1]));
        put<STREAM>(u + 2, first_second(r[2], r[0]));
        put<STREAM>(u + 4, seconds(r[1], r[2]));
    }
    if (STREAM) _mm_sfence();
}
#endif

inline void apply(const double* y, std::size_t n, const double* H, const double* B, double* u) {
    std::size_t done = 0;
#if defined(__SSE2__)
    if (reinterpret_cast<std::uintptr_t>(u) % 16 == 0) {
        n >= BEYOND_CACHE ? apply_groups<true>(y, n, H, B, u) : apply_groups<false>(y, n, H, B, u);
        done = n - n % GROUP;
    }
#endif
    for (std::size_t k = done; k < n; ++k) apply_row(y + 3 * k, H, B, u + 3 * k);
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
