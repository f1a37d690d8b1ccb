#include "rasterize.h"

#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>

namespace panolog {
namespace {

constexpr int64_t kSpan = 1024;  // Gaussians that a thread takes at a time

int tiles_across(const Camera& camera) { return (camera.width + kTile - 1) / kTile; }
int tiles_down(const Camera& camera) { return (camera.height + kTile - 1) / kTile; }

// Rows of `values` in ascending order, stable: least significant digit first, 11 bits at a time.
// Distances are positive, so their bits order as they do.
std::vector<uint32_t> ascending(const std::vector<float>& values) {
  const size_t count = values.size();
  std::vector<uint32_t> keys(count), order(count), other_keys(count), other(count);
  std::memcpy(keys.data(), values.data(), count * sizeof(float));
  for (size_t i = 0; i < count; ++i) order[i] = uint32_t(i);
  for (int shift = 0; shift < 32; shift += 11) {
    uint32_t starts[2048] = {};
    for (uint32_t key : keys) ++starts[key >> shift & 2047];
    uint32_t sum = 0;
    for (uint32_t& start : starts) sum += start, start = sum - start;
    for (size_t i = 0; i < count; ++i) {
      const uint32_t to = starts[keys[i] >> shift & 2047]++;
      other_keys[to] = keys[i], other[to] = order[i];
    }
    keys.swap(other_keys), order.swap(other);
  }
  return order;
}

// Calls visit(tile) for every tile with a pixel centre inside the footprint; exact for elongated ones, periodic in u.
template <class Visit>
void each_tile(const Splat& s, const Camera& camera, Visit visit) {
  const int across = tiles_across(camera), width = camera.width;
  const float reach = std::sqrt(s.cut * s.var_v);
  const int first = int(std::max(0.0f, std::ceil(s.v - reach - 0.5f)));
  const int last = int(std::min(float(camera.height - 1), std::floor(s.v + reach - 0.5f)));
  for (int row = first; row <= last; row = (row / kTile + 1) * kTile) {
    const int end = std::min(last, (row / kTile + 1) * kTile - 1);
    float u0, u1;
    if (!band(s, row + 0.5f, end + 0.5f, u0, u1)) continue;
    const float left = std::ceil(u0 - 0.5f), right = std::floor(u1 - 0.5f);
    if (left > right) continue;
    const uint32_t base = uint32_t(row / kTile) * across;
    if (right - left >= width - kTile) {
      for (int column = 0; column < across; ++column) visit(base + column);
      continue;
    }
    const float turns = std::floor(left / width);
    const int from = int(left - turns * width), to = int(right - turns * width);  // to may lie beyond the seam
    for (int column = from / kTile; column <= std::min(to, width - 1) / kTile; ++column) visit(base + column);
    if (to >= width)
      for (int column = 0; column <= (to - width) / kTile; ++column) visit(base + column);
  }
}

void project_all(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads, Frame& frame,
                 uint8_t* state) {
  const int64_t count = gaussians.count;
  std::vector<Splat> splats(count);
  each_span(count, threads, kSpan, [&](int64_t begin, int64_t end) {
    kernels().project(gaussians, camera, sh_count, begin, end, splats.data(), state);
  });
  std::vector<uint32_t> rows;
  std::vector<float> distances;
  for (int64_t i = 0; i < count; ++i)
    if (state[i] == kVisible) rows.push_back(uint32_t(i)), distances.push_back(splats[i].distance);
  const std::vector<uint32_t> order = ascending(distances);
  frame.splats.resize(rows.size());
  frame.ids.resize(rows.size());
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t i = 0; i < int64_t(rows.size()); ++i) {
    frame.ids[i] = rows[order[i]];
    frame.splats[i] = splats[frame.ids[i]];
  }
}

// Counting sort of (tile, splat) pairs by tile; splats come nearest first, so each tile's entries do too.
// Each thread bins a contiguous range of splats: the result does not depend on how many there are.
void bin(const Camera& camera, int threads, Frame& frame) {
  const int64_t count = int64_t(frame.splats.size());
  const size_t tiles = size_t(tiles_across(camera)) * tiles_down(camera);
  struct Range {
    std::vector<uint32_t> tile_of, starts;  // per pair; per tile
  };
  std::vector<Range> ranges(threads);
  frame.slots.assign(count + 1, 0);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int t = 0; t < threads; ++t) {
    Range& range = ranges[t];
    range.starts.assign(tiles, 0);
    for (int64_t i = count * t / threads; i < count * (t + 1) / threads; ++i) {
      const size_t before = range.tile_of.size();
      each_tile(frame.splats[i], camera, [&](uint32_t tile) {
        range.tile_of.push_back(tile);
        ++range.starts[tile];
      });
      frame.slots[i + 1] = uint32_t(range.tile_of.size() - before);
    }
  }
  size_t total = 0;
  for (const Range& range : ranges) total += range.tile_of.size();
  if (total > std::numeric_limits<uint32_t>::max()) throw std::length_error("more than 2^32 splat-tile pairs");
  for (int64_t i = 0; i < count; ++i) frame.slots[i + 1] += frame.slots[i];
  frame.tiles.assign(tiles + 1, 0);
  uint32_t sum = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    for (Range& range : ranges) sum += range.starts[tile], range.starts[tile] = sum - range.starts[tile];
    frame.tiles[tile + 1] = sum;
  }
  frame.entries.resize(total);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int t = 0; t < threads; ++t) {
    Range& range = ranges[t];
    size_t pair = 0;
    for (int64_t i = count * t / threads; i < count * (t + 1) / threads; ++i)
      for (uint32_t slot = frame.slots[i]; slot < frame.slots[i + 1]; ++slot)
        frame.entries[range.starts[range.tile_of[pair++]]++] = {uint32_t(i), slot};
  }
}

template <class Visit>
void each_tile_input(const Camera& camera, const FrameView& frame, int threads, Visit visit) {
  const int across = tiles_across(camera), tiles = across * tiles_down(camera);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int tile = 0; tile < tiles; ++tile) {
    const Entry* entries = frame.entries;
    visit(TileInput{frame.splats, entries + frame.tiles[tile], entries + frame.tiles[tile + 1],
                    tile % across * kTile, tile / across * kTile, camera.width, camera.height});
  }
}

}  // namespace

namespace {

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

void rasterize(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads, Frame& frame,
               const Images& images, uint8_t* state) {
  project_all(gaussians, camera, sh_count, threads, frame, state);
  bin(camera, threads, frame);
  each_tile_input(camera, frame.view(), threads, [&](const TileInput& tile) { kernels().tile_forward(tile, images); });
}

void rasterize_backward(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
                        const FrameView& frame, const Images& images, const ImageGradients& image_gradients,
                        const GradientArrays& gradients) {
  std::vector<SplatGradient> parts(frame.slots[frame.count]);
  each_tile_input(camera, frame, threads, [&](const TileInput& tile) {
    kernels().tile_backward(tile, images, image_gradients, parts.data());
  });
  each_span(frame.count, threads, kSpan, [&](int64_t begin, int64_t end) {
    kernels().project_backward(gaussians, camera, sh_count, begin, end, frame.splats, frame.ids, frame.slots,
                               parts.data(), gradients);
  });
}

}  // namespace panolog
