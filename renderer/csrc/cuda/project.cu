// Forward and backward projection of N Gaussians, one thread for each: affine (eq. 2, appendix B), and exact (rays.h).
// Of a Gaussian's 59 floats 45 lie in one row; they pass through shared memory, so that a warp moves whole lines.
// Compiled without contraction into fused multiply-adds: bin.cu must find the same tiles to the bit.
#include "adam.cuh"
#include "raytiles.cuh"

namespace panolog {
namespace {

constexpr int kSpan = 128;           // threads and Gaussians of a block
constexpr int kRest = 45;            // floats of shN
constexpr int kMotionSpan = 4096;    // Gaussians whose motion a block sums
constexpr int kMotionParts = 4;      // threads that share one sum: all of them are not more than a block's
constexpr float kNowhere = 3.4e38f;  // depth of a splat without tiles: sorted last

struct Model {
  const float *means, *quats, *scales, *opacities, *sh0;
};

struct Outputs {
  Splat* splats;
  uint8_t* state;
  float* depth;
  int32_t* tile_counts;
};

__device__ __forceinline__ Parameters<float> parameters(const Model& m, int64_t i, const float* shN) {
  return {m.means + 3 * i, m.quats + 4 * i, m.scales + 3 * i, m.opacities[i], m.sh0 + 3 * i, shN};
}

// visit(k) for each float of the rows of this block's Gaussians, all threads together.
template <class Visit>
__device__ __forceinline__ void each_of_rest(int64_t begin, int64_t count, Visit visit) {
  const int floats = int(count - begin < kSpan ? count - begin : kSpan) * kRest;
  for (int k = int(threadIdx.x); k < floats; k += kSpan) visit(k);
}

// Copies these rows from device to shared memory.
__device__ __forceinline__ void load_rest(const float* shN, float* rest, int64_t begin, int64_t count) {
  each_of_rest(begin, count, [&](int k) { rest[k] = shN[begin * kRest + k]; });
}

__device__ __forceinline__ int tiles_met(const Splat& s, const Camera& camera) {
  const PixelRows rows = pixel_rows(s, camera.height);
  int count = 0;
  if (rows.first <= rows.last)
    for (int row = rows.first / kTile; row <= rows.last / kTile; ++row)
      count += tile_run(s, rows, row, camera.width).count;
  return count;
}

__device__ __forceinline__ int tiles_met(const Splat& s, const RaySplat& ray, const Camera& camera,
                                         const Angle* azimuths, const Angle* elevations) {
  const RayTiles box = ray_tiles(s, ray, camera.width, camera.height);
  if (box.narrow) return box.count;
  const int across = tiles_across(camera.width);
  int count = 0;
  for (int k = 0; k < box.count; ++k)
    count += may_meet_tile(ray, box, place_of(box, k, across), azimuths, elevations, camera.width, camera.height);
  return count;
}

// tiles(): how many the splat meets.
template <class Tiles>
__device__ __forceinline__ void write_splat(const Splat& s, Visibility<float> seen, const Camera& camera, Tiles tiles,
                                            int64_t i, const Outputs& out) {
  const bool drawn = seen.visible && !above_or_below(s, camera);
  const int met = drawn ? tiles() : 0;
  out.splats[i] = s;
  out.state[i] = drawn ? kVisible : seen.invalid ? kInvalid : kHidden;
  out.depth[i] = met ? s.distance : kNowhere;
  out.tile_counts[i] = met;
}

// The gradients of one Gaussian, but for shN.
struct Row {
  float mean[3], quat[4], scale[3], opacity[1], sh0[3];
};

// take.one(parameter, place, row, gradient) for each value of a row.
template <class Take>
__device__ __forceinline__ void take_row(const Take& take, int64_t i, const Row& g) {
#pragma unroll
  for (int k = 0; k < 3; ++k) take.one(kMean, 3 * i + k, i, g.mean[k]);
#pragma unroll
  for (int k = 0; k < 4; ++k) take.one(kQuat, 4 * i + k, i, g.quat[k]);
#pragma unroll
  for (int k = 0; k < 3; ++k) take.one(kScale, 3 * i + k, i, g.scale[k]);
  take.one(kOpacity, i, i, g.opacity[0]);
#pragma unroll
  for (int k = 0; k < 3; ++k) take.one(kSh0, 3 * i + k, i, g.sh0[k]);
}

// Which gradients of a row are not finite, a bit for each parameter.
__device__ __forceinline__ int32_t broken_of(const Row& g, const float* rest, int rest_count, const float* screen) {
  const bool sound[kParameters] = {finite(g.mean, 3) && finite(screen, 2),
                                   finite(g.quat, 4),
                                   finite(g.scale, 3),
                                   finite(g.opacity, 1),
                                   finite(g.sh0, 3),
                                   finite(rest, rest_count)};
  int32_t found = 0;
#pragma unroll
  for (int k = 0; k < kParameters; ++k) found |= sound[k] ? 0 : kBrokenGradient << k;
  return found;
}

// What all Gaussians receive in the backward pass besides the gradients of their parameters. `absolute` and `motion`
// may be null.
struct Seen {
  float *screen, *absolute, *motion;
};

// `rest`: shared memory for shN, replaced by its gradient. Where no splat is drawn the gradients are 0.
template <class Sums, class Take>
__device__ __forceinline__ void take_gradients(const Model& model, const float* shN, const Camera& camera,
                                               int64_t sh_count, int64_t count, const Splat* splats,
                                               const int32_t* tile_counts, const Sums* sums, const Seen& seen,
                                               float* rest, const Take& take) {
  const int64_t begin = int64_t(blockIdx.x) * kSpan, i = begin + threadIdx.x;
  const int rest_count = 3 * (int(sh_count) - 1);
  float* const own = rest + kRest * threadIdx.x;
  if (sh_count > 1) load_rest(shN, rest, begin, count);
  __syncthreads();
  const bool drawn = i < count && tile_counts[i] > 0;
  Row g = {};
  if (drawn) {
    const ParameterGradients<float> out = {g.mean,
                                           g.quat,
                                           g.scale,
                                           g.opacity,
                                           g.sh0,
                                           own,
                                           seen.screen + 2 * i,
                                           seen.absolute ? seen.absolute + 2 * i : nullptr,
                                           seen.motion ? seen.motion + kMotion * i : nullptr};
    project_backward(parameters(model, i, own), camera, int(sh_count), splats[i], sums[i], out);
    take.note(g, own, rest_count, out.screen);
  } else if (i < count) {
    seen.screen[2 * i] = seen.screen[2 * i + 1] = 0;
    if (seen.absolute) seen.absolute[2 * i] = seen.absolute[2 * i + 1] = 0;
    for (int k = 0; seen.motion && k < kMotion; ++k) seen.motion[kMotion * i + k] = 0;
  }
  if (i < count) take_row(take, i, g);
  for (int k = drawn ? rest_count : 0; k < kRest; ++k) own[k] = 0;
  __syncthreads();
  each_of_rest(begin, count, [&](int k) { take.one(kShN, begin * kRest + k, begin + k / kRest, rest[k]); });
}

// Gradients as an op returns them.
struct Written {
  float* to[kParameters];

