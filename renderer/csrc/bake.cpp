#include "bake.h"

#include <algorithm>
#include <limits>
#include <vector>

namespace panolog {
namespace {

constexpr float kUnseen = 1.0f / 255;  // transmittance of a front layer that hides what is behind it

struct Span {
  float first = std::numeric_limits<float>::infinity(), last = 0;
};

// Distances of the own splats of each tile.
std::vector<Span> own_spans(const Frame& frame) {
  std::vector<Span> spans(frame.tiles.size - 1);
  for (size_t tile = 0; tile < spans.size(); ++tile)
    if (const uint32_t begin = frame.tiles[tile], end = frame.tiles[tile + 1]; begin < end)
      spans[tile] = {frame.splats[frame.entries[begin].splat].distance,
                     frame.splats[frame.entries[end - 1].splat].distance};
  return spans;
}

// Those of each tile and its neighbours, around the cylinder.
void widen(const std::vector<Span>& spans, const Camera& camera, float slack, float* out) {
  const int across = tiles_across(camera.width), down = tiles_across(camera.height);
  for (int row = 0; row < down; ++row)
    for (int column = 0; column < across; ++column) {
      Span all;
      for (int y = std::max(row - 1, 0); y <= std::min(row + 1, down - 1); ++y)
        for (int x = column - 1; x <= column + 1; ++x) {
          const Span& span = spans[size_t(y) * across + (x + across) % across];
          all.first = std::min(all.first, span.first), all.last = std::max(all.last, span.last);
        }
      if (const Span& own = spans[size_t(row) * across + column]; own.first <= own.last) all = own;
      float* to = out + 2 * (size_t(row) * across + column);
      to[0] = all.first * (1 - slack), to[1] = all.last * (1 + slack);
    }
}

bool hidden(const TileInput& tile, const float* alpha) {
  for (int y = tile.y0; y < std::min(tile.y0 + kTile, tile.height); ++y)
    for (int x = tile.x0; x < std::min(tile.x0 + kTile, tile.width); ++x)
      if (1 - alpha[size_t(y) * tile.width + x] >= kUnseen) return false;
  return true;
}

}  // namespace

void bake(const GaussianArrays& own, const GaussianArrays& exterior, const Camera& camera, int sh_count, float slack,
          int threads, Baked& baked, const Images& front, const Images& back) {
  Buffer<uint8_t> state(size_t(std::max(own.count, exterior.count)));
  {
    Frame frame;
    order(own, camera, sh_count, threads, nullptr, frame, state.data.get());
    baked.spans = Buffer<float>(2 * (frame.tiles.size - 1));
    widen(own_spans(frame), camera, slack, baked.spans.data.get());
  }
  order(exterior, camera, sh_count, threads, nullptr, baked.frame, state.data.get());
  const int across = tiles_across(camera.width);
  each_tile(camera, baked.frame.view(), threads, nullptr, [&](const TileInput& tile) {
    float* span = baked.spans.data.get() + 2 * (tile.y0 / kTile * across + tile.x0 / kTile);
    if (span[0] > span[1]) return;
    const auto until = [&](auto beyond) {
      return std::partition_point(tile.begin, tile.end,
                                  [&](const Entry& entry) { return !beyond(tile.splats[entry.splat].distance); });
    };
    TileInput before = tile, behind = tile;
    before.end = until([&](float distance) { return distance >= span[0]; });
    behind.begin = until([&](float distance) { return distance > span[1]; });
    const auto forward = camera.exact ? kernels().ray_tile_forward : kernels().tile_forward;
    forward(before, front);
    if (hidden(tile, front.alpha))
      span[0] = std::numeric_limits<float>::infinity();
    else
      forward(behind, back);
  });
  baked.among = Buffer<uint8_t>(size_t(exterior.count));
  std::fill_n(baked.among.data.get(), exterior.count, uint8_t(0));
  for (size_t tile = 0; tile + 1 < baked.frame.tiles.size; ++tile) {
    const float* span = baked.spans.data.get() + 2 * tile;
    for (uint32_t i = baked.frame.tiles[tile]; i < baked.frame.tiles[tile + 1]; ++i) {
      const uint32_t splat = baked.frame.entries[i].splat;
      const float distance = baked.frame.splats[splat].distance;
      if (span[0] <= distance && distance <= span[1]) baked.among[splat] = 1;
    }
  }
}

}  // namespace panolog
