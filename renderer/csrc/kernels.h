// The hot loops, compiled once for each instruction set and chosen at run time.
// Those translation units use no library templates: the linker would merge their instances across instruction sets.
#pragma once
#include <stdint.h>

#include "rays.h"

namespace panolog {

constexpr int kTilePixels = kTile * kTile;
constexpr int kWindowRadius = 5;  // of SSIM

struct GaussianArrays {  // N Gaussians, row-major
  const float *means, *quats, *scales, *opacities, *sh0, *shN, *screen;
  int64_t count;
  GaussianArrays from(int64_t row) const {
    return {means + 3 * row, quats + 4 * row, scales + 3 * row, opacities + row,
            sh0 + 3 * row,   shN + 45 * row,  screen + 2 * row, count - row};
  }
};

struct GradientArrays {  // the same shapes
  float *means, *quats, *scales, *opacities, *sh0, *shN, *screen;
  float* absolute;                          // null, or as `screen`: of ParameterGradients
  double* motion;                           // null, or kMotionSums: to which is added
  bool streaming = false;                   // whether they are written past the caches
  GradientArrays from(int64_t row) const {  // those that are there
    const auto at = [row](float* array, int64_t stride) { return array ? array + stride * row : nullptr; };
    return {at(means, 3), at(quats, 4),  at(scales, 3),   at(opacities, 1), at(sh0, 3),
            at(shN, 45),  at(screen, 2), at(absolute, 2), motion,           streaming};
  }
};

constexpr int kTileRoom = 4;
constexpr uint32_t kNoSlot = UINT32_MAX;

struct Entry {  // one splat in one tile
  uint32_t splat;
  uint32_t slot;  // where its gradient of this tile goes; kNoSlot: nowhere, it is frozen
  uint32_t met;   // the tile's blocks of 4 × 4 pixels in which it composites: written by the forward pass, read by the
                  // backward pass
};

struct Grid {  // sines and cosines of the azimuths of columns and of the elevations of rows
  const float *sin_u, *cos_u, *sin_v, *cos_v;
};

struct TileInput {
  const Splat* splats;
  const RaySplat* rays;  // null: affine projection
  Grid pixels, blocks;   // of 4 × 4 pixels; with rays
  Entry *begin, *end;    // nearest first
  // What lies before and behind all entries, null: nothing. Planes of the tile's pixels, row by row: transmittance,
  // r g b, inverse depth.
  const float *front, *back;
  int x0, y0, width, height;
};
constexpr int kPlanes = 5;

struct Images {  // of the whole panorama: (H, W, 3), (H, W), (H, W)
  float *color, *alpha, *inverse_depth;
};

struct ImageGradients {
  const float *color, *alpha, *inverse_depth;
};

struct AdamStep {
  float lr, beta1, beta2, eps, correction1, correction2;  // corrections: 1 - betaᵗ
  const float* units;                                     // of lr, for each row; null: all 1
  int64_t values;                                         // of a row
};

// Sums over the samples of a row, in parallel by their place so that the order is fixed; those after the last sixteen
// apart.
struct RowSums {
  static constexpr int kParts = 16;
  float l1[kParts] = {}, squared[kParts] = {}, ssim[kParts] = {};
  float rest_l1 = 0, rest_squared = 0, rest_ssim = 0;
};

// Sums over the samples of a row for the exposure of its view, by their place in groups of sixteen pixels. With
// s = colour + kToe, r the error and w = min(1, kHuber / |r|), 0 where a sample is masked or saturated: w, w·s, w·s²,
// w·r and w·s·r.
struct ExposureSums {
  static constexpr int kSums = 5, kParts = 48;
  float parts[kSums][kParts] = {};
};

struct Kernels {
  const char* name;
  // Gaussians [begin, end): splats and states (eq. 2, appendix B)
  void (*project)(const GaussianArrays&, const Camera&, int sh_count, int64_t begin, int64_t end, Splat*,
                  uint8_t* state);
  // The first `count` Gaussians: their gradients, sums of what the tiles wrote to their slots; 0 without slots
  void (*project_backward)(const GaussianArrays&, const Camera&, int sh_count, int64_t count, const Splat*,
                           const uint32_t* slots, const SplatGradient* parts, const GradientArrays&);
  void (*project_absolute_backward)(const GaussianArrays&, const Camera&, int sh_count, int64_t count, const Splat*,
                                    const uint32_t* slots, const AbsoluteGradient* parts, const GradientArrays&);
  // The same with exact projection
  void (*project_rays)(const GaussianArrays&, const Camera&, int sh_count, int64_t begin, int64_t end, Splat*,
                       RaySplat*, uint8_t* state);
  void (*project_rays_backward)(const GaussianArrays&, const Camera&, int sh_count, int64_t count, const Splat*,
                                const uint32_t* slots, const RayGradient* parts, const GradientArrays&);
  // Of up to sixteen splats in turn the tiles with a pixel centre inside the footprint, exact for elongated ones,
  // periodic in u; those without state, if that is given, have none. Returns how many in all, and in `many` of each.
  // `tiles` has room for all tiles of the image sixteen times and kTileRoom more.
  uint32_t (*tiles_of)(const Splat*, const uint8_t* state, int count, const Camera&, uint32_t* tiles, uint32_t* many);
  void (*tile_forward)(const TileInput&, const Images&);
  void (*tile_backward)(const TileInput&, const Images&, const ImageGradients&, SplatGradient* slots);
  void (*tile_absolute_backward)(const TileInput&, const Images&, const ImageGradients&, AbsoluteGradient* slots);
  // The same with the tiles that the footprints may meet; the grid of tiles.
  uint32_t (*ray_tiles_of)(const Splat*, const RaySplat*, const uint8_t* state, int count, const Camera&, const Grid&,
                           uint32_t* tiles, uint32_t* many);
  void (*ray_tile_forward)(const TileInput&, const Images&);
  void (*ray_tile_backward)(const TileInput&, const Images&, const ImageGradients&, RayGradient* slots);
  // Of a row's samples, three to a pixel, `count` in turn: x of the rendering and y of the target, both 0 where
  // `counts`, if any, is 0. Parts of a row that begin at multiples of sixteen have its sums.
  void (*samples_row)(const float* color, const uint8_t* target, const uint8_t* counts, int count, float* x, float* y,
                      RowSums& sums);
  // Of a row's samples, of whole pixels: `exposed`, what `affine` (2, 3) makes of their colour, and `slope`, its
  // derivative; where the target is saturated or black and `exposed` beyond it, it is the target and the slope 0.
  void (*exposed_row)(const float* color, const uint8_t* target, const uint8_t* counts, int count, const float* affine,
                      float* exposed, float* slope, ExposureSums& sums);
  // Horizontal window at pixels begin .. end of a row of W RGB pixels, periodic; padded has room for W + 2·radius
  // pixels
  void (*blur_row)(const float* row, int width, int begin, int end, const float* window, float* padded, float* out);
  // Σ weights[k] · rows[k], each of `count` samples: the vertical window
  void (*weighted_sum)(const float* const* rows, const float* weights, int taps, int count, float* out);
  // At `count` samples from `begin` on: SSIM from the window means of x, y, x², y², xy; its derivatives by those of x,
  // x², xy, times `weight`. All of them are 0 where `counts` is. `value` has room for `count`.
  void (*ssim_row)(const float* const means[5], const uint8_t* counts, int begin, int count, float weight, float* value,
                   float* const by[3], RowSums& sums);
  // The loss's gradient from those derivatives, spread over their windows, and the L1 part.
  void (*gradient_row)(const float* const by[3], const float* x, const float* y, const uint8_t* counts, int count,
                       float l1_weight, float* out);
  // The first `count` values, in place. Whether all of their gradient is finite; else they are invalid.
  bool (*adam)(const AdamStep&, int64_t count, const float* gradient, float* parameter, float* exp_avg,
               float* exp_avg_sq);
};

namespace portable {
extern const Kernels kKernels;
}
namespace avx2 {
extern const Kernels kKernels;
}
namespace avx512 {
extern const Kernels kKernels;
}

const Kernels& kernels();               // the best for this processor, unless another was chosen
bool choose_kernels(const char* name);  // false where this processor cannot run them

}  // namespace panolog
