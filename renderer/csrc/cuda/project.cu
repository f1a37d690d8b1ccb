// Forward and backward projection of N Gaussians, one thread for each: affine (eq. 2, appendix B), and exact (rays.h).
// Of a Gaussian's 59 floats 45 lie in one row; they pass through shared memory, so that a warp moves whole lines.
// Compiled without contraction into fused multiply-adds: bin.cu must find the same tiles to the bit.
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

// Copies the rows of this block's Gaussians between device and shared memory, all threads together.
__device__ __forceinline__ void copy_rest(const float* from, float* to, int64_t begin, int64_t count) {
  const int64_t floats = (count - begin < kSpan ? count - begin : kSpan) * kRest;
  for (int64_t i = threadIdx.x; i < floats; i += kSpan) to[i] = from[i];
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

// `rest`: shared memory for shN, replaced by its gradient. Where no splat is drawn the gradients are 0.
template <class Sums>
__device__ __forceinline__ void write_gradients(const Model& model, const float* shN, const Camera& camera,
                                                int64_t sh_count, int64_t count, const Splat* splats,
                                                const int32_t* tile_counts, const Sums* sums,
                                                const ParameterGradients<float>& all, float* rest, int32_t* status) {
  const int64_t begin = int64_t(blockIdx.x) * kSpan, i = begin + threadIdx.x;
  float* const own = rest + kRest * threadIdx.x;
  if (sh_count > 1) copy_rest(shN + begin * kRest, rest, begin, count);
  __syncthreads();
  const bool drawn = i < count && tile_counts[i] > 0;
  if (drawn) {
    const ParameterGradients<float> out = {all.mean + 3 * i,
                                           all.quat + 4 * i,
                                           all.scale + 3 * i,
                                           all.opacity + i,
                                           all.sh0 + 3 * i,
                                           own,
                                           all.screen + 2 * i,
                                           all.absolute ? all.absolute + 2 * i : nullptr,
                                           all.motion ? all.motion + kMotion * i : nullptr};
    project_backward(parameters(model, i, own), camera, int(sh_count), splats[i], sums[i], out);
    const bool sound = finite(out.mean, 3) && finite(out.quat, 4) && finite(out.scale, 3) && finite(out.opacity, 1) &&
                       finite(out.sh0, 3) && finite(own, 3 * (int(sh_count) - 1)) && finite(out.screen, 2);
    if (status && !sound) atomicOr(status, kBrokenGradient);
  } else if (i < count) {
    for (int k = 0; k < 3; ++k) all.mean[3 * i + k] = all.scale[3 * i + k] = all.sh0[3 * i + k] = 0;
    for (int k = 0; k < 4; ++k) all.quat[4 * i + k] = 0;
    all.opacity[i] = all.screen[2 * i] = all.screen[2 * i + 1] = 0;
    if (all.absolute) all.absolute[2 * i] = all.absolute[2 * i + 1] = 0;
    for (int k = 0; all.motion && k < kMotion; ++k) all.motion[kMotion * i + k] = 0;
  }
  for (int k = drawn ? 3 * (int(sh_count) - 1) : 0; k < kRest; ++k) own[k] = 0;
  __syncthreads();
  copy_rest(rest, all.shN + begin * kRest, begin, count);
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
  if (sh_count > 1) copy_rest(shN + begin * kRest, rest, begin, count);
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
  if (sh_count > 1) copy_rest(shN + begin * kRest, rest, begin, count);
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
// status (1), may be null: receives kBrokenGradient if one is not finite.
extern "C" __global__ void __launch_bounds__(128)
    project_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                     const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count, int64_t count,
                     const panolog::Splat* splats, const int32_t* tile_counts, const panolog::SplatGradient* sums,
                     float* out_means, float* out_quats, float* out_scales, float* out_opacities, float* out_sh0,
                     float* out_shN, float* out_screen, float* out_motion, int32_t* status) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  const ParameterGradients<float> out = {out_means, out_quats,  out_scales, out_opacities, out_sh0,
                                         out_shN,   out_screen, nullptr,    out_motion};
  write_gradients({means, quats, scales, opacities, sh0}, shN, camera, sh_count, count, splats, tile_counts, sums, out,
                  rest, status);
}

// The same with absolute gradients, out_absolute (N, 2).
extern "C" __global__ void __launch_bounds__(128)
    project_absolute_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                              const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count,
                              int64_t count, const panolog::Splat* splats, const int32_t* tile_counts,
                              const panolog::AbsoluteGradient* sums, float* out_means, float* out_quats,
                              float* out_scales, float* out_opacities, float* out_sh0, float* out_shN,
                              float* out_screen, float* out_absolute, float* out_motion, int32_t* status) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  const ParameterGradients<float> out = {out_means, out_quats,  out_scales,   out_opacities, out_sh0,
                                         out_shN,   out_screen, out_absolute, out_motion};
  write_gradients({means, quats, scales, opacities, sh0}, shN, camera, sh_count, count, splats, tile_counts, sums, out,
                  rest, status);
}

extern "C" __global__ void __launch_bounds__(128)
    project_ray_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                         const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count, int64_t count,
                         const panolog::Splat* splats, const int32_t* tile_counts, const panolog::RayGradient* sums,
                         float* out_means, float* out_quats, float* out_scales, float* out_opacities, float* out_sh0,
                         float* out_shN, float* out_screen, float* out_motion, int32_t* status) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];
  const ParameterGradients<float> out = {out_means, out_quats,  out_scales, out_opacities, out_sh0,
                                         out_shN,   out_screen, nullptr,    out_motion};
  write_gradients({means, quats, scales, opacities, sh0}, shN, camera, sh_count, count, splats, tile_counts, sums, out,
                  rest, status);
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
