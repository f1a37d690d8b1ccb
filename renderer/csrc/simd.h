// Sixteen floats at a time: one AVX-512 register, two AVX2 registers or four of SSE/NEON, chosen by compiler flags.
// Included only by what is compiled once for each instruction set.
#pragma once
#include <stdint.h>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace {

constexpr int kLanes = 16;

#if defined(__AVX512F__)

struct F {
  __m512 v;
  F() = default;
  F(__m512 v) : v(v) {}
  F(float x) : v(_mm512_set1_ps(x)) {}
};
struct Mask {
  __mmask16 m;
};

inline F load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, F a) { _mm512_storeu_ps(p, a.v); }
// Past the caches; p is aligned to 64 bytes. Before another thread reads there, this one calls `streamed`.
inline void stream(float* p, F a) { _mm512_stream_ps(p, a.v); }
inline void streamed() { _mm_sfence(); }
inline F operator+(F a, F b) { return {_mm512_add_ps(a.v, b.v)}; }
inline F operator-(F a, F b) { return {_mm512_sub_ps(a.v, b.v)}; }
inline F operator*(F a, F b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline F fma(F a, F b, F c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
inline F fnma(F a, F b, F c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
inline F min(F a, F b) { return {_mm512_min_ps(a.v, b.v)}; }
inline F max(F a, F b) { return {_mm512_max_ps(a.v, b.v)}; }
inline F sqrt(F a) { return {_mm512_sqrt_ps(a.v)}; }
inline F operator/(F a, F b) { return {_mm512_div_ps(a.v, b.v)}; }
// Four floats from each of four places, and back; and one of each four in all its places.
inline F load_fours(const float* const p[4]) {
  const __m256 low = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p[0])), _mm_loadu_ps(p[1]), 1);
  const __m256 high = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p[2])), _mm_loadu_ps(p[3]), 1);
  return {_mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1)};
}
inline void store_fours(float* const p[4], F a) {
  _mm_storeu_ps(p[0], _mm512_castps512_ps128(a.v)), _mm_storeu_ps(p[1], _mm512_extractf32x4_ps(a.v, 1));
  _mm_storeu_ps(p[2], _mm512_extractf32x4_ps(a.v, 2)), _mm_storeu_ps(p[3], _mm512_extractf32x4_ps(a.v, 3));
}
// Of each four, those of a and b in turn: the first two of both, and the last two; the same in pairs.
inline F low_ones(F a, F b) { return {_mm512_unpacklo_ps(a.v, b.v)}; }
inline F high_ones(F a, F b) { return {_mm512_unpackhi_ps(a.v, b.v)}; }
inline F low_pairs(F a, F b) { return {_mm512_shuffle_ps(a.v, b.v, 0x44)}; }
inline F high_pairs(F a, F b) { return {_mm512_shuffle_ps(a.v, b.v, 0xee)}; }
template <int k>
inline F spread(F a) {
  return {_mm512_permute_ps(a.v, k * 0x55)};
}
// Bit `bit` of each of 32 numbers.
inline uint32_t bit_of_each(const uint16_t* numbers, int bit) {
  return _mm512_test_epi16_mask(_mm512_loadu_si512(numbers), _mm512_set1_epi16(short(1 << bit)));
}
inline Mask operator>=(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
inline Mask operator>(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {__mmask16(a.m & b.m)}; }
inline Mask operator|(Mask a, Mask b) { return {__mmask16(a.m | b.m)}; }
inline Mask operator!(Mask a) { return {__mmask16(~a.m)}; }
inline F keep(Mask m, F a) { return {_mm512_maskz_mov_ps(m.m, a.v)}; }
inline F select(Mask m, F yes, F no) { return {_mm512_mask_blend_ps(m.m, no.v, yes.v)}; }
inline F magnitude(F a) { return {_mm512_abs_ps(a.v)}; }
inline F sign_of(F a) { return {_mm512_and_ps(a.v, _mm512_set1_ps(-0.0f))}; }
inline F flip(F a, F sign) { return {_mm512_xor_ps(a.v, sign.v)}; }
inline uint32_t bits(Mask m) { return m.m; }
// Of a positive normal number: x = mantissa · 2^exponent with 1 ≤ mantissa < 2.
inline F exponent(F a) { return {_mm512_getexp_ps(a.v)}; }
inline F mantissa(F a) { return {_mm512_getmant_ps(a.v, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_src)}; }
inline F round(F a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
inline F floor(F a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}; }
inline void store_integers(int32_t* p, F a) { _mm512_storeu_si512(p, _mm512_cvttps_epi32(a.v)); }
inline F pick(const float* p, const int32_t* at) { return {_mm512_i32gather_ps(_mm512_loadu_si512(at), p, 4)}; }
inline F scale2(F a, F exponent) { return {_mm512_scalef_ps(a.v, exponent.v)}; }
inline F reciprocal(F a) {
  const F r = {_mm512_rcp14_ps(a.v)};
  return r * fnma(a, r, 2);
}

#elif defined(__AVX2__)

struct F {
  __m256 a, b;
  F() = default;
  F(__m256 a, __m256 b) : a(a), b(b) {}
  F(float x) : a(_mm256_set1_ps(x)), b(a) {}
};
struct Mask {
  __m256 a, b;
};

inline F load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
inline void store(float* p, F x) { _mm256_storeu_ps(p, x.a), _mm256_storeu_ps(p + 8, x.b); }
inline void stream(float* p, F x) { _mm256_stream_ps(p, x.a), _mm256_stream_ps(p + 8, x.b); }
inline void streamed() { _mm_sfence(); }
inline F operator+(F x, F y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
inline F operator-(F x, F y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
inline F operator*(F x, F y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
inline F fma(F x, F y, F z) { return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)}; }
inline F fnma(F x, F y, F z) { return {_mm256_fnmadd_ps(x.a, y.a, z.a), _mm256_fnmadd_ps(x.b, y.b, z.b)}; }
inline F min(F x, F y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
inline F max(F x, F y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
inline F sqrt(F x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
inline F operator/(F x, F y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
inline __m256 load_two(const float* const p[2]) {
  return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p[0])), _mm_loadu_ps(p[1]), 1);
}
inline F load_fours(const float* const p[4]) { return {load_two(p), load_two(p + 2)}; }
inline void store_two(float* const p[2], __m256 x) {
  _mm_storeu_ps(p[0], _mm256_castps256_ps128(x)), _mm_storeu_ps(p[1], _mm256_extractf128_ps(x, 1));
}
inline void store_fours(float* const p[4], F x) { store_two(p, x.a), store_two(p + 2, x.b); }
inline F low_ones(F x, F y) { return {_mm256_unpacklo_ps(x.a, y.a), _mm256_unpacklo_ps(x.b, y.b)}; }
inline F high_ones(F x, F y) { return {_mm256_unpackhi_ps(x.a, y.a), _mm256_unpackhi_ps(x.b, y.b)}; }
inline F low_pairs(F x, F y) { return {_mm256_shuffle_ps(x.a, y.a, 0x44), _mm256_shuffle_ps(x.b, y.b, 0x44)}; }
inline F high_pairs(F x, F y) { return {_mm256_shuffle_ps(x.a, y.a, 0xee), _mm256_shuffle_ps(x.b, y.b, 0xee)}; }
template <int k>
inline F spread(F x) {
  return {_mm256_permute_ps(x.a, k * 0x55), _mm256_permute_ps(x.b, k * 0x55)};
}
inline uint32_t bit_of_each(const uint16_t* numbers, int bit) {
  const __m256i* p = reinterpret_cast<const __m256i*>(numbers);
  const __m128i to_sign = _mm_cvtsi32_si128(15 - bit);
  const __m256i low = _mm256_sll_epi16(_mm256_loadu_si256(p), to_sign);
  const __m256i high = _mm256_sll_epi16(_mm256_loadu_si256(p + 1), to_sign);
  const __m256i packed = _mm256_packs_epi16(low, high);  // lane by lane: the quarters come as 0 2 1 3
  return uint32_t(_mm256_movemask_epi8(_mm256_permute4x64_epi64(packed, 0xd8)));
}
inline Mask operator>=(F x, F y) { return {_mm256_cmp_ps(x.a, y.a, _CMP_GE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GE_OQ)}; }
inline Mask operator>(F x, F y) { return {_mm256_cmp_ps(x.a, y.a, _CMP_GT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GT_OQ)}; }
inline Mask operator&(Mask m, Mask n) { return {_mm256_and_ps(m.a, n.a), _mm256_and_ps(m.b, n.b)}; }
inline Mask operator|(Mask m, Mask n) { return {_mm256_or_ps(m.a, n.a), _mm256_or_ps(m.b, n.b)}; }
inline Mask operator!(Mask m) {
  const __m256 all = _mm256_castsi256_ps(_mm256_set1_epi32(-1));
  return {_mm256_xor_ps(m.a, all), _mm256_xor_ps(m.b, all)};
}
inline F keep(Mask m, F x) { return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)}; }
inline F select(Mask m, F yes, F no) {
  return {_mm256_blendv_ps(no.a, yes.a, m.a), _mm256_blendv_ps(no.b, yes.b, m.b)};
}
inline F magnitude(F x) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_andnot_ps(sign, x.a), _mm256_andnot_ps(sign, x.b)};
}
inline F sign_of(F x) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_and_ps(x.a, sign), _mm256_and_ps(x.b, sign)};
}
inline F flip(F x, F sign) { return {_mm256_xor_ps(x.a, sign.a), _mm256_xor_ps(x.b, sign.b)}; }
inline __m256 exponent8(__m256 x) {
  return _mm256_cvtepi32_ps(_mm256_sub_epi32(_mm256_srli_epi32(_mm256_castps_si256(x), 23), _mm256_set1_epi32(127)));
}
inline F exponent(F x) { return {exponent8(x.a), exponent8(x.b)}; }
inline __m256 mantissa8(__m256 x) {
  const __m256 digits = _mm256_castsi256_ps(_mm256_set1_epi32(0x7fffff));
  return _mm256_or_ps(_mm256_and_ps(x, digits), _mm256_set1_ps(1));
}
inline F mantissa(F x) { return {mantissa8(x.a), mantissa8(x.b)}; }
inline uint32_t bits(Mask m) { return _mm256_movemask_ps(m.a) | _mm256_movemask_ps(m.b) << 8; }
inline __m256 round8(__m256 x) { return _mm256_round_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
inline F round(F x) { return {round8(x.a), round8(x.b)}; }
inline F floor(F x) { return {_mm256_floor_ps(x.a), _mm256_floor_ps(x.b)}; }
inline void store_integers(int32_t* p, F x) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm256_cvttps_epi32(x.a));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + 8), _mm256_cvttps_epi32(x.b));
}
inline __m256 pick8(const float* p, const int32_t* at) {
  return _mm256_i32gather_ps(p, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(at)), 4);
}
inline F pick(const float* p, const int32_t* at) { return {pick8(p, at), pick8(p, at + 8)}; }
inline __m256 scale8(__m256 x, __m256 e) {
  const __m256i shift = _mm256_slli_epi32(_mm256_cvtps_epi32(e), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(x), shift));
}
inline F scale2(F x, F e) { return {scale8(x.a, e.a), scale8(x.b, e.b)}; }
inline F reciprocal(F x) {
  const F r = {_mm256_rcp_ps(x.a), _mm256_rcp_ps(x.b)};
  return r * fnma(x, r, 2);
}
inline __m256 fold(F x) { return _mm256_add_ps(x.a, x.b); }

