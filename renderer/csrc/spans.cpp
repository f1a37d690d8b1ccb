// Loops over ranges of Gaussians and rows of samples. Compiled once for each instruction set.
#include "kernels.h"

#define PANOLOG_TEXT_(x) #x
#define PANOLOG_TEXT(x) PANOLOG_TEXT_(x)

namespace panolog::PANOLOG_ISA {

void tile_forward(const TileInput&, const Images&);
void tile_backward(const TileInput&, const Images&, const ImageGradients&, SplatGradient*);

namespace {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // Wang et al. 2004, for samples in [0, 1]

Parameters parameters(const GaussianArrays& g, int64_t i) {
  return {g.means + 3 * i, g.quats + 4 * i, g.scales + 3 * i, g.opacities[i], g.sh0 + 3 * i, g.shN + 45 * i};
}

void project_span(const GaussianArrays& g, const Camera& camera, int sh_count, int64_t begin, int64_t end,
                  Splat* splats, uint8_t* state) {
  for (int64_t i = begin; i < end; ++i) {
    Splat& s = splats[i];
    state[i] = project(parameters(g, i), camera, sh_count, g.screen + 2 * i, s);
    if (state[i] != kVisible) continue;
    s.cut += 1e-3f;  // bounds may be generous, pixels decide
    if (sqrtf(s.cut * s.var_u) > 0.5f * camera.width - 2 * kTile) s.flags |= kWide;
    const float reach = sqrtf(s.cut * s.var_v);
    if (s.v + reach < 0.5f || s.v - reach > camera.height - 0.5f) state[i] = kHidden;
  }
}

void project_backward_span(const GaussianArrays& g, const Camera& camera, int sh_count, int64_t begin, int64_t end,
                           const Splat* splats, const uint32_t* ids, const uint32_t* slots,
                           const SplatGradient* parts, const GradientArrays& out) {
  for (int64_t i = begin; i < end; ++i) {
    SplatGradient total = {};
    for (uint32_t slot = slots[i]; slot < slots[i + 1]; ++slot) {
      const SplatGradient& part = parts[slot];
      total.power += part.power, total.x += part.x, total.y += part.y;
      total.xx += part.xx, total.xy += part.xy, total.yy += part.yy;
      for (int ch = 0; ch < 3; ++ch) total.color[ch] += part.color[ch];
      total.inverse_depth += part.inverse_depth;
    }
    const int64_t row = ids[i];
    const ParameterGradients to = {out.means + 3 * row, out.quats + 4 * row, out.scales + 3 * row,
                                   out.opacities + row, out.sh0 + 3 * row,   out.shN + 45 * row,
                                   out.screen + 2 * row};
    project_backward(parameters(g, row), camera, sh_count, splats[i], total, to);
  }
}

void blur_row(const float* row, int width, const float* window, float* padded, float* out) {
  const int edge = 3 * kWindowRadius, count = 3 * width;
  for (int i = 0; i < edge; ++i) {  // a panorama narrower than the window wraps more than once
    padded[i] = row[3 * (((i / 3 - kWindowRadius) % width + width) % width) + i % 3];
    padded[edge + count + i] = row[3 * ((i / 3) % width) + i % 3];
  }
  for (int i = 0; i < count; ++i) padded[edge + i] = row[i];
  for (int i = 0; i < count; ++i) {
    float sum = 0;
    for (int k = 0; k <= 2 * kWindowRadius; ++k) sum += window[k] * padded[i + 3 * k];
    out[i] = sum;
  }
}

void blur_columns(const float* image, int row, int stride, int height, const float* window, float* __restrict out) {
  for (int i = 0; i < stride; ++i) out[i] = 0;
  for (int k = -kWindowRadius; k <= kWindowRadius; ++k) {
    if (row + k < 0 || row + k >= height) continue;
    const float w = window[k + kWindowRadius], *in = image + int64_t(row + k) * stride;
    for (int i = 0; i < stride; ++i) out[i] += w * in[i];
  }
}

void ssim_row(const RowMoments& m, int count, float* __restrict value, float* __restrict by_x,
              float* __restrict by_xx, float* __restrict by_xy) {
  const float *px = m.maps[0], *py = m.maps[1], *pxx = m.maps[2], *pyy = m.maps[3], *pxy = m.maps[4];
  for (int i = 0; i < count; ++i) {
    const float mx = px[i], my = py[i];
    const float a = 2 * mx * my + kC1, b = 2 * (pxy[i] - mx * my) + kC2;
    const float c = mx * mx + my * my + kC1, d = (pxx[i] - mx * mx) + (pyy[i] - my * my) + kC2;
    const float inverse = 1 / (c * d), ssim = a * b * inverse;
    value[i] = ssim;
    by_x[i] = 2 * my * (b - a) * inverse - 2 * mx * ssim * (1 / c - 1 / d);
    by_xx[i] = -ssim / d;
    by_xy[i] = 2 * a * inverse;
  }
}

void adam(const AdamStep& s, int64_t begin, int64_t end, const float* __restrict gradient,
          float* __restrict parameter, float* __restrict mean, float* __restrict square) {
  const float rate = s.lr / s.correction1, root = 1 / sqrtf(s.correction2);
  for (int64_t i = begin; i < end; ++i) {
    const float g = gradient[i];
    mean[i] = s.beta1 * mean[i] + (1 - s.beta1) * g;
    square[i] = s.beta2 * square[i] + (1 - s.beta2) * g * g;
    parameter[i] -= rate * mean[i] / (sqrtf(square[i]) * root + s.eps);
  }
}

}  // namespace

extern const Kernels kKernels = {PANOLOG_TEXT(PANOLOG_ISA), project_span, project_backward_span, tile_forward,
                                 tile_backward, blur_row, blur_columns, ssim_row, adam};

}  // namespace panolog::PANOLOG_ISA
