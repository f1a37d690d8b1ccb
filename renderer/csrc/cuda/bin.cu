// Lists the (tile, splat) pairs, splats nearest first. Compiled without contraction, as project.cu is.
#include "common.cuh"

namespace panolog {
namespace {

constexpr int kLanes = 8;  // threads that share a splat, one tile each at a time

// order (M): rows of the splats, nearest first; ends (M): where the pairs of each end.
// Writes the first `room` pairs into tiles and rows. Tiles are numbered along the rows of tiles, from `first` on.
template <class Tile>
__device__ __forceinline__ void list_pairs(const Splat* splats, const int64_t* order, const int64_t* ends,
                                           const int32_t* tile_counts, int64_t count, int width, int height, int first,
                                           int64_t room, Tile* tiles, int32_t* rows) {
  const int64_t i = thread_of_grid() / kLanes;
  if (i >= count) return;
  const int64_t splat = order[i];
  if (!tile_counts[splat]) return;
  const Splat s = splats[splat];
  const PixelRows met = pixel_rows(s, height);
  const int across = tiles_across(width);
  int64_t at = ends[i] - tile_counts[splat];
  for (int row = met.first / kTile; row <= met.last / kTile; ++row) {
    const Run run = tile_run(s, met, row, width);
    for (int k = int(threadIdx.x) % kLanes; k < run.count && at + k < room; k += kLanes) {
      const int column = run.first + k < across ? run.first + k : run.first + k - across;
      tiles[at + k] = Tile(first + row * across + column);
      rows[at + k] = int32_t(splat);
    }
    at += run.count;
  }
}

}  // namespace
}  // namespace panolog

// For fewer than 2¹⁶ tiles, numbered from -2¹⁵ on: sorting takes half the time.
extern "C" __global__ void __launch_bounds__(256)
    bin_narrow(const panolog::Splat* splats, const int64_t* order, const int64_t* ends, const int32_t* tile_counts,
               int64_t count, int64_t width, int64_t height, int64_t room, int16_t* tiles, int32_t* rows) {
  panolog::list_pairs(splats, order, ends, tile_counts, count, int(width), int(height), -(1 << 15), room, tiles, rows);
}

extern "C" __global__ void __launch_bounds__(256)
    bin_wide(const panolog::Splat* splats, const int64_t* order, const int64_t* ends, const int32_t* tile_counts,
             int64_t count, int64_t width, int64_t height, int64_t room, int32_t* tiles, int32_t* rows) {
  panolog::list_pairs(splats, order, ends, tile_counts, count, int(width), int(height), 0, room, tiles, rows);
}