  __device__ __forceinline__ void one(int parameter, int64_t at, int64_t, float g) const { to[parameter][at] = g; }
  __device__ __forceinline__ void note(const Row&, const float*, int, const float*) const {}
};

// A step of the optimiser.
struct Stepped {
  const Step& step;
  int32_t* broken;

  __device__ __forceinline__ void one(int parameter, int64_t at, int64_t row, float g) const {
    step.move(parameter, at, row, g);
  }
  __device__ __forceinline__ void note(const Row& g, const float* rest, int rest_count, const float* screen) const {
    const int32_t found = broken_of(g, rest, rest_count, screen);
    if (found) atomicOr(broken, found);
  }
};

// Values change while those of other Gaussians are read: a row is of one thread, the coefficients of one block.
template <class Sums>
__device__ __forceinline__ void take_step(const Step& step, const Camera& camera, int64_t sh_count, int64_t count,
                                          const Splat* splats, const int32_t* tile_counts, const Sums* sums,
                                          const Seen& seen, float* rest, const int32_t* status, int32_t* broken) {
  if (*status) return;
  const Moving* of = step.of;
  const Model model = {of[kMean].values, of[kQuat].values, of[kScale].values, of[kOpacity].values, of[kSh0].values};
  take_gradients(model, of[kShN].values, camera, sh_count, count, splats, tile_counts, sums, seen, rest,
                 Stepped{step, broken});
}

}  // namespace
}  // namespace panolog

