// One SIMD register of floats or doubles: AVX-512 where the CPU has it, else AVX2.
//
// fma(a, b, c) = a b + c; fnma(a, b, c) = c - a b, rounded once. The compiler has + - * / for
// these types already. rsqrt and rcp are the CPU's estimates, refined to the last bit or two; the
// rest is IEEE. transpose(r) takes `count` registers as the rows of a square tile.

#pragma once

#include <immintrin.h>

template <class T>
struct Lanes;

#if defined(__AVX512F__) && defined(__AVX512DQ__)

template <>
struct Lanes<float> {
    using V = __m512;
    using Mask = __mmask16;
    static constexpr int count = 16;

    static V load(const float *p) { return _mm512_loadu_ps(p); }
    static void store(float *p, V a) { _mm512_storeu_ps(p, a); }
    static V all(float a) { return _mm512_set1_ps(a); }
    static V fma(V a, V b, V c) { return _mm512_fmadd_ps(a, b, c); }
    static V fnma(V a, V b, V c) { return _mm512_fnmadd_ps(a, b, c); }
    static V sqrt(V a) { return _mm512_sqrt_ps(a); }
    static V max(V a, V b) { return _mm512_max_ps(a, b); }
    static Mask first(int n) { return n >= count ? Mask(0xffff) : Mask((1u << n) - 1); }
    static Mask positive(V a) { return _mm512_cmp_ps_mask(a, all(0), _CMP_GT_OQ); }
    static V keep(Mask m, V a) { return _mm512_maskz_mov_ps(m, a); }

    static V rsqrt(V a) {    // 14 bits, then a Newton step
        const V r = _mm512_rsqrt14_ps(a), e = fnma(a * r, r, all(1));
        return fma(r, e * all(0.5f), r);
    }

    static V rcp(V a) {
        const V r = _mm512_rcp14_ps(a);
        return fma(r, fnma(a, r, all(1)), r);
    }

    static void transpose(V (&r)[16]) {
        V t[16], u[16];
        for (int i = 0; i < 16; i += 2) {
            t[i] = _mm512_unpacklo_ps(r[i], r[i + 1]);
            t[i + 1] = _mm512_unpackhi_ps(r[i], r[i + 1]);
        }
        for (int i = 0; i < 16; i += 4) {
            for (int k = 0; k < 2; ++k) {
                const __m512d a = _mm512_castps_pd(t[i + k]), b = _mm512_castps_pd(t[i + k + 2]);
                u[i + 2 * k] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, b));
                u[i + 2 * k + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, b));
            }
        }
        for (int i = 0; i < 4; ++i) {    // 128-bit blocks of rows i, i + 4, i + 8, i + 12
            const V a = _mm512_shuffle_f32x4(u[i], u[i + 4], 0x44);
            const V b = _mm512_shuffle_f32x4(u[i], u[i + 4], 0xee);
            const V c = _mm512_shuffle_f32x4(u[i + 8], u[i + 12], 0x44);
            const V d = _mm512_shuffle_f32x4(u[i + 8], u[i + 12], 0xee);
            r[i] = _mm512_shuffle_f32x4(a, c, 0x88);
            r[i + 4] = _mm512_shuffle_f32x4(a, c, 0xdd);
            r[i + 8] = _mm512_shuffle_f32x4(b, d, 0x88);
            r[i + 12] = _mm512_shuffle_f32x4(b, d, 0xdd);
        }
    }
};

template <>
struct Lanes<double> {
    using V = __m512d;
    using Mask = __mmask8;
    static constexpr int count = 8;

    static V load(const double *p) { return _mm512_loadu_pd(p); }
    static void store(double *p, V a) { _mm512_storeu_pd(p, a); }
    static V all(double a) { return _mm512_set1_pd(a); }
    static V fma(V a, V b, V c) { return _mm512_fmadd_pd(a, b, c); }
    static V fnma(V a, V b, V c) { return _mm512_fnmadd_pd(a, b, c); }
    static V sqrt(V a) { return _mm512_sqrt_pd(a); }
    static V max(V a, V b) { return _mm512_max_pd(a, b); }
    static Mask first(int n) { return n >= count ? Mask(0xff) : Mask((1u << n) - 1); }
    static Mask positive(V a) { return _mm512_cmp_pd_mask(a, all(0), _CMP_GT_OQ); }
    static V keep(Mask m, V a) { return _mm512_maskz_mov_pd(m, a); }

    static V rsqrt(V a) {    // 14 bits, then a step of fourth order
        const V r = _mm512_rsqrt14_pd(a), e = fnma(a * r, r, all(1));
        return fma(r, e * fma(e, fma(e, all(0.3125), all(0.375)), all(0.5)), r);
    }

    static V rcp(V a) {
        const V r = _mm512_rcp14_pd(a), e = fnma(a, r, all(1)), t = fma(r, e, r);
        return fma(t, e * e, t);
    }

