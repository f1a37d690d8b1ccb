// Which tiles a splat's footprint meets: exact for elongated ones, periodic in u. For host and device.
#pragma once
#include "formulas.h"

namespace panolog {

constexpr int kTile = 16;  // pixels

PANOLOG_HD int tiles_across(int width) { return (width + kTile - 1) / kTile; }

// Whether a projected splat reaches a row of pixels.
PANOLOG_HD bool above_or_below(const Splat& s, const Camera& camera) {
  return s.v + s.reach < 0.5f || s.v - s.reach > camera.height - 0.5f;
}

// The u-interval of a footprint, relative to its centre, within the rows [v0, v1] relative to it; false where it is
// empty. Its edges are concave functions of v: over an interval they are largest at the nearest point to their tip.
PANOLOG_HD bool band(const Splat& s, float v0, float v1, float& u0, float& u1) {
  const float lo = fmaxf(v0, -s.reach), hi = fminf(v1, s.reach);
  if (!(lo <= hi)) return false;
  const float right = fminf(fmaxf(s.tip, lo), hi), left = fminf(fmaxf(-s.tip, lo), hi);
  const float at_right = right / s.reach, at_left = left / s.reach;
  u1 = s.slope * right + s.waist * sqrtf(fmaxf(1 - at_right * at_right, 0.0f));
  u0 = s.slope * left - s.waist * sqrtf(fmaxf(1 - at_left * at_left, 0.0f));
  return true;
}

// Whether pixels of a tile see different images of a splat with its centre `u` from the tile's left edge, the nearest
// image there is: the far side of the cylinder crosses the tile, and the footprint reaches it.
PANOLOG_HD bool wraps(float u, float half, int width) {
  const float middle = kTile / 2;
  return fabsf(u - middle) > 0.5f * width - middle && half > 0.5f * width - kTile;
}

struct PixelRows {  // first > last: none
  int first, last;
};

// Rows of pixels whose centres lie within the height of a footprint.
PANOLOG_HD PixelRows pixel_rows(const Splat& s, int height) {
  return {int(fmaxf(0.0f, ceilf(s.v - s.reach - 0.5f))), int(fminf(float(height - 1), floorf(s.v + s.reach - 0.5f)))};
}

// Neighbouring tiles in one row of tiles: `count` of them from column `first` on, around the cylinder.
struct Run {
  int first, count;
};

// The tiles with a pixel centre between two columns, of which the left one may lie beyond the seam.
PANOLOG_HD Run tiles_between(float u0, float u1, int width) {
  const float left = ceilf(u0 - 0.5f), right = floorf(u1 - 0.5f);
  if (left > right) return {0, 0};
  if (!(right - left < width - kTile)) return {0, tiles_across(width)};
  const float turns = floorf(left / width);
  const int from = int(left - turns * width), to = int(right - turns * width);  // `to` may lie beyond the seam
  const int edge = to < width ? to : width - 1;
  return {from / kTile, edge / kTile - from / kTile + 1 + (to >= width ? (to - width) / kTile + 1 : 0)};
}

// The tiles in row `row` of tiles with a pixel centre inside the footprint, whose pixel rows are `rows`.
PANOLOG_HD Run tile_run(const Splat& s, PixelRows rows, int row, int width) {
  const int top = rows.first > row * kTile ? rows.first : row * kTile;
  const int bottom = rows.last < row * kTile + kTile - 1 ? rows.last : row * kTile + kTile - 1;
  float u0, u1;
  if (!band(s, top + 0.5f - s.v, bottom + 0.5f - s.v, u0, u1)) return {0, 0};
  return tiles_between(s.u + u0, s.u + u1, width);
}

}  // namespace panolog
