// The tiles that splats meet: as in footprint.h, with a splat in each lane. Included only by what is compiled once for
// each instruction set.
#pragma once
#include "kernels.h"
#include "rows.h"
#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

constexpr int kSplatFloats = sizeof(Splat) / sizeof(float);

// Of one splat, whatever its size; returns how many.
uint32_t tiles_of_one(const Splat& s, const Camera& camera, uint32_t* tiles) {
  const int across = tiles_across(camera.width);
  const PixelRows rows = pixel_rows(s, camera.height);
  uint32_t count = 0;
  for (int row = rows.first / kTile; row * kTile <= rows.last; ++row) {
    const Run run = tile_run(s, rows, row, camera.width);
    for (int k = 0, column = run.first; k < run.count; ++k, ++column) {
      if (column == across) column = 0;
      tiles[count++] = uint32_t(row * across + column);
    }
  }
  return count;
}

uint32_t ray_tiles_of_one(const Splat& s, const RaySplat& ray, const Camera& camera, const Grid& grid,
                          uint32_t* tiles) {
  const int across = tiles_across(camera.width);
  const PixelRows rows = pixel_rows(s, camera.height);
  const int top = rows.first / kTile, bottom = rows.last / kTile;
  const Run run = tiles_between(s.u - s.half, s.u + s.half, camera.width);
  if (rows.first > rows.last) return 0;
  const bool narrow = run.count < 2 || top == bottom;  // the box is as large as the footprint
  const RayBounds bounds = narrow ? RayBounds{} : bounds_of(ray);
  const float half_u = half_azimuth(kTile, camera.width), half_v = half_elevation(kTile, camera.height);
  uint32_t count = 0;
  for (int row = top; row <= bottom; ++row)
    for (int k = 0, column = run.first; k < run.count; ++k, ++column) {
      if (column == across) column = 0;
      const auto patch =
          patch_at(grid.sin_u[column], grid.cos_u[column], grid.sin_v[row], grid.cos_v[row], half_u, half_v);
      tiles[count] = uint32_t(row * across + column), count += narrow || may_meet(ray, bounds, patch);
    }
  return count;
}

struct Heights {
  F first, last;  // rows of pixels
  F top, count;   // rows of tiles; none where the splat is not drawn
};

inline Heights heights_of(F v, F reach, Mask drawn, int height) {
  const F first = max(F(0), ceil(v - reach - 0.5f)), last = min(F(height - 1), floor(v + reach - 0.5f));
  const F top = floor(first * (1.0f / kTile));
  return {first, last, top, select(drawn & (last >= first), floor(last * (1.0f / kTile)) - top + 1, 0)};
}

struct Widths {  // as Run
  F first, count;
};

inline Widths widths_between(F u0, F u1, int width) {
  const F left = ceil(u0 - 0.5f), right = floor(u1 - 0.5f);
  const F turns = floor(left / F(width));
  const F from = left - turns * F(width), to = right - turns * F(width);
  const Mask beyond = to >= F(width), around = !(right - left < F(width - kTile));
  const F edge = select(beyond, width - 1, to), first = floor(from * (1.0f / kTile));
  const F count =
      floor(edge * (1.0f / kTile)) - first + 1 + select(beyond, floor((to - F(width)) * (1.0f / kTile)) + 1, 0);
  return {select(around, 0, first), select(left > right, 0, select(around, tiles_across(width), count))};
}

struct Ellipses {
  F u, v, slope, reach, tip, waist;
};

// As tile_run.
inline Widths widths_of(const Ellipses& s, const Heights& rows, F row, int width) {
  const F top = max(rows.first, row * kTile), bottom = min(rows.last, row * kTile + (kTile - 1));
  const F lo = max(top + 0.5f - s.v, -s.reach), hi = min(bottom + 0.5f - s.v, s.reach);
  const F right = min(max(s.tip, lo), hi), left = min(max(-s.tip, lo), hi);
  const F at_right = right / s.reach, at_left = left / s.reach;
  const F u1 = s.slope * right + s.waist * sqrt(max(1 - at_right * at_right, 0));
  const F u0 = s.slope * left - s.waist * sqrt(max(1 - at_left * at_left, 0));
  Widths out = widths_between(s.u + u0, s.u + u1, width);
  out.count = select(hi >= lo, out.count, 0);
  return out;
}

inline Mask drawn_of(const uint8_t* state, int count) {
  alignas(64) float drawn[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) drawn[lane] = lane < count && (!state || state[lane] == kVisible);
  return load(drawn) > 0;
}

struct Found {  // by lane
  alignas(64) int32_t first[kLanes], count[kLanes];
};

// Writes the tiles of a row of tiles that begins with `row`, two even where there are fewer; returns how many there
// are.
inline uint32_t put(const Found& run, int lane, uint32_t row, uint32_t across, uint32_t* tiles) {
  const uint32_t first = uint32_t(run.first[lane]), count = uint32_t(run.count[lane]);
  tiles[0] = row + first, tiles[1] = row + (first + 1 == across ? 0 : first + 1);
  if (__builtin_expect(count > 2, 0))
    for (uint32_t k = 2; k < count; ++k) tiles[k] = row + (first + k < across ? first + k : first + k - across);
  return count;
}

constexpr int kRowsAtOnce = 4;  // of tiles: a splat with more is treated alone

