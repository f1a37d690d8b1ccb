#include "rasterize.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstring>
#include <exception>
#include <stdexcept>
#include <vector>

namespace panolog {
namespace {

constexpr int64_t kSpan = 1024;  // Gaussians per unit of work of a thread
constexpr size_t kMaxPairs = size_t(1) << 31;
constexpr int64_t kAhead = 12;  // prefetch distance of reads in the order of depth

// The visible Gaussians, nearest first; those at equal distance in the order of their rows.
// A radix sort, least significant digit first, 11 bits at a time: positive floats order as their bits do.
Buffer<uint32_t> nearest_first(const Splat* splats, const uint8_t* state, int64_t count) {
  struct Item {
    uint32_t key, row;
  };
  const size_t visible = std::count(state, state + count, uint8_t(kVisible));
  Buffer<Item> items(visible), other(visible);
  size_t next = 0;
  for (int64_t i = 0; i < count; ++i)
    if (state[i] == kVisible) {
      std::memcpy(&items[next].key, &splats[i].distance, sizeof(float));
      items[next++].row = uint32_t(i);
    }
  for (int shift = 0; shift < 32; shift += 11) {
    uint32_t starts[2048] = {}, sum = 0;
    for (size_t i = 0; i < visible; ++i) ++starts[items[i].key >> shift & 2047];
    for (uint32_t& start : starts) sum += start, start = sum - start;
    for (size_t i = 0; i < visible; ++i) other[starts[items[i].key >> shift & 2047]++] = items[i];
    std::swap(items, other);
  }
  Buffer<uint32_t> rows(visible);
  for (size_t i = 0; i < visible; ++i) rows[i] = items[i].row;
  return rows;
}

// Counting sort of (tile, splat) pairs by tile; splats come nearest first, so each tile's entries do too.
// Each thread bins a contiguous range of splats: the result does not depend on how many there are.
void bin(const Camera& camera, int64_t gaussians, Buffer<uint32_t>& rows, int threads, Frame& frame) {
  const int64_t count = int64_t(rows.size);
  const size_t tiles = size_t(tiles_across(camera.width)) * tiles_across(camera.height);
  struct Range {
    std::vector<uint32_t> tile_of, starts;  // of each pair; of each tile
  };
  std::vector<Range> ranges(threads);
  std::exception_ptr failed;  // exceptions must not leave a parallel region
  frame.slots = Buffer<uint32_t>(gaussians + 1);
  std::fill_n(frame.slots.data.get(), gaussians + 1, 0u);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int t = 0; t < threads; ++t) try {
      Range& range = ranges[t];
      range.starts.assign(tiles, 0);
      Buffer<uint32_t> met(tiles);
      const int64_t end = count * (t + 1) / threads;
      for (int64_t i = count * t / threads; i < end; ++i) {
        if (i + kAhead < end) __builtin_prefetch(&frame.splats[rows[i + kAhead]]);
        const uint32_t many = kernels().tiles_of(frame.splats[rows[i]], camera, met.data.get());
        range.tile_of.insert(range.tile_of.end(), met.data.get(), met.data.get() + many);
        for (uint32_t k = 0; k < many; ++k) ++range.starts[met[k]];
        frame.slots[rows[i] + 1] = many;
        if (range.tile_of.size() > kMaxPairs) break;
      }
    } catch (...) {
#pragma omp critical
      failed = std::current_exception();
    }
  if (failed) std::rethrow_exception(failed);
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
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int t = 0; t < threads; ++t) {
    Range& range = ranges[t];
    size_t pair = 0;
    const int64_t end = count * (t + 1) / threads;
    for (int64_t i = count * t / threads; i < end; ++i) {
      if (i + kAhead < end) __builtin_prefetch(&frame.slots[rows[i + kAhead]]);
      for (uint32_t slot = frame.slots[rows[i]]; slot < frame.slots[rows[i] + 1]; ++slot)
        frame.entries[range.starts[range.tile_of[pair++]]++] = {rows[i], slot, 0};
    }
  }
}

template <class Visit>
void each_tile_input(const Camera& camera, const FrameView& frame, int threads, Visit visit) {
  const int across = tiles_across(camera.width), tiles = across * tiles_across(camera.height);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int tile = 0; tile < tiles; ++tile) {
    Entry* entries = frame.entries;
    visit(TileInput{frame.splats, entries + frame.tiles[tile], entries + frame.tiles[tile + 1], tile % across * kTile,
                    tile / across * kTile, camera.width, camera.height});
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

void rasterize(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads, Frame& frame,
               const Images& images, uint8_t* state) {
  Stopwatch watch;
  frame.splats = Buffer<Splat>(gaussians.count);
  Splat* splats = frame.splats.data.get();
  each_span(gaussians.count, threads, kSpan, [&](int64_t begin, int64_t end) {
    kernels().project(gaussians, camera, sh_count, begin, end, splats, state);
  });
  watch.lap(latest.project);
  Buffer<uint32_t> rows = nearest_first(splats, state, gaussians.count);
  bin(camera, gaussians.count, rows, threads, frame);
  watch.lap(latest.order);
  each_tile_input(camera, frame.view(), threads, [&](const TileInput& tile) { kernels().tile_forward(tile, images); });
  watch.lap(latest.composite);
}

void rasterize_backward(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
                        const FrameView& frame, const Images& images, const ImageGradients& image_gradients,
                        const GradientArrays& gradients) {
  Stopwatch watch;
  Buffer<SplatGradient> parts(frame.slots[gaussians.count]);
  each_tile_input(camera, frame, threads, [&](const TileInput& tile) {
    kernels().tile_backward(tile, images, image_gradients, parts.data.get());
  });
  watch.lap(latest.composite_backward);
  each_span(gaussians.count, threads, kSpan, [&](int64_t begin, int64_t end) {
    kernels().project_backward(gaussians, camera, sh_count, begin, end, frame.splats, frame.slots, parts.data.get(),
                               gradients);
  });
  watch.lap(latest.project_backward);
}

}  // namespace panolog
