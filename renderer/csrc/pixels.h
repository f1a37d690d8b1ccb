// One splat on a block of 4 × 4 pixels, forward and backward (eq. 1).
// Included by tile.cpp, which is compiled once for each instruction set.
#pragma once
#include "kernels.h"
#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

struct Pair {  // one splat and 16 pixels at x, y, in the coordinates of its centre
  F e, dy, exponential, alpha;
  Mask counts;
};

// Transmittance t. With kWrap the nearest image of the splat on the cylinder of `width` counts for each pixel.
template <bool kWrap>
inline Pair evaluate(const Splat& s, F x, F y, F t, float width) {
  F dx = x - set(s.u);
  if (kWrap) dx = fnma(set(width), round(dx * set(1 / width)), dx);
  const F dy = y - set(s.v);
  const F e = fnma(set(s.slope), dy, dx);
  const F power = fma(dy, set(s.c) * dy, fma(e, set(s.a) * e, set(s.log2_opacity)));
  const Mask counts = (power >= kLog2AlphaMin) & (t >= kTransmittanceMin);
  const F exponential = exp2(power);
  return {e, dy, exponential, min(exponential, set(kAlphaMax)), counts};
}

struct Light {  // accumulated at 16 pixels so far
  F transmittance, r, g, b, inverse_depth;
};

template <bool kWrap>
inline void composite(const Splat& s, F x, F y, float width, Light& light) {
  const Pair pair = evaluate<kWrap>(s, x, y, light.transmittance, width);
  const F weight = keep(pair.counts, pair.alpha * light.transmittance);
  light.r = fma(weight, set(s.color[0]), light.r), light.g = fma(weight, set(s.color[1]), light.g);
  light.b = fma(weight, set(s.color[2]), light.b);
  light.inverse_depth = fma(weight, set(s.inverse_depth), light.inverse_depth);
  light.transmittance = light.transmittance - weight;
}

struct Behind {  // 16 pixels in the backward pass: `rest` is dL/d(what lies behind), times what lies behind
  F transmittance, rest;
};

struct PixelGradients {  // dL/d(r g b alpha inverse-depth)
  F r, g, b, alpha, inverse_depth;
};

// Adds to the ten sums of SplatGradient, in its order.
inline void composite_backward(const Splat& s, const Pair& pair, const PixelGradients& in, Behind& behind, F sum[]) {
  const F t = behind.transmittance;
  F value = fma(set(s.color[0]), in.r, in.alpha);
  value = fma(set(s.color[1]), in.g, fma(set(s.color[2]), in.b, fma(set(s.inverse_depth), in.inverse_depth, value)));
  const F weight = keep(pair.counts, pair.alpha * t), rest = fnma(weight, value, behind.rest);
  behind.rest = rest, behind.transmittance = t - weight;
  const F slope = fnma(rest, reciprocal(set(1) - pair.alpha), t * value);  // dL/dalpha
  // a capped alpha does not move with the exponent
  const F power = keep(pair.counts & (kAlphaMax >= pair.exponential), slope * pair.alpha);
  const F pe = power * pair.e, py = power * pair.dy;
  sum[0] = sum[0] + power, sum[1] = sum[1] + pe, sum[2] = sum[2] + py;
  sum[3] = fma(pe, pair.e, sum[3]), sum[4] = fma(pe, pair.dy, sum[4]), sum[5] = fma(py, pair.dy, sum[5]);
  sum[6] = fma(weight, in.r, sum[6]), sum[7] = fma(weight, in.g, sum[7]), sum[8] = fma(weight, in.b, sum[8]);
  sum[9] = fma(weight, in.inverse_depth, sum[9]);
}

}  // namespace
}  // namespace panolog::PANOLOG_ISA
