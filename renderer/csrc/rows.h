// Sixteen rows of arrays at a time, columns becoming vectors. Included only by what is compiled once for each
// instruction set.
#pragma once
#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

// Sixteen rows of one to three floats in turn, columns becoming vectors; and back.
template <int kColumns>
inline void split_columns(const float* rows, F out[kColumns]) {
  static_assert(kColumns < 4, "three vectors have all");
#if defined(__AVX512F__)
  const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  __m512 in[3];
  for (int i = 0; i < 3; ++i) in[i] = _mm512_loadu_ps(rows + kLanes * (i < kColumns ? i : 0));
  for (int k = 0; k < kColumns; ++k) {
    const __m512i at = _mm512_add_epi32(_mm512_mullo_epi32(lane, _mm512_set1_epi32(kColumns)), _mm512_set1_epi32(k));
    const __mmask16 last = _mm512_cmpge_epi32_mask(at, _mm512_set1_epi32(2 * kLanes));
    const __m512 low = _mm512_permutex2var_ps(in[0], at, in[1]);
    out[k] = _mm512_mask_permutexvar_ps(low, last, at, in[2]);
  }
#else
  for (int k = 0; k < kColumns; ++k) {
    alignas(64) float column[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) column[lane] = rows[kColumns * lane + k];
    out[k] = load(column);
  }
#endif
}
#if defined(__AVX512F__)
// Of each float of the rows its row, its place in the first two columns, and whether it is of the third.
template <int kColumns>
struct JoinedColumns {
  alignas(64) int32_t row[kColumns][kLanes] = {}, of_two[kColumns][kLanes] = {};
  __mmask16 third[kColumns] = {};
  constexpr JoinedColumns() {
    for (int i = 0; i < kColumns; ++i)
      for (int lane = 0; lane < kLanes; ++lane) {
        const int at = kLanes * i + lane, column = at % kColumns;
        row[i][lane] = at / kColumns, of_two[i][lane] = row[i][lane] + kLanes * (column == 1);
        third[i] |= __mmask16((column == 2) << lane);
      }
  }
};
#endif
template <int kColumns>
inline void join_columns(const F columns[kColumns], float* rows) {
  static_assert(kColumns < 4, "three vectors have all");
#if defined(__AVX512F__)
  static constexpr JoinedColumns<kColumns> kAt;
  for (int i = 0; i < kColumns; ++i) {
    const __m512i row = _mm512_load_si512(kAt.row[i]), of_two = _mm512_load_si512(kAt.of_two[i]);
    const __m512 two = _mm512_permutex2var_ps(columns[0].v, of_two, columns[kColumns > 1].v);
    const __m512 third = columns[kColumns > 2 ? 2 : 0].v;
    _mm512_storeu_ps(rows + kLanes * i, _mm512_mask_permutexvar_ps(two, kAt.third[i], row, third));
  }
#else
  for (int k = 0; k < kColumns; ++k) {
    alignas(64) float column[kLanes];
    store(column, columns[k]);
    for (int lane = 0; lane < kLanes; ++lane) rows[kColumns * lane + k] = column[lane];
  }
#endif
}

// Sixteen rows in turn, one for each lane. If fewer are left, the last one fills the remaining lanes.
struct Rows {
  int64_t first;
  int count;
  bool whole() const { return count == kLanes; }
};

inline Rows rows_from(int64_t begin, int64_t end) { return {begin, end - begin < kLanes ? int(end - begin) : kLanes}; }

// Fetches a line into the second cache: from the first, what is computed with until then would drive it out. Nothing
// happens where there is no memory.
inline void fetch_line(const float* from) { __builtin_prefetch(from, 0, 2); }

// Fetches the sixteen rows that come some time after these.
template <int kStride>
void fetch(const float* from, const Rows& rows) {
  constexpr int kAhead = 4 * kLanes, kLine = 64 / sizeof(float);
  const float* first = from + kStride * (rows.first + kAhead);
#pragma GCC unroll 1  // many in turn would wait for each other
  for (int i = 0; i < kStride * kLanes; i += kLine) fetch_line(first + i);
}

// The first `count` of the kStride floats of each row, columns becoming vectors.
template <int kStride>
void gather(const float* from, const Rows& rows, int count, F* out) {
  const float* first = from + kStride * rows.first;
  alignas(64) float filled[kStride * kLanes];
  if (!rows.whole()) {
    for (int lane = 0; lane < kLanes; ++lane)
      __builtin_memcpy(filled + kStride * lane, first + kStride * (lane < rows.count ? lane : rows.count - 1),
                       count * sizeof(float));
    first = filled;
  }
  if constexpr (kStride < 4) {
    split_columns<kStride>(first, out);
  } else {
    for (int next = 0; next < count; next += 4) {
      const int k = next + 4 <= count ? next : count - 4;
      F fours[4];
      for (int i = 0; i < 4; ++i) {
        const float* p[4];
        for (int j = 0; j < 4; ++j) p[j] = first + k + kStride * (4 * j + i);
        fours[i] = load_fours(p);
      }
      transpose_fours(fours);
      for (int i = 0; i < 4; ++i) out[k + i] = fours[i];
    }
  }
}

// The inverse of `gather` with all floats of each row.
template <int kStride>
void scatter(const F* columns, const Rows& rows, float* to) {
  float* const first = to + kStride * rows.first;
  alignas(64) float filled[kStride * kLanes];
  float* const out = rows.whole() ? first : filled;
  if constexpr (kStride < 4) {
    join_columns<kStride>(columns, out);
  } else {
    for (int next = 0; next < kStride; next += 4) {
      const int k = next + 4 <= kStride ? next : kStride - 4;
      F fours[4] = {columns[k], columns[k + 1], columns[k + 2], columns[k + 3]};
      transpose_fours(fours);
      for (int i = 0; i < 4; ++i) {
        float* p[4];
        for (int j = 0; j < 4; ++j) p[j] = out + k + kStride * (4 * j + i);
        store_fours(p, fours[i]);
      }
    }
  }
  if (!rows.whole()) __builtin_memcpy(first, filled, rows.count * kStride * sizeof(float));
}

}  // namespace
}  // namespace panolog::PANOLOG_ISA