uint32_t tiles_of(const Splat* splats, const uint8_t* state, int count, const Camera& camera, uint32_t* tiles,
                  uint32_t* many) {
  const Rows rows = rows_from(0, count);
  fetch<kSplatFloats>(&splats->u, rows);
  F center[4], shape[4];
  gather<kSplatFloats>(&splats->u, rows, 4, center), gather<kSplatFloats>(&splats->reach, rows, 4, shape);
  const Ellipses s = {center[0], center[1], center[3], shape[0], shape[1], shape[2]};
  const Heights heights = heights_of(s.v, s.reach, drawn_of(state, count), camera.height);
  alignas(64) int32_t top[kLanes], down[kLanes];
  store_integers(top, select(heights.count > 0, heights.top, 0)), store_integers(down, heights.count);
  Found found[kRowsAtOnce];
  for (int k = 0; k < kRowsAtOnce && (k < 2 || bits(heights.count > F(k))); ++k) {
    const Mask inside = heights.count > F(k);
    const Widths run = widths_of(s, heights, heights.top + F(k), camera.width);
    store_integers(found[k].first, select(inside, run.first, 0));
    store_integers(found[k].count, select(inside, run.count, 0));
  }
  const uint32_t across = uint32_t(tiles_across(camera.width));
  uint32_t next = 0;
  for (int lane = 0; lane < count; ++lane) {
    const uint32_t start = next, row = uint32_t(top[lane]) * across;
    if (down[lane] > kRowsAtOnce) {
      next += tiles_of_one(splats[lane], camera, tiles + next);
    } else {
      next += put(found[0], lane, row, across, tiles + next);
      next += put(found[1], lane, row + across, across, tiles + next);
      for (int k = 2; k < down[lane]; ++k) next += put(found[k], lane, row + k * across, across, tiles + next);
    }
    many[lane] = next - start;
  }
  return next;
}

struct Cones {  // as RaySplat
  F x[3], y[3], l[3], kappa, log2_opacity;
};

constexpr int kPlacesAtOnce = 16;  // tiles in the box of a splat: one with more is treated alone

// Which lanes meet the tile at each place of their box, row by row; `most`: places of the largest box.
inline void meet(const Cones& s, const Heights& heights, const Widths& run, const Grid& tiles, const Camera& camera,
                 int most, uint32_t met[kPlacesAtOnce]) {
  const auto bounds = bounds_of<F>(s);
  const float half_u = half_azimuth(kTile, camera.width), half_v = half_elevation(kTile, camera.height);
  const F across = tiles_across(camera.width);
  F row = 0, column = 0;
  for (int place = 0; place < most; ++place) {
    const Mask inside = heights.count > row;
    F at = run.first + column;
    at = select(at >= across, at - across, at);
    alignas(64) int32_t u[kLanes], v[kLanes];
    store_integers(u, select(inside, at, 0)), store_integers(v, select(inside, heights.top + row, 0));
    const auto patch = patch_at(pick(tiles.sin_u, u), pick(tiles.cos_u, u), pick(tiles.sin_v, v), pick(tiles.cos_v, v),
                                half_u, half_v);
    met[place] = bits(inside & may_meet(s, bounds, patch));
    column = column + 1;
    const Mask ended = column >= run.count;
    row = select(ended, row + 1, row), column = select(ended, 0, column);
  }
}

uint32_t ray_tiles_of(const Splat* splats, const RaySplat* rays, const uint8_t* state, int count, const Camera& camera,
                      const Grid& grid, uint32_t* tiles, uint32_t* many) {
  const Rows rows = rows_from(0, count);
  fetch<kSplatFloats>(&splats->u, rows), fetch<kSplatFloats>(rays->x, rows);
  F center[4], shape[4];
  Cones s;
  gather<kSplatFloats>(&splats->u, rows, 4, center), gather<kSplatFloats>(&splats->reach, rows, 4, shape);
  gather<kSplatFloats>(rays->x, rows, 11, s.x);
  const Mask drawn = drawn_of(state, count);
  const Heights heights = heights_of(center[1], shape[0], drawn, camera.height);
  const Widths run = widths_between(center[0] - shape[3], center[0] + shape[3], camera.width);
  const F places = select(heights.count > 0, heights.count * run.count, 0);
  const Mask narrow = (F(2) > run.count) | (F(2) > heights.count);  // the box is as large as the footprint
  alignas(64) int32_t top[kLanes], left[kLanes], wide[kLanes], boxes[kLanes];
  store_integers(top, select(places > 0, heights.top, 0)), store_integers(left, select(places > 0, run.first, 0));
  store_integers(wide, select(places > 0, run.count, 0)), store_integers(boxes, min(places, F(kPlacesAtOnce + 1)));
  int most = 0;
  for (int lane = 0; lane < count; ++lane)
    if (boxes[lane] <= kPlacesAtOnce && !(bits(narrow) >> lane & 1)) most = boxes[lane] > most ? boxes[lane] : most;
  uint32_t met[kPlacesAtOnce];
  for (uint32_t& lanes : met) lanes = ~0u;
  meet(s, heights, run, grid, camera, most, met);
  for (uint32_t& lanes : met) lanes |= bits(narrow);
  const int across = tiles_across(camera.width);
  uint32_t next = 0;
  for (int lane = 0; lane < count; ++lane) {
    const uint32_t start = next;
    if (boxes[lane] > kPlacesAtOnce) {
      next += ray_tiles_of_one(splats[lane], rays[lane], camera, grid, tiles + next);
    } else {
      int row = top[lane], column = 0;
      for (int place = 0; place < boxes[lane]; ++place) {
        const int at = left[lane] + column;
        tiles[next] = uint32_t(row * across + (at < across ? at : at - across)), next += met[place] >> lane & 1;
        if (++column == wide[lane]) column = 0, ++row;
      }
    }
    many[lane] = next - start;
  }
  return next;
}

}  // namespace
}  // namespace panolog::PANOLOG_ISA
