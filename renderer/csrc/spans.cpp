// Loops over ranges of Gaussians and rows of samples. Compiled once for each instruction set.
#include "kernels.h"

#include "simd.h"

#define PANOLOG_TEXT_(x) #x
#define PANOLOG_TEXT(x) PANOLOG_TEXT_(x)

namespace panolog::PANOLOG_ISA {

void tile_forward(const TileInput&, const Images&);
void tile_backward(const TileInput&, const Images&, const ImageGradients&, SplatGradient*);
float ceiling_forward(int64_t, float);
float ceiling_backward(int64_t, float);

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
    if (state[i] == kVisible && above_or_below(s, camera)) state[i] = kHidden;
  }
}

uint32_t tiles_of(const Splat& s, const Camera& camera, uint32_t* tiles) {
  const int across = tiles_across(camera.width);
  const PixelRows rows = pixel_rows(s, camera.height);
  uint32_t count = 0;
  for (int row = rows.first / kTile; row * kTile <= rows.last; ++row) {
    const Run run = tile_run(s, rows, row, camera.width);
    for (int k = 0, column = run.first; k < run.count; ++k, ++column) {
      if (column == across) column = 0;
      tiles[count++] = uint32_t(row * across + column);
    }
  }
  return count;
}

void zero(float* values, int count) {
  for (int i = 0; i < count; ++i) values[i] = 0;
}

void project_backward_span(const GaussianArrays& g, const Camera& camera, int sh_count, int64_t begin, int64_t end,
                           const Splat* splats, const uint32_t* slots, const SplatGradient* parts,
                           const GradientArrays& out) {
  for (int64_t i = begin; i < end; ++i) {
    const ParameterGradients to = {out.means + 3 * i, out.quats + 4 * i, out.scales + 3 * i, out.opacities + i,
                                   out.sh0 + 3 * i,   out.shN + 45 * i,  out.screen + 2 * i};
    const int rest = 3 * (sh_count - 1);  // of 45
    if (slots[i] == slots[i + 1]) {
      zero(to.mean, 3), zero(to.quat, 4), zero(to.scale, 3), zero(to.opacity, 1), zero(to.sh0, 3), zero(to.shN, 45);
      zero(to.screen, 2);
      continue;
    }
    SplatGradient total = {};
    for (uint32_t slot = slots[i]; slot < slots[i + 1]; ++slot) {
      const SplatGradient& part = parts[slot];
      total.power += part.power, total.e += part.e, total.y += part.y;
      total.ee += part.ee, total.ey += part.ey, total.yy += part.yy;
      for (int ch = 0; ch < 3; ++ch) total.color[ch] += part.color[ch];
      total.inverse_depth += part.inverse_depth;
    }
    project_backward(parameters(g, i), camera, sh_count, splats[i], total, to);
    zero(to.shN + rest, 45 - rest);
  }
}

// Σ weights[k] · rows[k]
void weighted_sum(const float* const* rows, const float* weights, int taps, int count, float* out) {
  int at = 0;
  for (; at + 4 * kLanes <= count; at += 4 * kLanes) {  // four sums at once hide the latency of each
    F sum[4] = {set(0), set(0), set(0), set(0)};
    for (int k = 0; k < taps; ++k)
      for (int i = 0; i < 4; ++i) sum[i] = fma(set(weights[k]), load(rows[k] + at + i * kLanes), sum[i]);
    for (int i = 0; i < 4; ++i) store(out + at + i * kLanes, sum[i]);
  }
  for (; at < count; ++at) {
    float sum = 0;
    for (int k = 0; k < taps; ++k) sum += weights[k] * rows[k][at];
    out[at] = sum;
  }
}

void blur_row(const float* row, int width, const float* window, float* __restrict padded, float* __restrict out) {
  const int edge = 3 * kWindowRadius, count = 3 * width;
  for (int i = 0; i < edge; ++i) {  // a panorama narrower than the window wraps more than once
    padded[i] = row[3 * (((i / 3 - kWindowRadius) % width + width) % width) + i % 3];
    padded[edge + count + i] = row[3 * ((i / 3) % width) + i % 3];
  }
  for (int i = 0; i < count; ++i) padded[edge + i] = row[i];
  const float* taps[2 * kWindowRadius + 1];
  for (int k = 0; k <= 2 * kWindowRadius; ++k) taps[k] = padded + 3 * k;
  weighted_sum(taps, window, 2 * kWindowRadius + 1, count, out);
}

