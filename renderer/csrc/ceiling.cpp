// The highest possible rate of pairs of pixel and splat: the arithmetic of the tiles with all operands in registers,
// without fetching or culling. Compiled once for each instruction set, for benchmarks.
#include "pixels.h"

namespace panolog::PANOLOG_ISA {
namespace {

constexpr Splat kSplat = {0.1f, 0, -1e-3f, 0.1f, -1e-3f, -5, {0.1f, 0.2f, 0.3f}, 0.5f, 2, 0, 10, 0, 10, 10};

F total(const F* values, int count) {
  F sum = set(0);
  for (int i = 0; i < count; ++i) sum = sum + values[i];
  return sum;
}

}  // namespace

// `rounds` splats on one block of pixels that moves by `step`, which is 0 at run time but unknown to the compiler.
// Returns a value that depends on all of the work, so that none of it is optimised away.
float ceiling_forward(int64_t rounds, float step) {
  F x = set(0);
  const F y = set(1);
  Light light = {set(1), x, x, x, x};
  for (int64_t i = 0; i < rounds; ++i) composite<false>(kSplat, x = x + set(step), y, 1024, light);
  float out[kLanes];
  const F all[] = {light.transmittance, light.r, light.g, light.b, light.inverse_depth};
  store(out, total(all, 5));
  return out[0];
}

float ceiling_backward(int64_t rounds, float step) {
  F x = set(0), sum[kGradientFloats];
  const F y = set(1);
  for (F& value : sum) value = x;
  Behind behind = {set(1), set(0.5f)};
  const PixelGradients gradients = {set(step + 1), set(step + 2), set(step + 3), set(step + 4), set(step + 5)};
  for (int64_t i = 0; i < rounds; ++i) {
    x = x + set(step);
    composite_backward(kSplat, evaluate<false>(kSplat, x, y, behind.transmittance, 1024), gradients, behind, sum);
  }
  float out[kLanes];
  store(out, total(sum, kGradientFloats) + behind.rest);
  return out[0];
}

}  // namespace panolog::PANOLOG_ISA
