// Sixteen floats at a time: one AVX-512 register, two AVX2 registers or four of SSE/NEON, chosen by compiler flags.
// Included only by tile.cpp, which is compiled once for each instruction set.
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
};
typedef __mmask16 Mask;

inline F set(float x) { return {_mm512_set1_ps(x)}; }
inline F load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, F a) { _mm512_storeu_ps(p, a.v); }
inline F operator+(F a, F b) { return {_mm512_add_ps(a.v, b.v)}; }
inline F operator-(F a, F b) { return {_mm512_sub_ps(a.v, b.v)}; }
inline F operator*(F a, F b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline F fma(F a, F b, F c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
inline F fnma(F a, F b, F c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
inline F min(F a, F b) { return {_mm512_min_ps(a.v, b.v)}; }
inline F max(F a, F b) { return {_mm512_max_ps(a.v, b.v)}; }
inline F sqrt(F a) { return {_mm512_sqrt_ps(a.v)}; }
inline F operator/(F a, F b) { return {_mm512_div_ps(a.v, b.v)}; }
// Four floats from each of four places, aligned to 16 bytes; and one of each four in all its places.
inline F load_fours(const float* const p[4]) {
  const __m256 low = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_load_ps(p[0])), _mm_load_ps(p[1]), 1);
  const __m256 high = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_load_ps(p[2])), _mm_load_ps(p[3]), 1);
  return {_mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1)};
}
template <int k>
inline F spread(F a) { return {_mm512_permute_ps(a.v, k * 0x55)}; }
// Bit `bit` of each of 32 numbers.
inline uint32_t bit_of_each(const uint16_t* numbers, int bit) {
  return _mm512_test_epi16_mask(_mm512_loadu_si512(numbers), _mm512_set1_epi16(short(1 << bit)));
}
inline Mask at_least(F a, F b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
inline Mask both(Mask a, Mask b) { return a & b; }
inline F keep(Mask m, F a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
inline uint32_t bits(Mask m) { return m; }
inline F round(F a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
inline F scale2(F a, F exponent) { return {_mm512_scalef_ps(a.v, exponent.v)}; }
inline F reciprocal(F a) {
  const F r = {_mm512_rcp14_ps(a.v)};
  return r * fnma(a, r, set(2));
}

#elif defined(__AVX2__)

struct F {
  __m256 a, b;
};
typedef F Mask;

inline F set(float x) { return {_mm256_set1_ps(x), _mm256_set1_ps(x)}; }
inline F load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
inline void store(float* p, F x) { _mm256_storeu_ps(p, x.a), _mm256_storeu_ps(p + 8, x.b); }
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
  return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_load_ps(p[0])), _mm_load_ps(p[1]), 1);
}
inline F load_fours(const float* const p[4]) { return {load_two(p), load_two(p + 2)}; }
template <int k>
inline F spread(F x) { return {_mm256_permute_ps(x.a, k * 0x55), _mm256_permute_ps(x.b, k * 0x55)}; }
inline uint32_t bit_of_each(const uint16_t* numbers, int bit) {
  const __m256i* p = reinterpret_cast<const __m256i*>(numbers);
  const __m128i to_sign = _mm_cvtsi32_si128(15 - bit);
  const __m256i low = _mm256_sll_epi16(_mm256_loadu_si256(p), to_sign);
  const __m256i high = _mm256_sll_epi16(_mm256_loadu_si256(p + 1), to_sign);
  const __m256i packed = _mm256_packs_epi16(low, high);  // lane by lane: the quarters come as 0 2 1 3
  return uint32_t(_mm256_movemask_epi8(_mm256_permute4x64_epi64(packed, 0xd8)));
}
inline Mask at_least(F x, F y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_GE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GE_OQ)};
}
inline F keep(Mask m, F x) { return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)}; }
inline Mask both(Mask m, Mask n) { return keep(m, n); }
inline uint32_t bits(Mask m) { return _mm256_movemask_ps(m.a) | _mm256_movemask_ps(m.b) << 8; }
inline __m256 round8(__m256 x) { return _mm256_round_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
inline F round(F x) { return {round8(x.a), round8(x.b)}; }
inline __m256 scale8(__m256 x, __m256 e) {
  const __m256i shift = _mm256_slli_epi32(_mm256_cvtps_epi32(e), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(x), shift));
}
inline F scale2(F x, F e) { return {scale8(x.a, e.a), scale8(x.b, e.b)}; }
inline F reciprocal(F x) {
  const F r = {_mm256_rcp_ps(x.a), _mm256_rcp_ps(x.b)};
  return r * fnma(x, r, set(2));
}
inline __m256 fold(F x) { return _mm256_add_ps(x.a, x.b); }