// splats (N), state (N), depth (N): distance, or kNowhere; tile_counts (N): how many tiles it meets.
extern "C" __global__ void __launch_bounds__(128)
    project_forward(const float* means, const float* quats, const float* scales, const float* opacities,
                    const float* sh0, const float* shN, const float* screen, panolog::Camera camera, int64_t sh_count,
                    int64_t count, panolog::Splat* splats, uint8_t* state, float* depth, int32_t* tile_counts) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  const int64_t begin = int64_t(blockIdx.x) * kSpan, i = begin + threadIdx.x;
  if (sh_count > 1) load_rest(shN, rest, begin, count);
  __syncthreads();
  if (i >= count) return;
  const Model model = {means, quats, scales, opacities, sh0};
  Splat s = {};
  const Visibility<float> seen =
      project(parameters(model, i, rest + kRest * threadIdx.x), camera, int(sh_count), screen + 2 * i, s);
  write_splat(s, seen, camera, [&] { return tiles_met(s, camera); }, i, {splats, state, depth, tile_counts});
}

// The same with exact projection; rays (N). azimuths, elevations: of every half pixel of the tiles.
extern "C" __global__ void __launch_bounds__(128)
    project_ray_forward(const float* means, const float* quats, const float* scales, const float* opacities,
                        const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count, int64_t count,
                        const panolog::Angle* azimuths, const panolog::Angle* elevations, panolog::Splat* splats,
                        panolog::RaySplat* rays, uint8_t* state, float* depth, int32_t* tile_counts) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  const int64_t begin = int64_t(blockIdx.x) * kSpan, i = begin + threadIdx.x;
  if (sh_count > 1) load_rest(shN, rest, begin, count);
  __syncthreads();
  if (i >= count) return;
  const Model model = {means, quats, scales, opacities, sh0};
  Splat s = {};
  RaySplat ray;
  const Visibility<float> seen =
      project_ray(parameters(model, i, rest + kRest * threadIdx.x), camera, int(sh_count), s, ray);
  rays[i] = ray;
  write_splat(s, seen, camera, [&] { return tiles_met(s, ray, camera, azimuths, elevations); }, i,
              {splats, state, depth, tile_counts});
}

// The splats of an exterior, `around` (count), take the rows from `own` on in what project_forward writes.
extern "C" __global__ void __launch_bounds__(128)
    project_exterior(const panolog::Splat* around, panolog::Camera camera, int64_t count, int64_t own,
                     panolog::Splat* splats, float* depth, int32_t* tile_counts) {
  using namespace panolog;
  const int64_t i = thread_of_grid();
  if (i >= count) return;
  const Splat s = around[i];
  splats[own + i] = s;
  depth[own + i] = s.distance;
  tile_counts[own + i] = tiles_met(s, camera);
}

// The same with exact projection.
extern "C" __global__ void __launch_bounds__(128)
    project_ray_exterior(const panolog::Splat* around, const panolog::RaySplat* around_rays, panolog::Camera camera,
                         int64_t count, int64_t own, const panolog::Angle* azimuths, const panolog::Angle* elevations,
                         panolog::Splat* splats, panolog::RaySplat* rays, float* depth, int32_t* tile_counts) {
  using namespace panolog;
  const int64_t i = thread_of_grid();
  if (i >= count) return;
  const Splat s = around[i];
  const RaySplat ray = around_rays[i];
  splats[own + i] = s, rays[own + i] = ray;
  depth[own + i] = s.distance;
  tile_counts[own + i] = tiles_met(s, ray, camera, azimuths, elevations);
}

// sums (N): gradients from the pixels. Writes every row of the gradients, zeros for splats without tiles.
// out_motion (N, 6), may be null: parts in the gradient of the camera's pose.
extern "C" __global__ void __launch_bounds__(128)
    project_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                     const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count, int64_t count,
                     const panolog::Splat* splats, const int32_t* tile_counts, const panolog::SplatGradient* sums,
                     float* out_means, float* out_quats, float* out_scales, float* out_opacities, float* out_sh0,
                     float* out_shN, float* out_screen, float* out_motion) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  take_gradients({means, quats, scales, opacities, sh0}, shN, camera, sh_count, count, splats, tile_counts, sums,
                 {out_screen, nullptr, out_motion}, rest,
                 Written{{out_means, out_quats, out_scales, out_opacities, out_sh0, out_shN}});
}

// The same with absolute gradients, out_absolute (N, 2).
extern "C" __global__ void __launch_bounds__(128)
    project_absolute_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                              const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count,
                              int64_t count, const panolog::Splat* splats, const int32_t* tile_counts,
                              const panolog::AbsoluteGradient* sums, float* out_means, float* out_quats,
                              float* out_scales, float* out_opacities, float* out_sh0, float* out_shN,
                              float* out_screen, float* out_absolute, float* out_motion) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  take_gradients({means, quats, scales, opacities, sh0}, shN, camera, sh_count, count, splats, tile_counts, sums,
                 {out_screen, out_absolute, out_motion}, rest,
                 Written{{out_means, out_quats, out_scales, out_opacities, out_sh0, out_shN}});
}