void samples_row(const float* color, const uint8_t* target, const uint8_t* mask, int width, float* __restrict x,
                 float* __restrict y, RowSums& sums) {
  constexpr int kParts = 16;  // sums in parallel, so that the order is fixed and vectors can do it
  const int count = 3 * width;
  for (int i = 0; i < count; ++i) y[i] = target[i] / 255.0f;
  if (mask)
    for (int pixel = 0; pixel < width; ++pixel)
      for (int i = 3 * pixel; i < 3 * pixel + 3; ++i) x[i] = mask[pixel] ? color[i] : y[i];
  else
    for (int i = 0; i < count; ++i) x[i] = color[i];
  float l1[kParts] = {}, squared[kParts] = {};
  int at = 0;
  for (; at + kParts <= count; at += kParts)
    for (int i = 0; i < kParts; ++i) {
      const float difference = x[at + i] - y[at + i];
      l1[i] += fabsf(difference), squared[i] += difference * difference;
    }
  sums = {0, 0};
  for (; at < count; ++at) sums.l1 += fabsf(x[at] - y[at]), sums.squared += (x[at] - y[at]) * (x[at] - y[at]);
  for (int i = 0; i < kParts; ++i) sums.l1 += l1[i], sums.squared += squared[i];
}

// The sum in sixteen parts of fixed order.
float sum_of(const float* values, int count) {
  float parts[kLanes] = {}, total = 0;
  int at = 0;
  for (; at + kLanes <= count; at += kLanes) store(parts, load(parts) + load(values + at));
  for (; at < count; ++at) total += values[at];
  for (float part : parts) total += part;
  return total;
}

float ssim_row(const float* const means[5], const uint8_t* mask, int width, float weight, float* __restrict value,
               float* const by[3]) {
  const float *px = means[0], *py = means[1], *pxx = means[2], *pyy = means[3], *pxy = means[4];
  float *__restrict by_x = by[0], *__restrict by_xx = by[1], *__restrict by_xy = by[2];
  for (int i = 0; i < 3 * width; ++i) {
    const float mx = px[i], my = py[i];
    const float a = 2 * mx * my + kC1, b = 2 * (pxy[i] - mx * my) + kC2;
    const float c = mx * mx + my * my + kC1, d = (pxx[i] - mx * mx) + (pyy[i] - my * my) + kC2;
    const float inverse = 1 / (c * d), ssim = a * b * inverse;
    value[i] = ssim;
    by_x[i] = weight * (2 * my * (b - a) * inverse - 2 * mx * ssim * (d - c) * inverse);
    by_xx[i] = weight * -ssim * c * inverse;
    by_xy[i] = weight * 2 * a * inverse;
  }
  if (mask)
    for (int pixel = 0; pixel < width; ++pixel)
      if (!mask[pixel])
        for (int i = 3 * pixel; i < 3 * pixel + 3; ++i) value[i] = by_x[i] = by_xx[i] = by_xy[i] = 0;
  return sum_of(value, 3 * width);
}

void gradient_row(const float* const by[3], const float* x, const float* y, const uint8_t* mask, int width,
                  float l1_weight, float* __restrict out) {
  const float *by_x = by[0], *by_xx = by[1], *by_xy = by[2];
  for (int i = 0; i < 3 * width; ++i) {
    const float difference = x[i] - y[i];
    const float sign = difference > 0 ? l1_weight : difference < 0 ? -l1_weight : 0.0f;
    out[i] = by_x[i] + 2 * x[i] * by_xx[i] + y[i] * by_xy[i] + sign;
  }
  if (mask)
    for (int pixel = 0; pixel < width; ++pixel)
      if (!mask[pixel]) out[3 * pixel] = out[3 * pixel + 1] = out[3 * pixel + 2] = 0;
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

extern const Kernels kKernels = {PANOLOG_TEXT(PANOLOG_ISA), project_span, project_backward_span, tiles_of, tile_forward,
                                 tile_backward, samples_row, blur_row, weighted_sum, ssim_row, gradient_row, adam,
                                 ceiling_forward, ceiling_backward};

}  // namespace panolog::PANOLOG_ISA
