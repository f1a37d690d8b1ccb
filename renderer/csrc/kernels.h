// The hot loops, compiled once for each instruction set and chosen at run time.
// Those translation units use no library templates: the linker would merge their instances across instruction sets.
#pragma once
#include <stdint.h>

#include "formulas.h"

namespace panolog {

constexpr int kTile = 16;  // pixels; a tile is 4 × 4 blocks of 4 × 4 pixels, a block being one vector
constexpr int kTilePixels = kTile * kTile;
constexpr int kWindowRadius = 5;  // of SSIM

struct GaussianArrays {  // N Gaussians, row-major
  const float *means, *quats, *scales, *opacities, *sh0, *shN, *screen;
  int64_t count;
};

struct GradientArrays {  // the same shapes
  float *means, *quats, *scales, *opacities, *sh0, *shN, *screen;
};

struct Entry {  // one splat in one tile
  uint32_t splat;
  uint32_t slot;  // where its gradient of this tile goes
};

struct TileInput {
  const Splat* splats;
  const Entry *begin, *end;  // nearest first
  int x0, y0, width, height;
};

struct Images {  // of the whole panorama: (H, W, 3), (H, W), (H, W)
  float *color, *alpha, *inverse_depth;
};

struct ImageGradients {
  const float *color, *alpha, *inverse_depth;
};

struct AdamStep {
  float lr, beta1, beta2, eps, correction1, correction2;  // corrections: 1 - betaᵗ
};

// Window means of one row of samples: of x, y, x², y² and xy.
struct RowMoments {
  float* maps[5];
};

struct Kernels {
  const char* name;
  // Gaussians [begin, end): splats and states (eq. 2, appendix B)
  void (*project)(const GaussianArrays&, const Camera&, int sh_count, int64_t begin, int64_t end, Splat*, uint8_t* state);
  // splats [begin, end) nearest first; ids: their Gaussians; slots: where the parts of a splat's gradient lie
  void (*project_backward)(const GaussianArrays&, const Camera&, int sh_count, int64_t begin, int64_t end,
                           const Splat*, const uint32_t* ids, const uint32_t* slots, const SplatGradient* parts,
                           const GradientArrays&);
  void (*tile_forward)(const TileInput&, const Images&);
  void (*tile_backward)(const TileInput&, const Images&, const ImageGradients&, SplatGradient* slots);
  // horizontal window over a row of W RGB pixels, periodic; padded has room for W + 2·radius pixels
  void (*blur_row)(const float* row, int width, const float* window, float* padded, float* out);
  // vertical window over `height` rows of `stride` samples, zero beyond them; writes one row
  void (*blur_columns)(const float* image, int row, int stride, int height, const float* window, float* out);
  // SSIM of a row and its derivatives by the means of x, x² and xy
  void (*ssim_row)(const RowMoments&, int count, float* value, float* by_x, float* by_xx, float* by_xy);
  void (*adam)(const AdamStep&, int64_t begin, int64_t end, const float* gradient, float* parameter, float* mean,
               float* square);
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

const Kernels& kernels();  // the best for this processor

}  // namespace panolog
