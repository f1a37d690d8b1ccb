// With exact projection: the tiles that a footprint may meet. project.cu counts them and bin.cu lists them; both are
// compiled without contraction, so they find the same to the bit.
#pragma once
#include "common.cuh"

namespace panolog {

// The tiles of a splat's box, numbered along its rows of tiles from 0 to `count`.
struct RayTiles {
  Run run;
  int top, count;
  bool narrow;  // the box is as large as the footprint
  RayBounds bounds;
};

__device__ __forceinline__ RayTiles ray_tiles(const Splat& s, const RaySplat& ray, int width, int height) {
  const PixelRows rows = pixel_rows(s, height);
  const Run run = tiles_between(s.u - s.half, s.u + s.half, width);
  if (rows.first > rows.last) return {};
  const int top = rows.first / kTile, down = rows.last / kTile - top + 1;
  return {run, top, down * run.count, run.count < 2 || down < 2, bounds_of(ray)};
}

struct TilePlace {
  int row, column;
};

__device__ __forceinline__ TilePlace place_of(const RayTiles& box, int k, int across) {
  const int column = box.run.first + k % box.run.count;
  return {box.top + k / box.run.count, column < across ? column : column - across};
}

// Whether the footprint may meet a tile of its box.
__device__ __forceinline__ bool may_meet_tile(const RaySplat& ray, const RayTiles& box, TilePlace at,
                                              const Angle* azimuths, const Angle* elevations, int width, int height) {
  if (box.narrow) return true;
  const PatchOf<float> tile = patch_around(azimuths[2 * kTile * at.column + kTile],
                                           elevations[2 * kTile * at.row + kTile], kTile, kTile, width, height);
  return may_meet(ray, box.bounds, tile);
}

}  // namespace panolog
