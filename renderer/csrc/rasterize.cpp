#include "rasterize.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstring>
#include <functional>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <vector>

namespace panolog {
namespace {

constexpr int64_t kSpan = 1024;  // Gaussians per unit of work of a thread
constexpr size_t kMaxPairs = size_t(1) << 31;
constexpr int64_t kParts = 4;   // per thread, of loops whose parts have tables of their own
constexpr int64_t kAhead = 12;  // prefetch distance of reads in the order of depth

// Contiguous parts of `count` items that threads share: few, because each has a table of its own.
struct Parts {
  int64_t count, parts;
  Parts(int64_t count, int threads)
      : count(count), parts(std::clamp<int64_t>(count / kSpan, 1, threads == 1 ? 1 : threads * kParts)) {}
  int64_t begin(int64_t part) const { return count * part / parts; }
};

// The visible ones of `count` Gaussians and all splats of the exterior, nearest first; those at equal distance in the
// order of their rows. A radix sort, least significant digit first, 11 bits at a time: positive floats order as their
// bits do.
Buffer<uint32_t> nearest_first(const Splat* splats, const uint8_t* state, int64_t count, int64_t exterior,
                               int threads) {
  struct Item {
    uint32_t key, row;
  };
  using Table = std::array<uint32_t, 2048>;
  const Parts all(count, threads);
  std::vector<size_t> first(all.parts + 1);  // of each part among the visible ones
  for (int64_t part = 0; part < all.parts; ++part)
    first[part + 1] = first[part] + std::count(state + all.begin(part), state + all.begin(part + 1), uint8_t(kVisible));
  const size_t own = first.back(), visible = own + size_t(exterior);
  Buffer<Item> items(visible), other(visible);
  const auto put = [&](size_t at, int64_t row) {
    std::memcpy(&items[at].key, &splats[row].distance, sizeof(float));
    items[at].row = uint32_t(row);
  };
  share(all.parts, threads, [&](int64_t part) {
    size_t next = first[part];
    for (int64_t i = all.begin(part); i < all.begin(part + 1); ++i)
      if (state[i] == kVisible) put(next++, i);
  });
  for (int64_t i = 0; i < exterior; ++i) put(own + size_t(i), count + i);
  const Parts ranges(int64_t(visible), threads);
  std::vector<Table> tables(ranges.parts);  // of each digit: how many there are in the part, then where they go
  for (int shift = 0; shift < 32; shift += 11) {
    share(ranges.parts, threads, [&](int64_t part) {
      tables[part].fill(0);
      for (int64_t i = ranges.begin(part); i < ranges.begin(part + 1); ++i)
        ++tables[part][items[i].key >> shift & 2047];
    });
    uint32_t sum = 0;
    for (size_t digit = 0; digit < 2048; ++digit)
      for (Table& table : tables) sum += table[digit], table[digit] = sum - table[digit];
    share(ranges.parts, threads, [&](int64_t part) {
      for (int64_t i = ranges.begin(part); i < ranges.begin(part + 1); ++i)
        other[tables[part][items[i].key >> shift & 2047]++] = items[i];
    });
    std::swap(items, other);
  }
  Buffer<uint32_t> rows(visible);
  for (size_t i = 0; i < visible; ++i) rows[i] = items[i].row;
  return rows;
}

// Directions on a grid of `step` pixels, which covers whole tiles: `Grid` over memory of its own.
class Directions {
 public:
  Directions() = default;  // none, as affine projection needs
  Directions(const Camera& camera, int step) {
    const int columns = tiles_across(camera.width) * kTile / step, rows = tiles_across(camera.height) * kTile / step;
    const auto angles = [&](int count, double turn, double middle, std::vector<float>& sines,
                            std::vector<float>& cosines) {
      for (int i = 0; i < count; ++i) {
        const double angle = turn * ((i + 0.5) * step - middle);
        sines.push_back(float(std::sin(angle))), cosines.push_back(float(std::cos(angle)));
      }
    };
    constexpr double kPiExact = 3.14159265358979323846;
    angles(columns, 2 * kPiExact / camera.width, 0.5 * camera.width, sin_u_, cos_u_);
    angles(rows, kPiExact / camera.height, 0.5 * camera.height, sin_v_, cos_v_);
  }
  Grid grid() const { return {sin_u_.data(), cos_u_.data(), sin_v_.data(), cos_v_.data()}; }

