#include "rasterize.h"

#include <algorithm>
#include <atomic>
#include <cstring>
#include <functional>
#include <new>
#include <type_traits>
#include <vector>

#include "directions.h"
#include "stopwatch.h"

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace panolog {
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

void* allocate(size_t bytes) {
  constexpr size_t kLine = 64, kLarge = size_t(1) << 21;  // of x86 and of ARM with pages of 4 KiB
  const size_t step = bytes >= 4 * kLarge ? kLarge : kLine,
               whole = (std::max<size_t>(bytes, 1) + step - 1) / step * step;
  void* const memory = std::aligned_alloc(step, whole);
  if (!memory) throw std::bad_alloc();
#if defined(__linux__)
  if (step == kLarge) madvise(memory, whole, MADV_HUGEPAGE);  // a wish: nothing depends on it
#endif
  return memory;
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

// The gradients of the parameters of a span: they stay in a cache until the step has used them.
struct SpanGradients {
  alignas(64) float means[3 * kSpan], quats[4 * kSpan], scales[3 * kSpan], opacities[kSpan], sh0[3 * kSpan];
  alignas(64) float shN[45 * kSpan];

  GradientArrays with(GradientArrays others) {
    others.means = means, others.quats = quats, others.scales = scales, others.opacities = opacities;
    others.sh0 = sh0, others.shN = shN;
    return others;
  }
};

// From as many Gaussians on their gradients are larger than most caches, and only a later pass reads them: writing them
// past the caches saves reading those lines first.
constexpr int64_t kStreamed = 1 << 18;

}  // namespace

void rasterize_backward(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
                        const Exterior* exterior, const FrameView& frame, const Images& images,
                        const ImageGradients& image_gradients, const GradientArrays& gradients, Step* step) {
  const int64_t spans = (gaussians.count + kSpan - 1) / kSpan;
  std::vector<double> motion(gradients.motion ? kMotionSums * spans : 0);  // of each span
  std::atomic<uint32_t> broken{0};
  const auto pass = [&](auto tile_backward, auto project_backward, auto* sums) {
    using Sums = std::remove_pointer_t<decltype(sums)>;
    backward<Sums>(
        gaussians, camera, threads, exterior, frame,
        [&](const TileInput& tile, Sums* parts) { tile_backward(tile, images, image_gradients, parts); },
        [&](int64_t begin, int64_t end, const Sums* parts) {
          GradientArrays out = gradients.from(begin);
          out.streaming = !step && gaussians.count >= kStreamed;
          if (out.motion) out.motion = &motion[kMotionSums * (begin / kSpan)];
          const auto into = [&](const GradientArrays& arrays) {
            project_backward(gaussians.from(begin), camera, sh_count, end - begin, frame.splats + begin,
                             frame.slots + begin, parts, arrays);
          };
          if (!step) return into(out);
          SpanGradients found;
          into(found.with(out));
          broken |= step->take(found.with(out), begin, end - begin);
        });
  };
  const Kernels& k = kernels();
  if (camera.exact)
    pass(k.ray_tile_backward, k.project_rays_backward, static_cast<RayGradient*>(nullptr));
  else if (gradients.absolute)
    pass(k.tile_absolute_backward, k.project_absolute_backward, static_cast<AbsoluteGradient*>(nullptr));
  else
    pass(k.tile_backward, k.project_backward, static_cast<SplatGradient*>(nullptr));
  if (step) step->broken = broken;
  if (gradients.motion) {
    std::fill_n(gradients.motion, kMotionSums, 0);
    for (size_t i = 0; i < motion.size(); ++i) gradients.motion[i % kMotionSums] += motion[i];
  }
}

uint32_t Step::take(const GradientArrays& found, int64_t row, int64_t rows) const {
  const float* const gradients[kParameters] = {found.means,     found.quats, found.scales,
                                               found.opacities, found.sh0,   found.shN};
  uint32_t bad = 0;
  for (int k = 0; k < kParameters; ++k)
    if (!move_rows(parameters[k], gradients[k], row, rows)) bad |= 1u << k;
  return bad;
}

}  // namespace panolog
