// Lists the (tile, splat) pairs, splats nearest first. Compiled without contraction, as project.cu is.
#include "raytiles.cuh"

namespace panolog {
namespace {

constexpr int kLanes = 8;  // threads that share a splat, one tile each at a time

// What is frozen around the first `own` splats: all others.
struct Exterior {
  const int32_t* places;  // of each tile: -1 where nothing is drawn; null: there is no exterior
  const float* spans;     // of each tile two distances, between which frozen splats composite
  int64_t own;
};

// The number of a tile; `after`, that after all tiles, where a splat that meets it is not drawn in it.
__device__ __forceinline__ int number_of(int tile, int after, const Exterior& exterior, int64_t splat, float distance) {
  if (!exterior.places) return tile;
  const float* const span = exterior.spans + 2 * tile;
  const bool among = splat < exterior.own || (span[0] <= distance && distance <= span[1]);
  return exterior.places[tile] >= 0 && among ? tile : after;
}

// order (M): rows of the splats, nearest first; ends (M): where the pairs of each end.
// Writes the first `room` pairs into tiles and rows. Tiles are numbered along the rows of tiles, from `first` on.
template <class Tile>
__device__ __forceinline__ void list_pairs(const Splat* splats, const int64_t* order, const int64_t* ends,
                                           const int32_t* tile_counts, int64_t count, int width, int height,
                                           const Exterior& exterior, int first, int64_t room, Tile* tiles,
                                           int32_t* rows) {
  const int64_t i = thread_of_grid() / kLanes;
  if (i >= count) return;
  const int64_t splat = order[i];
  if (!tile_counts[splat]) return;
  const Splat s = splats[splat];
  const PixelRows met = pixel_rows(s, height);
  const int across = tiles_across(width), after = across * tiles_across(height);
  int64_t at = ends[i] - tile_counts[splat];
  for (int row = met.first / kTile; row <= met.last / kTile; ++row) {
    const Run run = tile_run(s, met, row, width);
    for (int k = int(threadIdx.x) % kLanes; k < run.count && at + k < room; k += kLanes) {
      const int column = run.first + k < across ? run.first + k : run.first + k - across;
      tiles[at + k] = Tile(first + number_of(row * across + column, after, exterior, splat, s.distance));
      rows[at + k] = int32_t(splat);
    }
    at += run.count;
  }
}

// The same with exact projection, where lanes test tiles of the box: a whole warp votes until each has listed its own.
template <class Tile>
__device__ __forceinline__ void list_ray_pairs(const Splat* splats, const RaySplat* rays, const Angle* azimuths,
                                               const Angle* elevations, const int64_t* order, const int64_t* ends,
                                               const int32_t* tile_counts, int64_t count, int width, int height,
                                               const Exterior& exterior, int first, int64_t room, Tile* tiles,
                                               int32_t* rows) {
  const int64_t i = thread_of_grid() / kLanes;
  const int lane = int(threadIdx.x) % kLanes, shift = int(threadIdx.x) % kWarp - lane, across = tiles_across(width);
  const int after = across * tiles_across(height);
  int64_t splat = 0, at = 0;
  float distance = 0;
  RaySplat ray = {};
  RayTiles box = {};
  if (i < count) {
    splat = order[i];
    if (tile_counts[splat]) {
      ray = rays[splat], box = ray_tiles(splats[splat], ray, width, height), distance = splats[splat].distance;
      at = ends[i] - tile_counts[splat];
    }
  }
  for (int k = lane; __any_sync(kAllLanes, k - lane < box.count); k += kLanes) {
    const TilePlace place = k < box.count ? place_of(box, k, across) : TilePlace{};
    const bool mine = k < box.count && may_meet_tile(ray, box, place, azimuths, elevations, width, height);
    const uint32_t met = __ballot_sync(kAllLanes, mine) >> shift & ((1u << kLanes) - 1);
    const int64_t to = at + __popc(met & ((1u << lane) - 1));
    if (mine && to < room) {
      tiles[to] = Tile(first + number_of(place.row * across + place.column, after, exterior, splat, distance));
      rows[to] = int32_t(splat);
    }
    at += __popc(met);
  }
}

}  // namespace
}  // namespace panolog

// For fewer than 2¹⁶ tiles, numbered from -2¹⁵ on: sorting takes half the time.
extern "C" __global__ void __launch_bounds__(256)
    bin_narrow(const panolog::Splat* splats, const int64_t* order, const int64_t* ends, const int32_t* tile_counts,
               int64_t count, int64_t width, int64_t height, const int32_t* places, const float* spans, int64_t own,
               int64_t room, int16_t* tiles, int32_t* rows) {
  panolog::list_pairs(splats, order, ends, tile_counts, count, int(width), int(height), {places, spans, own},
                      -(1 << 15), room, tiles, rows);
}

extern "C" __global__ void __launch_bounds__(256)
    bin_wide(const panolog::Splat* splats, const int64_t* order, const int64_t* ends, const int32_t* tile_counts,
             int64_t count, int64_t width, int64_t height, const int32_t* places, const float* spans, int64_t own,
             int64_t room, int32_t* tiles, int32_t* rows) {
  panolog::list_pairs(splats, order, ends, tile_counts, count, int(width), int(height), {places, spans, own}, 0, room,
                      tiles, rows);
}

extern "C" __global__ void __launch_bounds__(256)
    bin_ray_narrow(const panolog::Splat* splats, const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                   const panolog::Angle* elevations, const int64_t* order, const int64_t* ends,
                   const int32_t* tile_counts, int64_t count, int64_t width, int64_t height, const int32_t* places,
                   const float* spans, int64_t own, int64_t room, int16_t* tiles, int32_t* rows) {
  panolog::list_ray_pairs(splats, rays, azimuths, elevations, order, ends, tile_counts, count, int(width), int(height),
                          {places, spans, own}, -(1 << 15), room, tiles, rows);
}

extern "C" __global__ void __launch_bounds__(256)
    bin_ray_wide(const panolog::Splat* splats, const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                 const panolog::Angle* elevations, const int64_t* order, const int64_t* ends,
                 const int32_t* tile_counts, int64_t count, int64_t width, int64_t height, const int32_t* places,
                 const float* spans, int64_t own, int64_t room, int32_t* tiles, int32_t* rows) {
  panolog::list_ray_pairs(splats, rays, azimuths, elevations, order, ends, tile_counts, count, int(width), int(height),
                          {places, spans, own}, 0, room, tiles, rows);
}