#else

typedef float V __attribute__((vector_size(16)));
typedef int32_t W __attribute__((vector_size(16)));
struct F {
  V v[4];
};
struct Mask {
  W v[4];
};

#define PANOLOG_EACH(expression)            \
  F out;                                    \
  for (int i = 0; i < 4; ++i) out.v[i] = expression; \
  return out
inline F set(float x) { PANOLOG_EACH((V{x, x, x, x})); }
inline F load(const float* p) { PANOLOG_EACH((V{p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3]})); }
inline void store(float* p, F a) { __builtin_memcpy(p, a.v, sizeof(a.v)); }
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
template <int k>
inline F spread(F a) { PANOLOG_EACH((V{a.v[i][k], a.v[i][k], a.v[i][k], a.v[i][k]})); }
inline uint32_t bit_of_each(const uint16_t* numbers, int bit) {
  uint32_t out = 0;
  for (int i = 0; i < 32; ++i) out |= uint32_t(numbers[i] >> bit & 1) << i;
  return out;
}
inline Mask at_least(F a, F b) {
  Mask m;
  for (int i = 0; i < 4; ++i) m.v[i] = a.v[i] >= b.v[i];
  return m;
}
inline Mask both(Mask a, Mask b) {
  for (int i = 0; i < 4; ++i) a.v[i] &= b.v[i];
  return a;
}
inline F keep(Mask m, F a) { PANOLOG_EACH((V)((W)a.v[i] & m.v[i])); }
inline uint32_t bits(Mask m) {
  uint32_t out = 0;
  for (int i = 0; i < 16; ++i) out |= (m.v[i / 4][i % 4] & 1u) << i;
  return out;
}
inline F round(F a) {  // |a| < 2²²
  const F magic = set(12582912.0f);
  return (a + magic) - magic;
}
inline F scale2(F a, F e) {
  PANOLOG_EACH((V)((W)a.v[i] + (__builtin_convertvector(e.v[i], W) << 23)));
}
inline F reciprocal(F a) { PANOLOG_EACH(1.0f / a.v[i]); }
#undef PANOLOG_EACH

#endif

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

// The sums over lanes of ten vectors, in a fixed order.
inline void sums_of_ten(const F s[10], float out[10]) {
#if defined(__AVX512F__)
  // Each step folds two vectors into one: first by halves, then quarters, pairs and single floats.
  __m512 half[6], quarter[3];
  for (int i = 0; i < 5; ++i) {
    const __m512 a = s[2 * i].v, b = s[2 * i + 1].v;
    half[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
  }
  half[5] = half[4];
  for (int i = 0; i < 3; ++i) {
    const __m512 a = half[2 * i], b = half[2 * i + 1];
    quarter[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd));
  }
  const auto by_pairs = [](__m512 a, __m512 b) {
    return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x88), _mm512_shuffle_ps(a, b, 0xdd));
  };
  const __m512 sums = by_pairs(by_pairs(quarter[0], quarter[1]), by_pairs(quarter[2], quarter[2]));
  // the four lanes of a quarter hold sums k, k + 4 and k + 8
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  _mm512_mask_storeu_ps(out, 0x3ff, _mm512_permutexvar_ps(order, sums));
#elif defined(__AVX2__)
  __m256 h[3], w[10];
  for (int i = 0; i < 10; ++i) w[i] = fold(s[i]);
  h[0] = _mm256_hadd_ps(_mm256_hadd_ps(w[0], w[1]), _mm256_hadd_ps(w[2], w[3]));
  h[1] = _mm256_hadd_ps(_mm256_hadd_ps(w[4], w[5]), _mm256_hadd_ps(w[6], w[7]));
  const __m256 last = _mm256_hadd_ps(w[8], w[9]);
  h[2] = _mm256_hadd_ps(last, last);
  for (int i = 0; i < 2; ++i)
    _mm_storeu_ps(out + 4 * i, _mm_add_ps(_mm256_castps256_ps128(h[i]), _mm256_extractf128_ps(h[i], 1)));
  const __m128 pair = _mm_add_ps(_mm256_castps256_ps128(h[2]), _mm256_extractf128_ps(h[2], 1));
  _mm_storel_pi(reinterpret_cast<__m64*>(out + 8), pair);
#else
  for (int i = 0; i < 10; ++i) {
    const V sum = (s[i].v[0] + s[i].v[1]) + (s[i].v[2] + s[i].v[3]);
    out[i] = (sum[0] + sum[1]) + (sum[2] + sum[3]);
  }
#endif
}

}  // namespace