 private:
  std::vector<float> sin_u_, cos_u_, sin_v_, cos_v_;
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

// Counting sort of (tile, splat) pairs by tile; splats come nearest first, so each tile's entries do too.
// Each part bins a contiguous range of splats: the result does not depend on how many there are.
void bin(const Camera& camera, int64_t gaussians, const Buffer<uint32_t>& rows, const Pairs& pairs, int threads,
         Frame& frame) {
  const size_t tiles = size_t(tiles_across(camera.width)) * tiles_across(camera.height);
  const Parts parts(int64_t(rows.size), threads);
  std::vector<std::vector<uint32_t>> places(parts.parts);  // of each tile: how many entries the part has, then where
  const uint32_t *starts = pairs.starts.data.get(), *tile_of = pairs.tiles.data();
  share(parts.parts, threads, [&](int64_t part) {
    places[part].assign(tiles, 0);
    if (parts.parts == 1)  // all splats: in the order of memory
      for (size_t pair = 0; pair < pairs.tiles.size(); ++pair) ++places[0][tile_of[pair]];
    else
      for (int64_t i = parts.begin(part); i < parts.begin(part + 1); ++i)
        for (uint32_t pair = starts[rows[i]]; pair < starts[rows[i] + 1]; ++pair) ++places[part][tile_of[pair]];
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
    const int64_t end = parts.begin(part + 1);
    for (int64_t i = parts.begin(part); i < end; ++i) {
      if (i + 2 * kAhead < end) __builtin_prefetch(&starts[rows[i + 2 * kAhead]]);
      if (i + kAhead < end) __builtin_prefetch(&tile_of[starts[rows[i + kAhead]]]);
      const uint32_t row = rows[i];
      const bool own = row < gaussians;
      for (uint32_t pair = starts[row]; pair < starts[row + 1]; ++pair)
        frame.entries[place[tile_of[pair]]++] = {row, own ? pair : kNoSlot, 0};
    }
  });
}

bool runs_here(const Kernels& kernels) {
#if defined(__x86_64__)
  if (&kernels == &avx512::kKernels)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw");
  if (&kernels == &avx2::kKernels) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
  return &kernels == &portable::kKernels;
}

#if defined(__x86_64__)
const Kernels* const kAll[] = {&avx512::kKernels, &avx2::kKernels, &portable::kKernels};
#else
const Kernels* const kAll[] = {&portable::kKernels};
#endif

const Kernels* best() {
  for (const Kernels* kernels : kAll)
    if (runs_here(*kernels)) return kernels;
  return &portable::kKernels;
}

const Kernels* chosen = best();

}  // namespace

const Kernels& kernels() { return *chosen; }

bool choose_kernels(const char* name) {
  for (const Kernels* kernels : kAll)
    if (!std::strcmp(kernels->name, name) && runs_here(*kernels)) return chosen = kernels, true;
  return false;
}

Stages latest;

namespace {

class Stopwatch {
 public:
  void lap(double& seconds) {
    const Clock::time_point now = Clock::now();
    seconds = std::chrono::duration<double>(now - last_).count(), last_ = now;
  }

