// One step of Adam (Kingma and Ba 2015, algorithm 1), in place, for all parameters. One thread for each value.
#include "common.cuh"

namespace panolog {

constexpr int kMostSegments = 6;

// One parameter: its first `count` values move. Its blocks are those from `first` on.
struct Segment {
  const float* gradient;
  float *parameter, *exp_avg, *exp_avg_sq;
  const float* units;  // of the rate, for each row; null: all 1
  int64_t count, first;
  float rate;      // lr / (1 - beta1ᵗ)
  int32_t values;  // of a row
};

struct Segments {
  Segment of[kMostSegments];  // those beyond the last begin after the grid
};

}  // namespace panolog

// root: 1 / √(1 - beta2ᵗ); status (1), may be null: nothing moves unless it is 0.
extern "C" __global__ void __launch_bounds__(256)
    adam_step(panolog::Segments segments, float root, float beta1, float beta2, float eps, const int32_t* status) {
  if (status && *status) return;
  const int64_t block = blockIdx.x;
  panolog::Segment own = segments.of[0];
#pragma unroll
  for (int k = 1; k < panolog::kMostSegments; ++k)
    if (block >= segments.of[k].first) own = segments.of[k];
  const int64_t i = (block - own.first) * blockDim.x + threadIdx.x;
  if (i >= own.count) return;
  const float g = own.gradient[i];
  const float m = beta1 * own.exp_avg[i] + (1 - beta1) * g, s = beta2 * own.exp_avg_sq[i] + (1 - beta2) * g * g;
  own.exp_avg[i] = m, own.exp_avg_sq[i] = s;
  own.parameter[i] -= (own.units ? own.units[i / own.values] : 1.0f) * own.rate * m / (sqrtf(s) * root + eps);
}
