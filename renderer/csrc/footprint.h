// Which tiles a splat's footprint meets: exact for elongated ones, periodic in u. For host and device.
#pragma once
#include "formulas.h"

namespace panolog {

constexpr int kTile = 16;  // pixels

PANOLOG_HD int tiles_across(int width) { return (width + kTile - 1) / kTile; }

// A projected splat gets its bounds, which may be generous: pixels decide. Hidden if it lies above or below the image.
PANOLOG_HD State bound(Splat& s, const Camera& camera) {
  s.cut += 1e-3f;
  if (sqrtf(s.cut * s.var_u) > 0.5f * camera.width - 2 * kTile) s.flags |= kWide;
  const float reach = sqrtf(s.cut * s.var_v);
  return s.v + reach < 0.5f || s.v - reach > camera.height - 0.5f ? kHidden : kVisible;
}

// The exact u-interval of a footprint {quadratic form ≤ cut} within the rows [v0, v1]; false where it is empty.
PANOLOG_HD bool band(const Splat& s, float v0, float v1, float& u0, float& u1) {
  const float reach = sqrtf(s.cut * s.var_v), half = sqrtf(s.cut * s.var_u);
  const float lo = fmaxf(v0 - s.v, -reach), hi = fminf(v1 - s.v, reach);
  if (!(lo <= hi)) return false;
  const float slope = s.slope;                                  // centre line of the ellipse, du per dv
  const float width = -0.5f * kLog2E / s.a;                     // conditional variance of u
  const float tip = s.cov / s.var_u * half;                     // dv at which u is largest
  const float inv = 1 / s.var_v;
  const float at_lo = sqrtf(fmaxf((s.cut - lo * lo * inv) * width, 0.0f));
  const float at_hi = sqrtf(fmaxf((s.cut - hi * hi * inv) * width, 0.0f));
  u1 = (tip >= lo && tip <= hi) ? half : fmaxf(slope * lo + at_lo, slope * hi + at_hi);
  u0 = (-tip >= lo && -tip <= hi) ? -half : fminf(slope * lo - at_lo, slope * hi - at_hi);
  u0 += s.u, u1 += s.u;
  return true;
}

struct PixelRows {  // first > last: none
  int first, last;
};

// Rows of pixels whose centres lie within the height of a footprint.
PANOLOG_HD PixelRows pixel_rows(const Splat& s, int height) {
  const float reach = sqrtf(s.cut * s.var_v);
  return {int(fmaxf(0.0f, ceilf(s.v - reach - 0.5f))), int(fminf(float(height - 1), floorf(s.v + reach - 0.5f)))};
}

// Neighbouring tiles in one row of tiles: `count` of them from column `first` on, around the cylinder.
struct Run {
  int first, count;
};

// The tiles in row `row` of tiles with a pixel centre inside the footprint, whose pixel rows are `rows`.
PANOLOG_HD Run tile_run(const Splat& s, PixelRows rows, int row, int width) {
  const int top = rows.first > row * kTile ? rows.first : row * kTile;
  const int bottom = rows.last < row * kTile + kTile - 1 ? rows.last : row * kTile + kTile - 1;
  float u0, u1;
  if (!band(s, top + 0.5f, bottom + 0.5f, u0, u1)) return {0, 0};
  const float left = ceilf(u0 - 0.5f), right = floorf(u1 - 0.5f);
  if (left > right) return {0, 0};
  if (!(right - left < width - kTile)) return {0, tiles_across(width)};
  const float turns = floorf(left / width);
  const int from = int(left - turns * width), to = int(right - turns * width);  // `to` may lie beyond the seam
  const int edge = to < width ? to : width - 1;
  return {from / kTile, edge / kTile - from / kTile + 1 + (to >= width ? (to - width) / kTile + 1 : 0)};
}

}  // namespace panolog
