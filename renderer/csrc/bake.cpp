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
std::vector<Span> own_spans(const Frame& frame, int64_t own) {
  std::vector<Span> spans(frame.tiles.size - 1);
  for (size_t tile = 0; tile < spans.size(); ++tile)
    for (uint32_t i = frame.tiles[tile]; i < frame.tiles[tile + 1]; ++i)
      if (const uint32_t splat = frame.entries[i].splat; splat < own) {
        const float distance = frame.splats[splat].distance;
        spans[tile] = {std::min(spans[tile].first, distance), distance};
      }
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

using Entries = std::vector<Entry>;

TileInput with(TileInput tile, Entries& entries) {
  tile.begin = entries.data(), tile.end = tile.begin + entries.size();
  return tile;
}

// What of a tile is not behind its span.
struct Near {
  Entries before, all;          // all: with the own ones. Slots: places in `slots`, for what is frozen in the span.
  std::vector<uint32_t> slots;  // of the frame
};

Near near_of(const TileInput& tile, const float* span, int64_t own) {
  Near near;
  for (const Entry* entry = tile.begin; entry < tile.end; ++entry) {
    const float distance = tile.splats[entry->splat].distance;
    if (distance > span[1]) break;
    const bool between = distance >= span[0], kept = between && entry->splat >= own;
    near.all.push_back({entry->splat, kept ? uint32_t(near.slots.size()) : kNoSlot, 0});
    if (!between) near.before.push_back(near.all.back());
    if (kept) near.slots.push_back(entry->slot);
  }
  return near;
}

// What of a tile composites behind its own splats.
Entries behind_of(const TileInput& tile, const float* span, int64_t own, const uint8_t* among) {
  Entries behind;
  for (const Entry* entry = tile.begin; entry < tile.end; ++entry) {
    const float distance = tile.splats[entry->splat].distance;
    if (entry->splat >= own && distance >= span[0] && (distance > span[1] || !among[entry->splat]))
      behind.push_back(*entry);
  }
  return behind;
}

// An image's gradients by which the backward pass of a tile sums the weights of each splat in its pixels.
struct Ones {
  std::vector<float> color, zero;
  explicit Ones(size_t pixels) : color(3 * pixels), zero(pixels) {
    for (size_t i = 0; i < pixels; ++i) color[3 * i] = 1;
  }
  ImageGradients gradients() const { return {color.data(), zero.data(), zero.data()}; }
};

// Sets seen[slot] for what is frozen in a tile's span and not faint. `scratch` is overwritten.
template <class Gradient, class Forward, class Backward>
void look(const TileInput& tile, Near& near, Forward forward, Backward backward, float faint, const Ones& ones,
          const Images& scratch, uint8_t* seen) {
  std::vector<Gradient> sums(near.slots.size());
  const TileInput all = with(tile, near.all);
  forward(all, scratch), backward(all, scratch, ones.gradients(), sums.data());
  for (size_t i = 0; i < sums.size(); ++i) seen[near.slots[i]] = sums[i].color[0] > faint;
}

}  // namespace

void bake(const GaussianArrays& all, int64_t own, const Camera& camera, int sh_count, float slack, float faint,
          int threads, Baked& baked, const Images& front, const Images& back) {
  Frame& frame = baked.frame;
  {
    Buffer<uint8_t> state{size_t(all.count)};
    order(all, camera, sh_count, threads, nullptr, frame, state.data.get());
  }
  baked.spans = Buffer<float>(2 * (frame.tiles.size - 1));
  widen(own_spans(frame, own), camera, slack, baked.spans.data.get());
  const int across = tiles_across(camera.width);
  const auto span_of = [&](const TileInput& tile) {
    return baked.spans.data.get() + 2 * (size_t(tile.y0 / kTile) * across + tile.x0 / kTile);
  };
  const Kernels& use = kernels();
  const auto forward = camera.exact ? use.ray_tile_forward : use.tile_forward;
  const Ones ones(size_t(camera.width) * camera.height);
  std::vector<uint8_t> seen(frame.entries.size);  // by slot
  each_tile(camera, frame.view(), threads, nullptr, [&](const TileInput& tile) {
    float* span = span_of(tile);
    if (span[0] > span[1]) return;
    Near near = near_of(tile, span, own);
    forward(with(tile, near.before), front);
    if (hidden(tile, front.alpha))
      span[0] = std::numeric_limits<float>::infinity();
    else if (camera.exact)
      look<RayGradient>(tile, near, forward, use.ray_tile_backward, faint, ones, back, seen.data());
    else
      look<SplatGradient>(tile, near, forward, use.tile_backward, faint, ones, back, seen.data());
  });
  baked.among = Buffer<uint8_t>(size_t(all.count));
  for (int64_t i = 0; i < all.count; ++i)
    baked.among[i] = std::find(seen.data() + frame.slots[i], seen.data() + frame.slots[i + 1], 1) !=
                     seen.data() + frame.slots[i + 1];
  each_tile(camera, frame.view(), threads, nullptr, [&](const TileInput& tile) {
    const float* span = span_of(tile);
    if (span[0] > span[1]) return;
    Entries behind = behind_of(tile, span, own, baked.among.data.get());
    forward(with(tile, behind), back);
  });
}

}  // namespace panolog
