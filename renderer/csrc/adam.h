// One step of Adam on arrays that are in memory, and on gradients that are there for some rows at a time.
#pragma once
#include "kernels.h"

namespace panolog {

// A parameter with its moments, row by row. Its first `count` values move.
struct Moving {
  float *values, *exp_avg, *exp_avg_sq;
  int64_t count;
  int64_t stride;  // values of a row
  AdamStep step;
};

// Moves the rows from `row` on whose gradient is given, `rows` of them, as far as they move. False if a value of it is
// not finite: then they are invalid.
bool move_rows(const Moving& moving, const float* gradient, int64_t row, int64_t rows);

}  // namespace panolog
