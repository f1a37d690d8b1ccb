// One step of Adam (Kingma and Ba 2015, algorithm 1), in place, value by value.
#pragma once
#include "common.cuh"

namespace panolog {

enum Parameter { kMean, kQuat, kScale, kOpacity, kSh0, kShN, kParameters };  // in the order of scene/gaussians.py

// One parameter: its first `count` values move.
struct Moving {
  float *values, *exp_avg, *exp_avg_sq;
  const float* units;  // of the rate, for each row; null: all 1
  int64_t count;
  float rate;  // lr / (1 - beta1ᵗ)
};

struct Step {
  Moving of[kParameters];
  float root;  // 1 / √(1 - beta2ᵗ)
  float beta1, beta2, eps;

  // Of the value at a place, in a row of its parameter, by its gradient g. Moments of a gradient that is 0 decay, and
  // what they still are moves the value.
  __device__ __forceinline__ void move(int parameter, int64_t at, int64_t row, float g) const {
    const Moving& p = of[parameter];
    if (at >= p.count) return;
    const float m = beta1 * p.exp_avg[at] + (1 - beta1) * g, s = beta2 * p.exp_avg_sq[at] + (1 - beta2) * g * g;
    p.exp_avg[at] = m, p.exp_avg_sq[at] = s;
    p.values[at] -= (p.units ? p.units[row] : 1.0f) * p.rate * m / (sqrtf(s) * root + eps);
  }
};

}  // namespace panolog
