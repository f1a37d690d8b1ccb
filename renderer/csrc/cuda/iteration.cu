// Around the step of a training iteration: whether it may be taken, what the host reads later, and the statistics of
// densification.
#include "common.cuh"

namespace panolog {
namespace {

__device__ __forceinline__ bool is_finite(double value) { return 0 * value == 0; }

}  // namespace
}  // namespace panolog

// One thread. Adds to status (1) why no step may be taken, and writes of report (4): loss, mean squared error, pairs of
// splats and tiles.
//
// sums (3): of |x - y|, SSIM and (x - y)² over `samples` ()
// depth_sum (), depth_samples (): of the depth loss, null without it
// share (), depth_share (): factors of the two losses, null for 1
// pairs (1): how many there are, null for none; room: how many could be listed
extern "C" __global__ void __launch_bounds__(32)
    iteration_guard(const double* sums, const double* samples, const double* share, float lambda_ssim,
                    const double* depth_sum, const double* depth_samples, const double* depth_share, float depth_weight,
                    const int64_t* pairs, int64_t room, int32_t* status, double* report) {
  if (threadIdx.x) return;
  const double l1 = sums[0] / *samples, ssim = sums[1] / *samples, squared = sums[2] / *samples;
  const double depth = depth_sum ? depth_weight * (*depth_sum / *depth_samples) * (depth_share ? *depth_share : 1) : 0;
  const double loss = ((1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim)) * (share ? *share : 1) + depth;
  const int64_t listed = pairs ? *pairs : 0;
  int32_t found = *status;
  if (listed > room) found |= panolog::kNoRoom;
  if (!panolog::is_finite(loss)) found |= panolog::kBrokenLoss;
  *status = found;
  report[0] = loss, report[1] = squared, report[2] = double(listed);
}

// One thread, after the step. Adds to status (1) what `broken` (1) has of it, for which no later step may be taken, and
// writes the last value of report (4).
extern "C" __global__ void __launch_bounds__(32) iteration_end(int32_t* broken, int32_t* status, double* report) {
  if (threadIdx.x) return;
  const int32_t found = *status | *broken;
  *status = found, *broken = 0;
  report[3] = found;
}

// Adds one view to the first `count` rows of the statistics, unless status (1) is not 0. `angle`: lengths in half turns
// on the sphere, not in half images; `contribution`: views weigh as the solid angle of what they see.
// `absolute` gradients (N, 2) and their sums may be null.
extern "C" __global__ void __launch_bounds__(256)
    iteration_statistics(int64_t count, const float* screen, const float* absolute, const uint8_t* state,
                         const float* means, panolog::Camera camera, int64_t angle, int64_t contribution,
                         const int32_t* status, float* gradient, float* views, float* absolute_sum) {
  const int64_t i = panolog::thread_of_grid();
  if (i >= count || *status || state[i] != panolog::kVisible) return;
  float vertical = 0.5f * camera.height, weight = 1;
  if (angle || contribution) {
    float at[3], squared = 0;
    for (int k = 0; k < 3; ++k) {
      at[k] = camera.translation[k];
      for (int j = 0; j < 3; ++j) at[k] += camera.rotation[3 * k + j] * means[3 * i + j];
      squared += at[k] * at[k];
    }
    if (angle) vertical = camera.height * sqrtf(fmaxf(1 - at[1] * at[1] / squared, 0));
    if (contribution) weight = 1 / squared;
  }
  const auto length_of = [&](const float* at) {
    const float du = at[2 * i] * (0.5f * camera.width), dv = at[2 * i + 1] * vertical;
    return sqrtf(du * du + dv * dv);
  };
  const float length = length_of(screen);
  if (contribution && !(length > 0)) return;
  gradient[i] += weight * length;
  if (absolute_sum) absolute_sum[i] += weight * length_of(absolute);
  views[i] += weight;
}