#else

typedef float V __attribute__((vector_size(16)));
typedef int32_t W __attribute__((vector_size(16)));
struct F {
  V v[4];
  F() = default;
  F(float x) {
    for (V& four : v) four = V{x, x, x, x};
  }
};
struct Mask {
  W v[4];
};

#define PANOLOG_EACH_OF(Type, expression)            \
  Type out;                                          \
  for (int i = 0; i < 4; ++i) out.v[i] = expression; \
  return out
#define PANOLOG_EACH(expression) PANOLOG_EACH_OF(F, expression)
inline F load(const float* p) { PANOLOG_EACH((V{p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3]})); }
inline void store(float* p, F a) { __builtin_memcpy(p, a.v, sizeof(a.v)); }
inline void stream(float* p, F a) { store(p, a); }
inline void streamed() {}
inline F operator+(F a, F b) { PANOLOG_EACH(a.v[i] + b.v[i]); }
inline F operator-(F a, F b) { PANOLOG_EACH(a.v[i] - b.v[i]); }
inline F operator*(F a, F b) { PANOLOG_EACH(a.v[i] * b.v[i]); }
inline F fma(F a, F b, F c) { PANOLOG_EACH(a.v[i] * b.v[i] + c.v[i]); }
inline F fnma(F a, F b, F c) { PANOLOG_EACH(c.v[i] - a.v[i] * b.v[i]); }
inline F min(F a, F b) { PANOLOG_EACH(a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline F max(F a, F b) { PANOLOG_EACH(a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
inline F operator/(F a, F b) { PANOLOG_EACH(a.v[i] / b.v[i]); }
inline F sqrt(F a) {
  for (int i = 0; i < 16; ++i) a.v[i / 4][i % 4] = __builtin_sqrtf(a.v[i / 4][i % 4]);
  return a;
}
inline F load_fours(const float* const p[4]) { PANOLOG_EACH((V{p[i][0], p[i][1], p[i][2], p[i][3]})); }
inline void store_fours(float* const p[4], F a) {
  for (int i = 0; i < 4; ++i) __builtin_memcpy(p[i], &a.v[i], sizeof(V));
}
inline F low_ones(F a, F b) { PANOLOG_EACH((V{a.v[i][0], b.v[i][0], a.v[i][1], b.v[i][1]})); }
inline F high_ones(F a, F b) { PANOLOG_EACH((V{a.v[i][2], b.v[i][2], a.v[i][3], b.v[i][3]})); }
inline F low_pairs(F a, F b) { PANOLOG_EACH((V{a.v[i][0], a.v[i][1], b.v[i][0], b.v[i][1]})); }
inline F high_pairs(F a, F b) { PANOLOG_EACH((V{a.v[i][2], a.v[i][3], b.v[i][2], b.v[i][3]})); }
template <int k>
inline F spread(F a) {
  PANOLOG_EACH((V{a.v[i][k], a.v[i][k], a.v[i][k], a.v[i][k]}));
}
inline uint32_t bit_of_each(const uint16_t* numbers, int bit) {
  uint32_t out = 0;
  for (int i = 0; i < 32; ++i) out |= uint32_t(numbers[i] >> bit & 1) << i;
  return out;
}
inline Mask operator>=(F a, F b) { PANOLOG_EACH_OF(Mask, a.v[i] >= b.v[i]); }
inline Mask operator>(F a, F b) { PANOLOG_EACH_OF(Mask, a.v[i] > b.v[i]); }
inline Mask operator&(Mask a, Mask b) { PANOLOG_EACH_OF(Mask, a.v[i] & b.v[i]); }
inline Mask operator|(Mask a, Mask b) { PANOLOG_EACH_OF(Mask, a.v[i] | b.v[i]); }
inline Mask operator!(Mask a) { PANOLOG_EACH_OF(Mask, ~a.v[i]); }
inline F select(Mask m, F yes, F no) { PANOLOG_EACH((V)(((W)yes.v[i] & m.v[i]) | ((W)no.v[i] & ~m.v[i]))); }
inline F magnitude(F a) { PANOLOG_EACH((V)((W)a.v[i] & 0x7fffffff)); }
inline F sign_of(F a) { PANOLOG_EACH((V)((W)a.v[i] & ~0x7fffffff)); }
inline F flip(F a, F sign) { PANOLOG_EACH((V)((W)a.v[i] ^ (W)sign.v[i])); }
inline F exponent(F a) { PANOLOG_EACH(__builtin_convertvector(((W)a.v[i] >> 23) - 127, V)); }
inline F mantissa(F a) { PANOLOG_EACH((V)(((W)a.v[i] & 0x7fffff) | 0x3f800000)); }
inline F keep(Mask m, F a) { PANOLOG_EACH((V)((W)a.v[i] & m.v[i])); }
inline uint32_t bits(Mask m) {
  uint32_t out = 0;
  for (int i = 0; i < 16; ++i) out |= (m.v[i / 4][i % 4] & 1u) << i;
  return out;
}
inline F round(F a) {  // |a| < 2²²
  const F magic = 12582912.0f;
  return (a + magic) - magic;
}
inline F floor(F a) {
  PANOLOG_EACH((V{__builtin_floorf(a.v[i][0]), __builtin_floorf(a.v[i][1]), __builtin_floorf(a.v[i][2]),
                  __builtin_floorf(a.v[i][3])}));
}
inline void store_integers(int32_t* p, F a) {
  for (int i = 0; i < 16; ++i) p[i] = int32_t(a.v[i / 4][i % 4]);
}
inline F pick(const float* p, const int32_t* at) {
  PANOLOG_EACH((V{p[at[4 * i]], p[at[4 * i + 1]], p[at[4 * i + 2]], p[at[4 * i + 3]]}));
}
inline F scale2(F a, F e) { PANOLOG_EACH((V)((W)a.v[i] + (__builtin_convertvector(e.v[i], W) << 23))); }
inline F reciprocal(F a) { PANOLOG_EACH(1.0f / a.v[i]); }
#undef PANOLOG_EACH
#undef PANOLOG_EACH_OF

#endif

inline F set(float x) { return x; }
inline F operator-(F a) { return flip(a, F(-0.0f)); }
inline F ceil(F a) { return -floor(-a); }
inline F& operator+=(F& a, F b) { return a = a + b; }
inline F& operator-=(F& a, F b) { return a = a - b; }
inline Mask operator<(F a, F b) { return b > a; }

// The k-th fours of four vectors as the rows of a matrix: transposes it, for every k.
inline void transpose_fours(F a[4]) {
  const F low = low_ones(a[0], a[1]), high = high_ones(a[0], a[1]);
  const F low2 = low_ones(a[2], a[3]), high2 = high_ones(a[2], a[3]);
  a[0] = low_pairs(low, low2), a[1] = high_pairs(low, low2);
  a[2] = low_pairs(high, high2), a[3] = high_pairs(high, high2);
}

// 2^x for -126 < x ≤ 0, relative error 8e-8 (degree 5, fitted for the least largest relative error).
inline F exp2(F x) {
#if !defined(__AVX512F__)  // which rounds to zero by itself what is less
  x = max(x, set(-126));
#endif
  const F n = round(x);
  const F f = x - n;
  F p = fma(set(0.00132764715f), f, set(0.00967554133f));
  p = fma(p, f, set(0.0555071327f));
  p = fma(p, f, set(0.240221197f));
  p = fma(p, f, set(0.693146967f));
  p = fma(p, f, set(1.00000007f));
  return scale2(p, n);
}

// e^x, relative error 2e-7; infinite or 0 where that is no float. Degree 6, fitted like exp2.
inline F exp(F x) {
  x = min(max(x, F(-120)), F(120));
  const F n = round(x * 1.44269504f);
  const F r = fnma(n, F(-2.12194440e-4f), fnma(n, F(0.693359375f), x));  // ln 2 in two parts, the first of few bits
  F p = fma(F(0.00138146131f), r, F(0.00836870983f));
  p = fma(p, r, F(0.0416683874f));
  p = fma(p, r, F(0.166665207f));
  p = fma(p, r, F(0.499999935f));
  p = fma(p * r, r, r) + 1;
  const F half = round(n * 0.5f);  // no float holds all the powers of two
  return p * scale2(F(1), half) * scale2(F(1), n - half);
}

// Of positive normal numbers, error 1e-7 relative to the larger of 1 and the result's magnitude.
inline F log2(F x) {
  const F m = mantissa(x);
  const Mask upper = m > 1.41421356f;
  const F near_one = select(upper, m * 0.5f, m);
  const F s = (near_one - 1) / (near_one + 1), square = s * s;  // log x = 2 artanh s, |s| < 0.172
  F p = fma(square, F(1.0f / 9), F(1.0f / 7));
  p = fma(p, square, F(1.0f / 5));
  p = fma(p, square, F(1.0f / 3));
  p = fma(p * square, s, s);
  return fma(p, F(2.88539008f), exponent(x) + select(upper, 1, 0));
}

// Relative error 2e-7; all quadrants, zeros and their signs as in math.h. The arguments must be finite.
inline F atan2(F y, F x) {
  constexpr float kHalfPi = 1.57079633f;
  const F ax = magnitude(x), ay = magnitude(y);
  const F low = min(ax, ay), high = max(ax, ay);
  const Mask upper = low > high * 0.414213562f;  // beyond π/8 the angle is taken from the diagonal
  const F numerator = select(upper, low - high, low), denominator = select(upper, low + high, high);
  const F s = select(high > 0, numerator / denominator, 0), square = s * s;
  F p = fma(F(0.0805372226f), square, F(-0.138776786f));  // fitted for the least largest relative error, 2e-8
  p = fma(p, square, F(0.1997771f));
  p = fma(p, square, F(-0.333329491f));
  F angle = fma(p * square, s, s) + select(upper, kHalfPi / 2, 0);
  angle = select(ay > ax, kHalfPi - angle, angle);
  const Mask behind = F(0) > flip(F(1), sign_of(x));
  return flip(select(behind, 2 * kHalfPi - angle, angle), sign_of(y));
}

// The sums over lanes of 9 to 16 vectors, in a fixed order.
template <int kCount>
inline void sums_of(const F s[kCount], float out[kCount]) {
  static_assert(kCount > 8 && kCount <= 16, "two or more floats of each quarter");
#if defined(__AVX512F__)
  // Each step folds two vectors into one: first by halves, then quarters, pairs and single floats.
  constexpr int kHalves = (kCount + 1) / 2, kQuarters = (kHalves + 1) / 2;
  __m512 half[2 * kQuarters], quarter[4];
  for (int i = 0; i < kHalves; ++i) {
    const __m512 a = s[2 * i].v, b = s[2 * i + 1 < kCount ? 2 * i + 1 : 2 * i].v;
    half[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
  }
  half[2 * kQuarters - 1] = half[kHalves - 1];
  for (int i = 0; i < kQuarters; ++i) {
    const __m512 a = half[2 * i], b = half[2 * i + 1];
    quarter[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd));
  }
  quarter[3] = quarter[kQuarters - 1];
  const auto by_pairs = [](__m512 a, __m512 b) {
    return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x88), _mm512_shuffle_ps(a, b, 0xdd));
  };
  const __m512 sums = by_pairs(by_pairs(quarter[0], quarter[1]), by_pairs(quarter[2], quarter[3]));
  // the four lanes of a quarter hold sums k, k + 4, k + 8 and k + 12
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  _mm512_mask_storeu_ps(out, (1 << kCount) - 1, _mm512_permutexvar_ps(order, sums));
#elif defined(__AVX2__)
  __m256 w[16];
  for (int i = 0; i < 16; ++i) w[i] = fold(s[i < kCount ? i : kCount - 1]);
  alignas(16) float sums[16];
  for (int i = 0; i < (kCount + 3) / 4; ++i) {
    const __m256 h = _mm256_hadd_ps(_mm256_hadd_ps(w[4 * i], w[4 * i + 1]), _mm256_hadd_ps(w[4 * i + 2], w[4 * i + 3]));
    _mm_store_ps(sums + 4 * i, _mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1)));
  }
  __builtin_memcpy(out, sums, kCount * sizeof(float));
#else
  for (int i = 0; i < kCount; ++i) {
    const V sum = (s[i].v[0] + s[i].v[1]) + (s[i].v[2] + s[i].v[3]);
    out[i] = (sum[0] + sum[1]) + (sum[2] + sum[3]);
  }
#endif
}

}  // namespace
