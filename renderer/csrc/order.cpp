// Which splats composite in which tile, nearest first.
#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cstring>
#include <stdexcept>
#include <utility>
#include <vector>

#include "directions.h"
#include "rasterize.h"
#include "stopwatch.h"

namespace panolog {
namespace {

constexpr int64_t kTilesAtOnce = 16;
constexpr size_t kMaxPairs = size_t(1) << 31;
constexpr int64_t kParts = 4;  // per thread, of loops whose parts have tables of their own

// Contiguous parts of `count` items that threads share: few, because each has a table of its own.
struct Parts {
  int64_t count, parts;
  Parts(int64_t count, int threads)
      : count(count), parts(std::clamp<int64_t>(count / kSpan, 1, threads == 1 ? 1 : threads * kParts)) {}
  int64_t begin(int64_t part) const { return count * part / parts; }
};

// Of a splat's tiles those in which it composites; returns how many.
uint32_t drawn_tiles(const Exterior& exterior, bool frozen, float distance, const uint32_t* from, uint32_t count,
                     uint32_t* to) {
  uint32_t left = 0;
  for (uint32_t k = 0; k < count; ++k) {
    const uint32_t tile = from[k];
    const float* span = exterior.spans + 2 * tile;
    const bool among = !frozen || (span[0] <= distance && distance <= span[1]);
    to[left] = tile, left += exterior.places[tile] >= 0 && among;
  }
  return left;
}

// The tiles of each splat, row by row.
struct Pairs {
  Buffer<uint32_t> starts;      // rows + 1
  std::vector<uint32_t> tiles;  // those of row i: starts[i] .. starts[i + 1]
};

// The tiles of a span of splats, the first of which are own ones with a state.
class TileFinder {
 public:
  TileFinder(const Camera& camera, const Frame& frame, const uint8_t* state, int64_t gaussians,
             const Exterior* exterior)
      : camera_(camera),
        frame_(frame),
        state_(state),
        gaussians_(gaussians),
        exterior_(exterior),
        middles_(camera.exact ? Directions(camera, kTile) : Directions()),
        room_(size_t(kAtOnce) * tiles_across(camera.width) * tiles_across(camera.height) + kTileRoom) {}

  // Appends the tiles of splats begin .. end to `tiles`, and writes how many each has to `many`.
  void find(int64_t begin, int64_t end, std::vector<uint32_t>& tiles, uint32_t* many) const {
    Buffer<uint32_t> found(room_);
    for (int64_t at = begin, count; at < end; at += count) {
      count = std::min<int64_t>(kAtOnce, (at < gaussians_ ? std::min(end, gaussians_) : end) - at);
      const uint8_t* state = at < gaussians_ ? state_ + at : nullptr;
      const Splat* splats = frame_.splats.data.get() + at;
      uint32_t total = camera_.exact
                           ? kernels().ray_tiles_of(splats, frame_.rays.data.get() + at, state, int(count), camera_,
                                                    middles_.grid(), found.data.get(), many + at)
                           : kernels().tiles_of(splats, state, int(count), camera_, found.data.get(), many + at);
      if (exterior_) total = drawn(at, splats, int(count), found.data.get(), many + at);
      tiles.insert(tiles.end(), found.data.get(), found.data.get() + total);
      if (tiles.size() > kMaxPairs) break;
    }
  }

 private:
  static constexpr int kAtOnce = 16;
  uint32_t drawn(int64_t at, const Splat* splats, int count, uint32_t* found, uint32_t* many) const {
    uint32_t from = 0, to = 0;
    for (int i = 0; i < count; ++i) {
      const uint32_t all = many[i];
      many[i] = drawn_tiles(*exterior_, at >= gaussians_, splats[i].distance, found + from, all, found + to);
      from += all, to += many[i];
    }
    return to;
  }
  const Camera& camera_;
  const Frame& frame_;
  const uint8_t* state_;
  int64_t gaussians_;
  const Exterior* exterior_;
  Directions middles_;
  size_t room_;
};

Pairs find_tiles(const Camera& camera, const Frame& frame, const uint8_t* state, int64_t gaussians, int threads,
                 const Exterior* exterior) {
  const int64_t rows = int64_t(frame.splats.size);
  const TileFinder finder(camera, frame, state, gaussians, exterior);
  Pairs pairs{Buffer<uint32_t>(rows + 1), {}};
  const Parts parts(rows, threads);
  std::vector<std::vector<uint32_t>> found(parts.parts);
  std::atomic<size_t> total{0};
  share(parts.parts, threads, [&](int64_t part) {
    finder.find(parts.begin(part), parts.begin(part + 1), found[part], pairs.starts.data.get() + 1);
    total += found[part].size();
  });
  if (total > kMaxPairs) throw std::length_error("more than 2^31 pairs of splats and tiles: too many, or too large");
  pairs.starts[0] = 0;
  for (int64_t i = 0; i < rows; ++i) pairs.starts[i + 1] += pairs.starts[i];
  pairs.tiles = std::move(found[0]);
  if (parts.parts == 1) return pairs;
  pairs.tiles.resize(total);
  share(parts.parts - 1, threads, [&](int64_t before) {
    const int64_t part = before + 1;
    std::copy(found[part].begin(), found[part].end(), pairs.tiles.data() + pairs.starts[parts.begin(part)]);
  });
  return pairs;
}

// Puts the entries of one tile, which come in the order of their rows, into that of their distances, whose bits are in
// `met`: those at equal distance stay in the order of their rows. Positive floats order as their bits do.
class Sorter {
 public:
  void sort(Entry* entries, size_t count) {
    if (count <= kFew) {
      insert(entries, count);
      return;
    }
    uint32_t least = UINT32_MAX, most = 0;
    for (size_t i = 0; i < count; ++i) least = std::min(least, entries[i].met), most = std::max(most, entries[i].met);
    if (items_.size() < count) items_.resize(count), other_.resize(count), entries_.resize(count);
    for (size_t i = 0; i < count; ++i) items_[i] = {entries[i].met - least, uint32_t(i)};
    const int bits = std::bit_width(most - least), passes = (bits + kMostBits - 1) / kMostBits;
    for (int pass = 0, shift = 0; pass < passes; ++pass) {
      const int width = (bits - shift + passes - pass - 1) / (passes - pass);
      by_digit(count, shift, width), shift += width;
    }
    std::copy_n(entries, count, entries_.data());
    for (size_t i = 0; i < count; ++i) entries[i] = entries_[items_[i].place];
  }

