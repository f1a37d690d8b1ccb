// Compositing of tiles, forward and backward (eq. 1): a block for each tile, a thread for each pixel.
// A tile's splats pass through shared memory in batches; a warp tests 32 of them at once against its 8 × 4 pixels
// and composites those that reach it.
// Both passes must agree to the bit on which pairs count. What decides is therefore written with fmaf, as on the CPU:
// contraction would be the compiler's choice in each kernel.
#include "common.cuh"

namespace panolog {
namespace {

constexpr int kPatchWidth = 8, kPatchHeight = 4;  // pixels of a warp
constexpr float kSlack = 1e-3f;                   // patches this close to the cut are still tested pixel by pixel

// A splat as the pixels of a tile see it: its centre relative to the tile's corner. Three float4, which eight lanes
// read at once from all banks.
struct alignas(16) Local {
  float u, v, a, slope, c, log2_opacity;
  float lean;  // of the line on which the exponent is largest for each x: y = lean·x
  float inverse_depth, color[3];
  int row;  // of the splat; its complement where pixels of the tile see different images of the splat
};

struct Batch {
  Local splats[kTilePixels];
};

struct Tile {
  const Splat* splats;
  const int32_t* entries;  // rows of the splats, nearest first: those from `first` to `end`
  int first, end;
  int x0, y0, width, height;
  float period, inverse_period;  // of u
};

struct Pixel {
  float x, y;  // centre, relative to the tile's corner
  int64_t at;  // in the image; -1 outside
};

struct Patch {  // centres of the first and last pixels of a warp
  float left, top, right, bottom;
};

struct Pair {  // a pixel and a splat
  float e, dy;
  float alpha;  // 0 where the pair does not count
};

__device__ __forceinline__ Tile tile_of_block(const Splat* splats, const int32_t* entries, const int32_t* starts,
                                              int64_t width, int64_t height) {
  const int tile = int(blockIdx.y * gridDim.x + blockIdx.x);
  return {splats,     entries,     starts[tile], starts[tile + 1], int(blockIdx.x) * kTile, int(blockIdx.y) * kTile,
          int(width), int(height), float(width), 1 / float(width)};
}

__device__ __forceinline__ Patch patch_of_warp() {
  const int warp = int(threadIdx.x / kWarp), across = kTile / kPatchWidth;
  const float left = warp % across * kPatchWidth + 0.5f, top = warp / across * kPatchHeight + 0.5f;
  return {left, top, left + (kPatchWidth - 1), top + (kPatchHeight - 1)};
}

__device__ __forceinline__ Pixel pixel_of_thread(const Tile& tile, const Patch& patch) {
  const int lane = int(threadIdx.x % kWarp);
  const float x = patch.left + lane % kPatchWidth, y = patch.top + lane / kPatchWidth;
  const int column = tile.x0 + int(x), row = tile.y0 + int(y);
  return {x, y, column < tile.width && row < tile.height ? int64_t(row) * tile.width + column : -1};
}

// Returns whether pixels of the tile see different images of the splat.
__device__ __forceinline__ bool localise(const Tile& tile, int row, Local& out) {
  const Splat s = tile.splats[row];
  // the image of the splat nearest to the middle of the tile: the panorama is a cylinder
  const float turns = rintf((s.u - (tile.x0 + kTile / 2)) * tile.inverse_period);
  const float u = fmaf(-turns, tile.period, s.u) - tile.x0, skew = s.a * s.slope;
  const bool wrapping = wraps(u, s.half, tile.width);
  out = {u,
         s.v - tile.y0,
         s.a,
         s.slope,
         s.c,
         s.log2_opacity,
         skew / fmaf(skew, s.slope, s.c),
         s.inverse_depth,
         {s.color[0], s.color[1], s.color[2]},
         wrapping ? ~row : row};
  return wrapping;
}

// log2 alpha before it is capped.
__device__ __forceinline__ float exponent(const Local& s, float e, float dy) {
  return fmaf(dy, s.c * dy, fmaf(e, s.a * e, s.log2_opacity));
}

// Whether the footprint may meet the patch: the largest exponent over it against the cut.
// The maximum of a concave form over a rectangle lies on the edges that face its centre.
__device__ __forceinline__ bool meets(const Local& s, const Patch& patch) {
  const float left = patch.left - s.u, right = patch.right - s.u, top = patch.top - s.v, bottom = patch.bottom - s.v;
  const float x = fmaxf(left, fminf(right, 0.0f)), y = fmaxf(top, fminf(bottom, 0.0f));  // nearest to the centre
  const float y_on_x = fmaxf(top, fminf(bottom, x * s.lean)), x_on_y = fmaxf(left, fminf(right, y * s.slope));
  const float on_x = exponent(s, fmaf(-s.slope, y_on_x, x), y_on_x), on_y = exponent(s, fmaf(-s.slope, y, x_on_y), y);
  return !(fmaxf(on_x, on_y) < kLog2AlphaMin - kSlack);  // pixels decide where it is not a number
}

// With kWrap the image of the splat nearest to the pixel counts.
template <bool kWrap>
__device__ __forceinline__ Pair evaluate(const Local& s, const Tile& tile, const Pixel& pixel, float transmittance) {
  Pair pair;
  float dx = pixel.x - s.u;
  if (kWrap) dx = fmaf(-tile.period, rintf(dx * tile.inverse_period), dx);
  pair.dy = pixel.y - s.v;
  pair.e = fmaf(-s.slope, pair.dy, dx);
  const float power = exponent(s, pair.e, pair.dy);
  const bool counts = power >= kLog2AlphaMin && transmittance >= kTransmittanceMin;  // not where it is not a number
  pair.alpha = counts ? fminf(exp2f(power), kAlphaMax) : 0.0f;
  return pair;
}

// Calls visit(splat, pair) for the splats of a batch that may reach the warp's patch. kWrap: some have two images.
template <bool kWrap, class Visit>
__device__ __forceinline__ void each_of_batch(const Batch& batch, int count, const Tile& tile, const Patch& patch,
                                              const Pixel& pixel, const float& transmittance, Visit visit) {
  const int lane = int(threadIdx.x % kWarp);
  for (int first = 0; first < count; first += kWarp) {
    if (!__any_sync(kAllLanes, transmittance >= kTransmittanceMin)) return;
    const Local& own = batch.splats[first + lane];
    const bool mine = first + lane < count && ((kWrap && own.row < 0) || meets(own, patch));
    for (uint32_t met = __ballot_sync(kAllLanes, mine); met; met &= met - 1) {
      Local s = batch.splats[first + __ffs(int(met)) - 1];
      if (kWrap) s.row = max(s.row, ~s.row);
      visit(s, evaluate<kWrap>(s, tile, pixel, transmittance));
    }
  }
}

// Calls visit(splat, pair) nearest first, a whole warp at a time, until the pixels that `visit` darkens are opaque.
template <class Visit>
__device__ __forceinline__ void each_splat(const Tile& tile, const Patch& patch, const Pixel& pixel, Batch& batch,
                                           const float& transmittance, Visit visit) {
  const int thread = int(threadIdx.x);
  for (int left = tile.end - tile.first; left > 0; left -= kTilePixels) {
    if (!__syncthreads_or(transmittance >= kTransmittanceMin)) return;
    const int count = min(left, kTilePixels);
    const bool wrapping =
        thread < count && localise(tile, tile.entries[tile.end - left + thread], batch.splats[thread]);
    // the vote is for the compiler: it takes no barrier's result for the same in all lanes
    if (__any_sync(kAllLanes, __syncthreads_or(wrapping)))
      each_of_batch<true>(batch, count, tile, patch, pixel, transmittance, visit);
    else
      each_of_batch<false>(batch, count, tile, patch, pixel, transmittance, visit);
  }
}

// Adds the sums over a warp's lanes of ten values to ten consecutive floats, in one atomic instruction.
// Each exchange halves the values that a lane is responsible for: twelve shuffles instead of fifty.
__device__ __forceinline__ void add_sums(const float values[10], float* to) {
  const int lane = int(threadIdx.x % kWarp);
  const bool b4 = lane & 16, b3 = lane & 8, b2 = lane & 4, b1 = lane & 2;
  float five[6], three[4], two[2];
  for (int i = 0; i < 5; ++i) {
    const float other = __shfl_xor_sync(kAllLanes, b4 ? values[i] : values[5 + i], 16);
    five[i] = (b4 ? values[5 + i] : values[i]) + other;
  }
  five[5] = 0;
  for (int i = 0; i < 3; ++i) {
    const float other = __shfl_xor_sync(kAllLanes, b3 ? five[i] : five[3 + i], 8);
    three[i] = (b3 ? five[3 + i] : five[i]) + other;
  }
  three[3] = 0;
  for (int i = 0; i < 2; ++i) {
    const float other = __shfl_xor_sync(kAllLanes, b2 ? three[i] : three[2 + i], 4);
    two[i] = (b2 ? three[2 + i] : three[i]) + other;
  }
  float one = (b1 ? two[1] : two[0]) + __shfl_xor_sync(kAllLanes, b1 ? two[0] : two[1], 2);
  one += __shfl_xor_sync(kAllLanes, one, 1);
  const int of_three = 2 * b2 + b1, of_five = 3 * b3 + of_three;
  if (!(lane & 1) && of_three < 3 && of_five < 5) atomicAdd(to + 5 * b4 + of_five, one);
}

}  // namespace
}  // namespace panolog

