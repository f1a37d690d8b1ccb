// Counts the work of an image, for benchmarks: slow, and independent of the kernels.
#pragma once
#include <cstdint>

#include "rasterize.h"

namespace panolog {

struct Pairs {
  int64_t evaluated;  // pixels and splats that the forward pass computed
  int64_t useful;     // those of them with alpha ≥ 1/255 before the pixel is opaque
};

// Of a frame after its forward pass.
Pairs count_pairs(const FrameView& frame, int width, int height);

}  // namespace panolog
