// Forward and backward projection of N Gaussians (eq. 2, appendix B): one thread for each.
// Of a Gaussian's 59 floats 45 lie in one row; they pass through shared memory, so that a warp moves whole lines.
// Compiled without contraction into fused multiply-adds: bin.cu must find the same tiles to the bit.
#include "common.cuh"

namespace panolog {
namespace {

constexpr int kSpan = 128;           // threads and Gaussians of a block
constexpr int kRest = 45;            // floats of shN
constexpr float kNowhere = 3.4e38f;  // depth of a splat without tiles: sorted last

struct Model {
  const float *means, *quats, *scales, *opacities, *sh0, *screen;
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
  const Model model = {means, quats, scales, opacities, sh0, screen};
  Splat s = {};
  const Visibility<float> seen =
      project(parameters(model, i, rest + kRest * threadIdx.x), camera, int(sh_count), screen + 2 * i, s);
  const bool drawn = seen.visible && !above_or_below(s, camera);
  const int met = drawn ? tiles_met(s, camera) : 0;
  splats[i] = s;
  state[i] = drawn ? kVisible : seen.invalid ? kInvalid : kHidden;
  depth[i] = met ? s.distance : kNowhere;
  tile_counts[i] = met;
}

// sums (N): gradients from the pixels. Writes every row of the gradients, zeros for splats without tiles.
// status (1), may be null: receives kBrokenGradient if one is not finite.
extern "C" __global__ void __launch_bounds__(128)
    project_backward(const float* means, const float* quats, const float* scales, const float* opacities,
                     const float* sh0, const float* shN, panolog::Camera camera, int64_t sh_count, int64_t count,
                     const panolog::Splat* splats, const int32_t* tile_counts, const panolog::SplatGradient* sums,
                     float* out_means, float* out_quats, float* out_scales, float* out_opacities, float* out_sh0,
                     float* out_shN, float* out_screen, int32_t* status) {
  using namespace panolog;
  __shared__ float rest[kSpan * kRest];  // shN, replaced by its gradient
  const int64_t begin = int64_t(blockIdx.x) * kSpan, i = begin + threadIdx.x;
  float* const own = rest + kRest * threadIdx.x;
  if (sh_count > 1) copy_rest(shN + begin * kRest, rest, begin, count);
  __syncthreads();
  const bool drawn = i < count && tile_counts[i] > 0;
  if (drawn) {
    const Model model = {means, quats, scales, opacities, sh0, nullptr};
    const ParameterGradients<float> out = {out_means + 3 * i, out_quats + 4 * i, out_scales + 3 * i,
                                           out_opacities + i, out_sh0 + 3 * i,   own,
                                           out_screen + 2 * i};
    panolog::project_backward(parameters(model, i, own), camera, int(sh_count), splats[i], sums[i], out);
    const bool sound = finite(out.mean, 3) && finite(out.quat, 4) && finite(out.scale, 3) && finite(out.opacity, 1) &&
                       finite(out.sh0, 3) && finite(own, 3 * (int(sh_count) - 1)) && finite(out.screen, 2);
    if (status && !sound) atomicOr(status, kBrokenGradient);
  } else if (i < count) {
    for (int k = 0; k < 3; ++k) out_means[3 * i + k] = out_scales[3 * i + k] = out_sh0[3 * i + k] = 0;
    for (int k = 0; k < 4; ++k) out_quats[4 * i + k] = 0;
    out_opacities[i] = out_screen[2 * i] = out_screen[2 * i + 1] = 0;
  }
  for (int k = drawn ? 3 * (int(sh_count) - 1) : 0; k < kRest; ++k) own[k] = 0;
  __syncthreads();
  copy_rest(rest, out_shN + begin * kRest, begin, count);
}
