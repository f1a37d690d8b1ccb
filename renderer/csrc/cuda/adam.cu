// One step of Adam (Kingma and Ba 2015, algorithm 1), in place. One thread for each value.
#include "common.cuh"

// rate: lr / (1 - beta1ᵗ); root: 1 / √(1 - beta2ᵗ).
extern "C" __global__ void __launch_bounds__(256)
    adam_step(int64_t count, float rate, float root, float beta1, float beta2, float eps, const float* gradient,
              float* parameter, float* exp_avg, float* exp_avg_sq) {
  const int64_t i = panolog::thread_of_grid();
  if (i >= count) return;
  const float g = gradient[i];
  const float m = beta1 * exp_avg[i] + (1 - beta1) * g, s = beta2 * exp_avg_sq[i] + (1 - beta2) * g * g;
  exp_avg[i] = m, exp_avg_sq[i] = s;
  parameter[i] -= rate * m / (sqrtf(s) * root + eps);
}
