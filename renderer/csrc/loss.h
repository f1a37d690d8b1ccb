// Photometric and depth losses with their gradients, in a reduction order that no thread count changes.
#pragma once
#include <cstdint>

namespace panolog {

struct LossSums {  // means over the pixels that count
  double l1, ssim, squared;
};

// What a photograph's exposure makes of the rendered colours, and the normal equations for it.
struct Exposure {
  const float* affine;  // (2, 3): factors and summands; null: none, and nothing is summed
  double* normal;       // (3, 5) sums
};

// (1-λ)·L1 + λ·(1-SSIM) over pixels where mask (H, W; null: all) is set; target is uint8, colour is (H, W, 3).
// SSIM: 11 × 11 Gaussian window, σ 1.5, periodic in x, zero beyond the poles, constants of Wang et al. 2004.
// rows (H; null: all 1): weights of the rows in both means. Writes the gradient for the colour. The means of a window
// are over its pixels that count. With an exposure the target is compared with factor · colour + summand; where it is
// saturated, all between 1 and what white becomes are equal, and where it is black all below 0. The sums are those of
// ExposureSums.
LossSums photometric(const float* color, const uint8_t* target, const uint8_t* mask, const float* rows, int width,
                     int height, float lambda_ssim, const Exposure& exposure, int threads, float* gradient);

// SSIM of each pixel, mean over the channels. a, b: (H, W, 3). out: (H, W).
void ssim_map(const float* a, const float* b, int width, int height, int threads, float* out);

// Mean |rendered - target| over valid pixels (0 if none), and its gradient (eq. 5 without its weight).
double absolute_difference(const float* rendered, const float* target, const uint8_t* valid, int64_t pixels,
                           int threads, float* gradient);

}  // namespace panolog
