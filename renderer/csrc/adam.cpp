#include "adam.h"

#include <algorithm>

namespace panolog {

bool move_rows(const Moving& moving, const float* gradient, int64_t row, int64_t rows) {
  const int64_t at = row * moving.stride, count = std::min(rows * moving.stride, moving.count - at);
  if (count <= 0) return true;
  AdamStep step = moving.step;
  if (step.units) step.units += row;
  return kernels().adam(step, count, gradient, moving.values + at, moving.exp_avg + at, moving.exp_avg_sq + at);
}

}  // namespace panolog
