// Sixteen rows of arrays at a time, columns becoming vectors. Included only by what is compiled once for each
// instruction set.
#pragma once
#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

// The Gaussian of each lane. If fewer than sixteen are left, the last one fills the remaining lanes.
struct Rows {
  int64_t row[kLanes];
};

Rows rows_from(int64_t begin, int64_t end) {
  Rows out;
  for (int lane = 0; lane < kLanes; ++lane) out.row[lane] = begin + lane < end ? begin + lane : end - 1;
  return out;
}

// The first `count` of the `stride` floats of each row, columns becoming vectors.
void gather(const float* from, const Rows& rows, int stride, int count, F* out) {
  if (count < 4) {
    for (int k = 0; k < count; ++k) {
      alignas(64) float column[kLanes];
      for (int lane = 0; lane < kLanes; ++lane) column[lane] = from[stride * rows.row[lane] + k];
      out[k] = load(column);
    }
    return;
  }
  for (int next = 0; next < count; next += 4) {
    const int k = next + 4 <= count ? next : count - 4;
    F fours[4];
    for (int i = 0; i < 4; ++i) {
      const float* p[4];
      for (int j = 0; j < 4; ++j) p[j] = from + stride * rows.row[4 * j + i] + k;
      fours[i] = load_fours(p);
    }
    transpose_fours(fours);
    for (int i = 0; i < 4; ++i) out[k + i] = fours[i];
  }
}

// The inverse of `gather`.
void scatter(const F* columns, const Rows& rows, int stride, int count, float* out) {
  if (count < 4) {
    for (int k = 0; k < count; ++k) {
      alignas(64) float column[kLanes];
      store(column, columns[k]);
      for (int lane = 0; lane < kLanes; ++lane) out[stride * rows.row[lane] + k] = column[lane];
    }
    return;
  }
  for (int next = 0; next < count; next += 4) {
    const int k = next + 4 <= count ? next : count - 4;
    F fours[4] = {columns[k], columns[k + 1], columns[k + 2], columns[k + 3]};
    transpose_fours(fours);
    for (int i = 0; i < 4; ++i) {
      float* p[4];
      for (int j = 0; j < 4; ++j) p[j] = out + stride * rows.row[4 * j + i] + k;
      store_fours(p, fours[i]);
    }
  }
}

}  // namespace
}  // namespace panolog::PANOLOG_ISA
