#include "rasterize.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstring>
#include <functional>
#include <stdexcept>
#include <type_traits>
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

std::vector<PatchOf<float>> tile_patches(const Camera& camera) {
  const Directions middles(camera, kTile);
  const Grid at = middles.grid();
  const float half_u = half_azimuth(kTile, camera.width), half_v = half_elevation(kTile, camera.height);
  std::vector<PatchOf<float>> out;
  for (int row = 0; row < tiles_across(camera.height); ++row)
    for (int column = 0; column < tiles_across(camera.width); ++column)
      out.push_back(patch_at(at.sin_u[column], at.cos_u[column], at.sin_v[row], at.cos_v[row], half_u, half_v));
  return out;
}

// Of a splat's tiles those in which it composites; returns how many.
uint32_t drawn_tiles(const Exterior& exterior, bool frozen, float distance, uint32_t* tiles, uint32_t count) {
  uint32_t left = 0;
  for (uint32_t k = 0; k < count; ++k) {
    const float* span = exterior.spans + 2 * tiles[k];
    const bool among = !frozen || (span[0] <= distance && distance <= span[1]);
    tiles[left] = tiles[k], left += exterior.places[tiles[k]] >= 0 && among;
  }
  return left;
}

// Counting sort of (tile, splat) pairs by tile; splats come nearest first, so each tile's entries do too.
// Each part bins a contiguous range of splats: the result does not depend on how many there are.
void bin(const Camera& camera, int64_t gaussians, Buffer<uint32_t>& rows, int threads, const Exterior* exterior,
         Frame& frame) {
  const size_t tiles = size_t(tiles_across(camera.width)) * tiles_across(camera.height);
  struct alignas(128) Range {               // in cache lines of its own
    std::vector<uint32_t> tile_of, starts;  // of each pair; of each tile
  };
  const Parts parts(int64_t(rows.size), threads);
  std::vector<Range> ranges(parts.parts);
  const std::vector<PatchOf<float>> patches = camera.exact ? tile_patches(camera) : std::vector<PatchOf<float>>();
  frame.slots = Buffer<uint32_t>(gaussians + 1);
  std::fill_n(frame.slots.data.get(), gaussians + 1, 0u);
  Buffer<uint32_t> many(rows.size);  // tiles of each splat
  share(parts.parts, threads, [&](int64_t part) {
    Range& range = ranges[part];
    range.starts.assign(tiles, 0);
    Buffer<uint32_t> met(tiles);
    const int64_t end = parts.begin(part + 1);
    for (int64_t i = parts.begin(part); i < end; ++i) {
      if (i + kAhead < end) __builtin_prefetch(&frame.splats[rows[i + kAhead]]);
      const Splat& splat = frame.splats[rows[i]];
      many[i] = camera.exact
                    ? kernels().ray_tiles_of(splat, frame.rays[rows[i]], camera, patches.data(), met.data.get())
                    : kernels().tiles_of(splat, camera, met.data.get());
      if (exterior) many[i] = drawn_tiles(*exterior, rows[i] >= gaussians, splat.distance, met.data.get(), many[i]);
      range.tile_of.insert(range.tile_of.end(), met.data.get(), met.data.get() + many[i]);
      for (uint32_t k = 0; k < many[i]; ++k) ++range.starts[met[k]];
      if (rows[i] < gaussians) frame.slots[rows[i] + 1] = many[i];
      if (range.tile_of.size() > kMaxPairs) break;
    }
  });
  size_t total = 0;
  for (const Range& range : ranges) total += range.tile_of.size();
  if (total > kMaxPairs) throw std::length_error("more than 2^31 pairs of splats and tiles: too many, or too large");
  for (int64_t i = 0; i < gaussians; ++i) frame.slots[i + 1] += frame.slots[i];
  frame.tiles = Buffer<uint32_t>(tiles + 1);
  uint32_t sum = frame.tiles[0] = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    for (Range& range : ranges) sum += range.starts[tile], range.starts[tile] = sum - range.starts[tile];
    frame.tiles[tile + 1] = sum;
  }
  frame.entries = Buffer<Entry>(total);
  share(parts.parts, threads, [&](int64_t part) {
    Range& range = ranges[part];
    size_t pair = 0;
    const int64_t end = parts.begin(part + 1);
    for (int64_t i = parts.begin(part); i < end; ++i) {
      const bool own = rows[i] < gaussians;
      if (i + kAhead < end && rows[i + kAhead] < gaussians) __builtin_prefetch(&frame.slots[rows[i + kAhead]]);
      for (uint32_t k = 0; k < many[i]; ++k)
        frame.entries[range.starts[range.tile_of[pair++]]++] = {rows[i], own ? frame.slots[rows[i]] + k : kNoSlot, 0};
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
  Buffer<uint32_t> rows = nearest_first(splats, state, gaussians.count, frozen, threads);
  bin(camera, gaussians.count, rows, threads, exterior, frame);
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
  const auto pass = [&](auto tile_backward, auto project_backward, auto* sums) {
    using Sums = std::remove_pointer_t<decltype(sums)>;
    backward<Sums>(
        gaussians, camera, threads, exterior, frame,
        [&](const TileInput& tile, Sums* parts) { tile_backward(tile, images, image_gradients, parts); },
        [&](int64_t begin, int64_t end, const Sums* parts) {
          project_backward(gaussians, camera, sh_count, begin, end, frame.splats, frame.slots, parts, gradients);
        });
  };
  const Kernels& k = kernels();
  if (camera.exact)
    pass(k.ray_tile_backward, k.project_rays_backward, static_cast<RayGradient*>(nullptr));
  else
    pass(k.tile_backward, k.project_backward, static_cast<SplatGradient*>(nullptr));
}

}  // namespace panolog