 private:
  using Clock = std::chrono::steady_clock;
  Clock::time_point last_ = Clock::now();
};

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
  const Buffer<uint32_t> rows = nearest_first(splats, state, gaussians.count, frozen, threads);
  bin(camera, gaussians.count, rows, pairs, threads, frame);
  frame.slots = std::move(pairs.starts), frame.slots.size = gaussians.count + 1;
  watch.lap(latest.order);
}

void each_tile(const Camera& camera, const FrameView& frame, int threads, const Exterior* exterior,
               const std::function<void(const TileInput&)>& visit) {
  const int across = tiles_across(camera.width), tiles = across * tiles_across(camera.height);
  const auto directions = [&](int step) { return camera.exact ? Directions(camera, step) : Directions(); };
  const Directions pixels = directions(1), blocks = directions(4);
  share(tiles, threads, [&](int64_t part) {
    const int tile = int(part);
    Entry* entries = frame.entries;
    TileInput in = {frame.splats,
                    frame.rays,
                    pixels.grid(),
                    blocks.grid(),
                    entries + frame.tiles[tile],
                    entries + frame.tiles[tile + 1],
                    nullptr,
                    nullptr,
                    tile % across * kTile,
                    tile / across * kTile,
                    camera.width,
                    camera.height};
    if (exterior && exterior->places[tile] >= 0) {
      const int64_t at = int64_t(exterior->places[tile]) * kPlanes * kTilePixels;
      in.front = exterior->front + at, in.back = exterior->back + at;
    }
    visit(in);
  });
}

void rasterize(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
               const Exterior* exterior, Frame& frame, const Images& images, uint8_t* state) {
  order(gaussians, camera, sh_count, threads, exterior, frame, state);
  Stopwatch watch;
  each_tile(camera, frame.view(), threads, exterior, [&](const TileInput& tile) {
    (camera.exact ? kernels().ray_tile_forward : kernels().tile_forward)(tile, images);
  });
  watch.lap(latest.composite);
}

namespace {

// With the tiles' and the Gaussians' part of the backward pass, which meet in `Sums` of each pair.
template <class Sums, class Tiles, class Spans>
void backward(const GaussianArrays& gaussians, const Camera& camera, int threads, const Exterior* exterior,
              const FrameView& frame, Tiles tiles, Spans spans) {
  Stopwatch watch;
  Buffer<Sums> parts(frame.slots[gaussians.count]);
  each_tile(camera, frame, threads, exterior, [&](const TileInput& tile) { tiles(tile, parts.data.get()); });
  watch.lap(latest.composite_backward);
  each_span(gaussians.count, threads, kSpan, [&](int64_t begin, int64_t end) { spans(begin, end, parts.data.get()); });
  watch.lap(latest.project_backward);
}

}  // namespace

void rasterize_backward(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
                        const Exterior* exterior, const FrameView& frame, const Images& images,
                        const ImageGradients& image_gradients, const GradientArrays& gradients) {
  const int64_t spans = (gaussians.count + kSpan - 1) / kSpan;
  std::vector<double> motion(gradients.motion ? kMotionSums * spans : 0);  // of each span
  const auto pass = [&](auto tile_backward, auto project_backward, auto* sums) {
    using Sums = std::remove_pointer_t<decltype(sums)>;
    backward<Sums>(
        gaussians, camera, threads, exterior, frame,
        [&](const TileInput& tile, Sums* parts) { tile_backward(tile, images, image_gradients, parts); },
        [&](int64_t begin, int64_t end, const Sums* parts) {
          GradientArrays out = gradients;
          if (out.motion) out.motion = &motion[kMotionSums * (begin / kSpan)];
          project_backward(gaussians, camera, sh_count, begin, end, frame.splats, frame.slots, parts, out);
        });
  };
  const Kernels& k = kernels();
  if (camera.exact)
    pass(k.ray_tile_backward, k.project_rays_backward, static_cast<RayGradient*>(nullptr));
  else if (gradients.absolute)
    pass(k.tile_absolute_backward, k.project_absolute_backward, static_cast<AbsoluteGradient*>(nullptr));
  else
    pass(k.tile_backward, k.project_backward, static_cast<SplatGradient*>(nullptr));
  if (gradients.motion) {
    std::fill_n(gradients.motion, kMotionSums, 0);
    for (size_t i = 0; i < motion.size(); ++i) gradients.motion[i % kMotionSums] += motion[i];
  }
}

}  // namespace panolog