// entries: rows of the splats of each tile, those of tile i from starts[i] to starts[i + 1]. One block per tile.
extern "C" __global__ void __launch_bounds__(256)
    composite_forward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                      int64_t height, float* color, float* alpha, float* inverse_depth) {
  using namespace panolog;
  __shared__ Batch batch;
  const Tile tile = tile_of_block(splats, entries, starts, width, height);
  const Patch patch = patch_of_warp();
  const Pixel pixel = pixel_of_thread(tile, patch);
  float t = pixel.at >= 0 ? 1.0f : 0.0f, r = 0, g = 0, b = 0, depth = 0;
  each_splat(tile, patch, pixel, batch, t, [&](const Local& s, const Pair& pair) {
    const float weight = pair.alpha * t;
    r += weight * s.color[0], g += weight * s.color[1], b += weight * s.color[2];
    depth += weight * s.inverse_depth;
    t = fmaf(-pair.alpha, t, t);
  });
  if (pixel.at < 0) return;
  color[3 * pixel.at] = r, color[3 * pixel.at + 1] = g, color[3 * pixel.at + 2] = b;
  alpha[pixel.at] = 1 - t, inverse_depth[pixel.at] = depth;
}

// Front to back: what lies behind a splat is the finished pixel less what has been composited so far.
// sums (N): zeros, to which each warp adds; in an order that differs from run to run, as rounding then does.
extern "C" __global__ void __launch_bounds__(256)
    composite_backward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                       int64_t height, const float* color, const float* alpha, const float* inverse_depth,
                       const float* grad_color, const float* grad_alpha, const float* grad_inverse_depth, float* sums) {
  using namespace panolog;
  static_assert(sizeof(SplatGradient) == kGradientFloats * sizeof(float), "ten floats");
  __shared__ Batch batch;
  const Tile tile = tile_of_block(splats, entries, starts, width, height);
  const Patch patch = patch_of_warp();
  const Pixel pixel = pixel_of_thread(tile, patch);
  float t = 0, behind = 0, gr = 0, gg = 0, gb = 0, ga = 0, gd = 0;
  if (const int64_t at = pixel.at; at >= 0) {
    t = 1;
    gr = grad_color[3 * at], gg = grad_color[3 * at + 1], gb = grad_color[3 * at + 2];
    ga = grad_alpha[at], gd = grad_inverse_depth[at];
    behind =
        gr * color[3 * at] + gg * color[3 * at + 1] + gb * color[3 * at + 2] + ga * alpha[at] + gd * inverse_depth[at];
  }
  each_splat(tile, patch, pixel, batch, t, [&](const Local& s, const Pair& pair) {
    if (!__any_sync(kAllLanes, pair.alpha > 0)) return;
    const float value = gr * s.color[0] + gg * s.color[1] + gb * s.color[2] + gd * s.inverse_depth + ga;
    const float weight = pair.alpha * t;
    behind -= weight * value;
    const float slope = t * value - behind / (1 - pair.alpha);  // dL/dalpha
    t = fmaf(-pair.alpha, t, t);
    // a capped alpha does not move with the exponent
    const float power = pair.alpha > 0 && pair.alpha < kAlphaMax ? slope * pair.alpha : 0.0f;
    const float e = power * pair.e, y = power * pair.dy;
    const float values[kGradientFloats] = {power,       e,           y,           e * pair.e,  e * pair.dy,
                                           y * pair.dy, weight * gr, weight * gg, weight * gb, weight * gd};
    add_sums(values, sums + int64_t(kGradientFloats) * s.row);
  });
}
