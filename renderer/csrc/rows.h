// Sixteen rows of arrays at a time, columns becoming vectors. Included only by what is compiled once for each
// instruction set.
#pragma once
#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

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