    static void transpose(V (&r)[8]) {
        V t[8];
        for (int i = 0; i < 8; i += 2) {
            t[i] = _mm512_unpacklo_pd(r[i], r[i + 1]);
            t[i + 1] = _mm512_unpackhi_pd(r[i], r[i + 1]);
        }
        for (int i = 0; i < 2; ++i) {    // 128-bit blocks of rows i, i + 2, i + 4, i + 6
            const V a = _mm512_shuffle_f64x2(t[i], t[i + 2], 0x44);
            const V b = _mm512_shuffle_f64x2(t[i], t[i + 2], 0xee);
            const V c = _mm512_shuffle_f64x2(t[i + 4], t[i + 6], 0x44);
            const V d = _mm512_shuffle_f64x2(t[i + 4], t[i + 6], 0xee);
            r[i] = _mm512_shuffle_f64x2(a, c, 0x88);
            r[i + 2] = _mm512_shuffle_f64x2(a, c, 0xdd);
            r[i + 4] = _mm512_shuffle_f64x2(b, d, 0x88);
            r[i + 6] = _mm512_shuffle_f64x2(b, d, 0xdd);
        }
    }
};

#elif defined(__AVX2__) && defined(__FMA__)

template <>
struct Lanes<float> {
    using V = __m256;
    using Mask = __m256;
    static constexpr int count = 8;

    static V load(const float *p) { return _mm256_loadu_ps(p); }
    static void store(float *p, V a) { _mm256_storeu_ps(p, a); }
    static V all(float a) { return _mm256_set1_ps(a); }
    static V fma(V a, V b, V c) { return _mm256_fmadd_ps(a, b, c); }
    static V fnma(V a, V b, V c) { return _mm256_fnmadd_ps(a, b, c); }
    static V sqrt(V a) { return _mm256_sqrt_ps(a); }
    static V max(V a, V b) { return _mm256_max_ps(a, b); }
    static Mask positive(V a) { return _mm256_cmp_ps(a, all(0), _CMP_GT_OQ); }
    static V keep(Mask m, V a) { return _mm256_and_ps(m, a); }

    static Mask first(int n) {
        const __m256i lane = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        return _mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_set1_epi32(n), lane));
    }

    static V rsqrt(V a) {    // 12 bits, then a Newton step
        const V r = _mm256_rsqrt_ps(a), e = fnma(a * r, r, all(1));
        return fma(r, e * all(0.5f), r);
    }

    static V rcp(V a) {
        const V r = _mm256_rcp_ps(a);
        return fma(r, fnma(a, r, all(1)), r);
    }

    static void transpose(V (&r)[8]) {
        V t[8], u[8];
        for (int i = 0; i < 8; i += 2) {
            t[i] = _mm256_unpacklo_ps(r[i], r[i + 1]);
            t[i + 1] = _mm256_unpackhi_ps(r[i], r[i + 1]);
        }
        for (int i = 0; i < 8; i += 4) {
            for (int k = 0; k < 2; ++k) {
                const __m256d a = _mm256_castps_pd(t[i + k]), b = _mm256_castps_pd(t[i + k + 2]);
                u[i + 2 * k] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, b));
                u[i + 2 * k + 1] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, b));
            }
        }
        for (int i = 0; i < 4; ++i) {
            r[i] = _mm256_permute2f128_ps(u[i], u[i + 4], 0x20);
            r[i + 4] = _mm256_permute2f128_ps(u[i], u[i + 4], 0x31);
        }
    }
};

template <>
struct Lanes<double> {
    using V = __m256d;
    using Mask = __m256d;
    static constexpr int count = 4;

    static V load(const double *p) { return _mm256_loadu_pd(p); }
    static void store(double *p, V a) { _mm256_storeu_pd(p, a); }
    static V all(double a) { return _mm256_set1_pd(a); }
    static V fma(V a, V b, V c) { return _mm256_fmadd_pd(a, b, c); }
    static V fnma(V a, V b, V c) { return _mm256_fnmadd_pd(a, b, c); }
    static V sqrt(V a) { return _mm256_sqrt_pd(a); }
    static V max(V a, V b) { return _mm256_max_pd(a, b); }
    static Mask positive(V a) { return _mm256_cmp_pd(a, all(0), _CMP_GT_OQ); }
    static V keep(Mask m, V a) { return _mm256_and_pd(m, a); }

    static Mask first(int n) {
        const __m256i lane = _mm256_setr_epi64x(0, 1, 2, 3);
        return _mm256_castsi256_pd(_mm256_cmpgt_epi64(_mm256_set1_epi64x(n), lane));
    }

    static V rsqrt(V a) {    // no estimate of doubles: 12 bits of a float, then 36, then all
        V r = _mm256_cvtps_pd(_mm_rsqrt_ps(_mm256_cvtpd_ps(a)));
        for (int k = 0; k < 2; ++k) {
            const V e = fnma(a * r, r, all(1));
            r = fma(r, e * fma(e, all(0.375), all(0.5)), r);
        }
        return r;
    }

    static V rcp(V a) {
        V r = _mm256_cvtps_pd(_mm_rcp_ps(_mm256_cvtpd_ps(a)));
        for (int k = 0; k < 2; ++k) {
            const V e = fnma(a, r, all(1));
            r = fma(r, fma(e, e, e), r);
        }
        return r;
    }

    static void transpose(V (&r)[4]) {
        const V a = _mm256_unpacklo_pd(r[0], r[1]), b = _mm256_unpackhi_pd(r[0], r[1]);
        const V c = _mm256_unpacklo_pd(r[2], r[3]), d = _mm256_unpackhi_pd(r[2], r[3]);
        r[0] = _mm256_permute2f128_pd(a, c, 0x20);
        r[1] = _mm256_permute2f128_pd(b, d, 0x20);
        r[2] = _mm256_permute2f128_pd(a, c, 0x31);
        r[3] = _mm256_permute2f128_pd(b, d, 0x31);
    }
};

#else
#error "neither AVX-512 nor AVX2"
#endif
