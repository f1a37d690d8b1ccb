// The tiles that a footprint meets: exact for elongated ones, periodic in u.
#pragma once
#include "common.cuh"

namespace panolog {

// Neighbouring tiles in one row of tiles: `count` of them from column `first` on, around the cylinder.
struct Run {
  int first, count;
};

struct TileRows {  // first > last: none
  int first, last;
};

// Rows of pixels whose centres lie within the height of a footprint.
__device__ __forceinline__ TileRows pixel_rows(const Splat& s, int height) {
  const float reach = sqrtf(s.cut * s.var_v);
  return {int(fmaxf(0.0f, ceilf(s.v - reach - 0.5f))),
          int(fminf(float(height - 1), floorf(s.v + reach - 0.5f)))};
}

// The tiles in row `row` of tiles with a pixel centre inside the footprint, whose pixel rows are `rows`.
__device__ __forceinline__ Run tile_run(const Splat& s, TileRows rows, int row, int width) {
  const int top = max(rows.first, row * kTile), bottom = min(rows.last, row * kTile + kTile - 1);
  float u0, u1;
  if (!band(s, top + 0.5f, bottom + 0.5f, u0, u1)) return {0, 0};
  const float left = ceilf(u0 - 0.5f), right = floorf(u1 - 0.5f);
  if (left > right) return {0, 0};
  if (right - left >= width - kTile) return {0, divide_up(width, kTile)};
  const float turns = floorf(left / width);
  const int from = int(left - turns * width), to = int(right - turns * width);  // to may lie beyond the seam
  const int before = min(to, width - 1) / kTile - from / kTile + 1;
  return {from / kTile, before + (to >= width ? (to - width) / kTile + 1 : 0)};
}

}  // namespace panolog