extern "C" __global__ void __launch_bounds__(128)
    project_ray_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                         const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count, int64_t count,
                         const panolog::Splat* splats, const int32_t* tile_counts, const panolog::RayGradient* sums,
                         float* out_means, float* out_quats, float* out_scales, float* out_opacities, float* out_sh0,
                         float* out_shN, float* out_screen, float* out_motion) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  take_gradients({means, quats, scales, opacities, sh0}, shN, camera, sh_count, count, splats, tile_counts, sums,
                 {out_screen, nullptr, out_motion}, rest,
                 Written{{out_means, out_quats, out_scales, out_opacities, out_sh0, out_shN}});
}

// The gradients of the parameters are a step of Adam at once: they never are in memory. No step unless status (1) is 0;
// broken (1) receives kBrokenGradient of each parameter that has a gradient which is not finite.
extern "C" __global__ void __launch_bounds__(128)
    project_step(panolog::Step step, panolog::Camera camera, int64_t sh_count, int64_t count,
                 const panolog::Splat* splats, const int32_t* tile_counts, const panolog::SplatGradient* sums,
                 float* out_screen, float* out_motion, const int32_t* status, int32_t* broken) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  take_step(step, camera, sh_count, count, splats, tile_counts, sums, {out_screen, nullptr, out_motion}, rest, status,
            broken);
}

extern "C" __global__ void __launch_bounds__(128)
    project_absolute_step(panolog::Step step, panolog::Camera camera, int64_t sh_count, int64_t count,
                          const panolog::Splat* splats, const int32_t* tile_counts,
                          const panolog::AbsoluteGradient* sums, float* out_screen, float* out_absolute,
                          float* out_motion, const int32_t* status, int32_t* broken) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  take_step(step, camera, sh_count, count, splats, tile_counts, sums, {out_screen, out_absolute, out_motion}, rest,
            status, broken);
}

extern "C" __global__ void __launch_bounds__(128)
    project_ray_step(panolog::Step step, panolog::Camera camera, int64_t sh_count, int64_t count,
                     const panolog::Splat* splats, const int32_t* tile_counts, const panolog::RayGradient* sums,
                     float* out_screen, float* out_motion, const int32_t* status, int32_t* broken) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  take_step(step, camera, sh_count, count, splats, tile_counts, sums, {out_screen, nullptr, out_motion}, rest, status,
            broken);
}

// Sums of motion (N, 6) over the Gaussians of each block, sums (blocks, kMotionSums): of the values, and of their
// products i ≤ j. A thread has one of them for a part of the rows, so that the order is fixed.
extern "C" __global__ void __launch_bounds__(128) project_motion(const float* motion, int64_t count, double* sums) {
  using namespace panolog;
  __shared__ float rows[kSpan * kMotion];
  __shared__ double parts[kMotionParts][kMotionSums];
  const int k = int(threadIdx.x) % kMotionSums, part = int(threadIdx.x) / kMotionSums;
  int i = k < kMotion ? k : 0, j = k - kMotion;
  for (; k >= kMotion && j >= kMotion - i; ++i) j -= kMotion - i;
  j += i;
  double total = 0;
  const int64_t begin = int64_t(blockIdx.x) * kMotionSpan,
                end = begin + kMotionSpan < count ? begin + kMotionSpan : count;
  for (int64_t at = begin; at < end; at += kSpan) {
    const int here = int(end - at < kSpan ? end - at : kSpan);
    for (int n = int(threadIdx.x); n < here * kMotion; n += kSpan) rows[n] = motion[at * kMotion + n];
    __syncthreads();
    if (part < kMotionParts)
      for (int row = part; row < here; row += kMotionParts)
        total += double(rows[row * kMotion + i]) * (k < kMotion ? 1 : rows[row * kMotion + j]);
    __syncthreads();
  }
  if (part < kMotionParts) parts[part][k] = total;
  __syncthreads();
  if (threadIdx.x >= kMotionSums) return;
  total = 0;
  for (int other = 0; other < kMotionParts; ++other) total += parts[other][threadIdx.x];
  sums[int64_t(blockIdx.x) * kMotionSums + threadIdx.x] = total;
}
