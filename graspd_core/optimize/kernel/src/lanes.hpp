// Vectors of `LANES` floats, as wide as the target supports. GCC's and Clang's vector extensions give arithmetic and
// comparison on every target. This file adds roots and masks as bits, with a plain loop if the target is not x86.
#pragma once
#include <cmath>
#include <cstdint>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define GRASPD_LANES 16
#elif defined(__AVX__)
#define GRASPD_LANES 8
#else
#define GRASPD_LANES 4
#endif

namespace graspd {

constexpr int LANES = GRASPD_LANES;
typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef float Unaligned __attribute__((vector_size(4 * LANES), aligned(4)));
// The four channels of one node of the distance grid, and the eight of two neighbours along z.
typedef float Four __attribute__((vector_size(16)));
typedef float FourUnaligned __attribute__((vector_size(16), aligned(4)));
typedef float Eight __attribute__((vector_size(32)));
typedef float EightUnaligned __attribute__((vector_size(32), aligned(4)));

#define INLINE static inline __attribute__((always_inline))

INLINE int padded(int count) { return (count + LANES - 1) / LANES * LANES; }
INLINE Floats load(const float* from) { return *(const Floats*)from; }
INLINE void store(float* to, Floats v) { *(Floats*)to = v; }
INLINE Floats load_unaligned(const float* from) { return *(const Unaligned*)from; }
INLINE void store_unaligned(float* to, Floats v) { *(Unaligned*)to = v; }
INLINE Floats all(float v) { return v - Floats{}; }
// If `a` is NaN, these return `b`. So a finite `b` gives a bound that is never NaN.
INLINE Floats greater(Floats a, Floats b) { return a > b ? a : b; }
INLINE Floats lesser(Floats a, Floats b) { return a < b ? a : b; }
INLINE Floats magnitude(Floats a) { return (Floats)((Ints)a & 0x7fffffff); }

INLINE Floats root(Floats a) {
#if defined(__AVX512F__)
    return (Floats)_mm512_sqrt_ps((__m512)a);
#elif defined(__AVX__)
    return (Floats)_mm256_sqrt_ps((__m256)a);
#elif defined(__SSE2__)
    return (Floats)_mm_sqrt_ps((__m128)a);
#else
    for (int i = 0; i < LANES; i++) a[i] = sqrtf(a[i]);
    return a;
#endif
}

// Returns 1/√a to float32 precision, by the hardware's estimate and one Newton step.
INLINE Floats inverse_root(Floats a) {
#if defined(__AVX512F__)
    Floats y = (Floats)_mm512_rsqrt14_ps((__m512)a);
#elif defined(__AVX__)
    Floats y = (Floats)_mm256_rsqrt_ps((__m256)a);
#elif defined(__SSE2__)
    Floats y = (Floats)_mm_rsqrt_ps((__m128)a);
#else
    return 1.f / root(a);
#endif
#if defined(__SSE2__)
    return y * (1.5f - 0.5f * a * y * y);
#endif
}

// Returns a number whose bit i is set if lane i of the mask is set.
INLINE unsigned bits(Ints mask) {
#if defined(__AVX512F__)
    return _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask);
#elif defined(__AVX__)
    return (unsigned)_mm256_movemask_ps((__m256)mask);
#elif defined(__SSE2__)
    return (unsigned)_mm_movemask_ps((__m128)mask);
#else
    unsigned set = 0;
    for (int i = 0; i < LANES; i++) set |= (mask[i] != 0) << i;
    return set;
#endif
}

INLINE float sum(Floats v) {
    float total = 0;
    for (int i = 0; i < LANES; i++) total += v[i];
    return total;
}
INLINE float sum_four(Four v) { return (v[0] + v[2]) + (v[1] + v[3]); }

// Returns eˣ for x ≤ 0, with a relative error of 2e-7: 2ⁿ times a polynomial in the remainder (Cephes' coefficients).
INLINE Floats exponential(Floats x) {
    x = greater(x, all(-87.f));
    Ints n = __builtin_convertvector(x * 1.44269504f - 0.5f, Ints);  // Rounds, because x ≤ 0 and conversion truncates.
    Floats whole = __builtin_convertvector(n, Floats);
    Floats r = (x - whole * 0.693359375f) + whole * 2.12194440e-4f;
    Floats p = all(1.9875691500e-4f);
    for (float c : {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f})
        p = p * r + c;
    return (p * r * r + r + 1.f) * (Floats)((n + 127) << 23);
}

}  // namespace graspd