 private:
  static constexpr size_t kFew = 24;
  static constexpr int kMostBits = 9;  // of a digit: its table stays in the first cache
  struct Item {
    uint32_t key, place;
  };

  static void insert(Entry* entries, size_t count) {
    for (size_t i = 1; i < count; ++i) {
      const Entry entry = entries[i];
      size_t at = i;
      for (; at > 0 && entries[at - 1].met > entry.met; --at) entries[at] = entries[at - 1];
      entries[at] = entry;
    }
  }

  // One pass of a radix sort, least significant digit first.
  void by_digit(size_t count, int shift, int width) {
    const uint32_t mask = (1u << width) - 1;
    std::fill_n(table_.data(), mask + 1, 0);
    for (size_t i = 0; i < count; ++i) ++table_[items_[i].key >> shift & mask];
    uint32_t sum = 0;
    for (uint32_t digit = 0; digit <= mask; ++digit) sum += table_[digit], table_[digit] = sum - table_[digit];
    for (size_t i = 0; i < count; ++i) other_[table_[items_[i].key >> shift & mask]++] = items_[i];
    std::swap(items_, other_);
  }

  std::array<uint32_t, 1 << kMostBits> table_;
  std::vector<Item> items_, other_;
  std::vector<Entry> entries_;
};

// Counting sort of (tile, splat) pairs by tile, then each tile's by distance: its entries stay in a cache, and none of
// the pairs is read in an order that memory does not have. Each part bins a contiguous range of splats: the result does
// not depend on how many there are.
void bin(const Camera& camera, int64_t gaussians, const Pairs& pairs, int threads, Frame& frame) {
  const size_t tiles = size_t(tiles_across(camera.width)) * tiles_across(camera.height);
  const Parts parts(int64_t(frame.splats.size), threads);
  std::vector<std::vector<uint32_t>> places(parts.parts);  // of each tile: how many entries the part has, then where
  const uint32_t *starts = pairs.starts.data.get(), *tile_of = pairs.tiles.data();
  share(parts.parts, threads, [&](int64_t part) {
    places[part].assign(tiles, 0);
    const uint32_t end = starts[parts.begin(part + 1)];
    for (uint32_t pair = starts[parts.begin(part)]; pair < end; ++pair) ++places[part][tile_of[pair]];
  });
  frame.tiles = Buffer<uint32_t>(tiles + 1);
  uint32_t sum = frame.tiles[0] = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    for (auto& place : places) sum += place[tile], place[tile] = sum - place[tile];
    frame.tiles[tile + 1] = sum;
  }
  frame.entries = Buffer<Entry>(pairs.tiles.size());
  share(parts.parts, threads, [&](int64_t part) {
    uint32_t* const place = places[part].data();
    for (int64_t row = parts.begin(part); row < parts.begin(part + 1); ++row) {
      const uint32_t key = std::bit_cast<uint32_t>(frame.splats[row].distance);
      for (uint32_t pair = starts[row]; pair < starts[row + 1]; ++pair)
        frame.entries[place[tile_of[pair]]++] = {uint32_t(row), row < gaussians ? pair : kNoSlot, key};
    }
  });
  each_span(int64_t(tiles), threads, kTilesAtOnce, [&](int64_t begin, int64_t end) {
    Sorter sorter;
    for (int64_t tile = begin; tile < end; ++tile)
      sorter.sort(frame.entries.data.get() + frame.tiles[tile], frame.tiles[tile + 1] - frame.tiles[tile]);
  });
}

}  // namespace

void order(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads, const Exterior* exterior,
           Frame& frame, uint8_t* state) {
  Stopwatch watch;
  const int64_t frozen = exterior ? exterior->count : 0;
  frame.splats = Buffer<Splat>(gaussians.count + frozen);
  if (camera.exact) frame.rays = Buffer<RaySplat>(gaussians.count + frozen);
  Splat* splats = frame.splats.data.get();
  each_span(gaussians.count, threads, kSpan, [&](int64_t begin, int64_t end) {
    if (camera.exact)
      kernels().project_rays(gaussians, camera, sh_count, begin, end, splats, frame.rays.data.get(), state);
    else
      kernels().project(gaussians, camera, sh_count, begin, end, splats, state);
  });
  if (frozen) std::copy_n(exterior->splats, frozen, splats + gaussians.count);
  if (frozen && camera.exact) std::copy_n(exterior->rays, frozen, frame.rays.data.get() + gaussians.count);
  watch.lap(latest.project);
  Pairs pairs = find_tiles(camera, frame, state, gaussians.count, threads, exterior);
  bin(camera, gaussians.count, pairs, threads, frame);
  frame.slots = std::move(pairs.starts), frame.slots.size = gaussians.count + 1;
  watch.lap(latest.order);
}

}  // namespace panolog
