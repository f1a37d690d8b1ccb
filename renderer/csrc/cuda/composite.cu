// Compositing of tiles, forward and backward (eq. 1): a block for each tile, a thread for each pixel. A view is how a
// thread sees splats, with affine or with exact projection; everything else is the same.
// A tile's splats pass through shared memory in batches; a warp tests 32 of them at once against its 8 × 4 pixels
// and composites those that reach it.
// Both passes must agree to the bit on which pairs count. What decides is therefore written with fmaf, as on the CPU:
// contraction would be the compiler's choice in each kernel.
#include "common.cuh"

namespace panolog {
namespace {

constexpr int kPatchWidth = 8, kPatchHeight = 4;  // pixels of a warp
constexpr float kSlack = 1e-3f;                   // patches this close to the cut are still tested pixel by pixel

struct Tile {
  const int32_t* entries;  // rows of the splats, nearest first: those from `first` to `end`
  int first, end;
  int x0, y0, width, height;
};

struct Pixel {
  float x, y;  // centre, relative to the tile's corner
  int64_t at;  // in the image; -1 outside
};

struct Patch {  // centres of the first and last pixels of a warp
  float left, top, right, bottom;
};

template <class Local>
struct Batch {
  Local splats[kTilePixels];
};

__device__ __forceinline__ Tile tile_of_block(const int32_t* entries, const int32_t* starts, int64_t width,
                                              int64_t height) {
  const int tile = int(blockIdx.y * gridDim.x + blockIdx.x);
  return {entries,    starts[tile], starts[tile + 1], int(blockIdx.x) * kTile, int(blockIdx.y) * kTile,
          int(width), int(height)};
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

// Not where it is not a number.
__device__ __forceinline__ float alpha_of(bool reached, float power, float transmittance) {
  return reached && transmittance >= kTransmittanceMin ? fminf(exp2f(power), kAlphaMax) : 0.0f;
}

// How a thread sees affine splats.
struct AffineView {
  // A splat as the pixels of a tile see it: its centre relative to the tile's corner. Three float4, which eight lanes
  // read at once from all banks.
  struct alignas(16) Local {
    float u, v, a, slope, c, log2_opacity;
    float lean;  // of the line on which the exponent is largest for each x: y = lean·x
    float inverse_depth, color[3];
    int row;  // of the splat; its complement where pixels of the tile see different images of the splat
  };
  struct Pair {  // a pixel and a splat
    float e, dy;
    float alpha;  // 0 where the pair does not count
  };
  static constexpr bool kWraps = true;  // a tile may see two images of a splat
  static constexpr int kSums = kGradientFloats;

  const Splat* splats;
  Tile tile;
  Patch patch;
  Pixel pixel;
  float period, inverse_period;  // of u

  // Returns whether pixels of the tile see different images of the splat.
  __device__ __forceinline__ bool localise(int row, Local& out) const {
    const Splat s = splats[row];
    // the image of the splat nearest to the middle of the tile: the panorama is a cylinder
    const float turns = rintf((s.u - (tile.x0 + kTile / 2)) * inverse_period);
    const float u = fmaf(-turns, period, s.u) - tile.x0, skew = s.a * s.slope;
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
  static __device__ __forceinline__ float exponent(const Local& s, float e, float dy) {
    return fmaf(dy, s.c * dy, fmaf(e, s.a * e, s.log2_opacity));
  }

  // Whether the footprint may meet the patch: the largest exponent over it against the cut.
  // The maximum of a concave form over a rectangle lies on the edges that face its centre.
  __device__ __forceinline__ bool meets(const Local& s) const {
    const float left = patch.left - s.u, right = patch.right - s.u, top = patch.top - s.v, bottom = patch.bottom - s.v;
    const float x = fmaxf(left, fminf(right, 0.0f)), y = fmaxf(top, fminf(bottom, 0.0f));  // nearest to the centre
    const float y_on_x = fmaxf(top, fminf(bottom, x * s.lean)), x_on_y = fmaxf(left, fminf(right, y * s.slope));
    const float on_x = exponent(s, fmaf(-s.slope, y_on_x, x), y_on_x), on_y = exponent(s, fmaf(-s.slope, y, x_on_y), y);
    return !(fmaxf(on_x, on_y) < kLog2AlphaMin - kSlack);  // pixels decide where it is not a number
  }

  // With kWrap the image of the splat nearest to the pixel counts.
  template <bool kWrap>
  __device__ __forceinline__ Pair evaluate(const Local& s, float transmittance) const {
    Pair pair;
    float dx = pixel.x - s.u;
    if (kWrap) dx = fmaf(-period, rintf(dx * inverse_period), dx);
    pair.dy = pixel.y - s.v;
    pair.e = fmaf(-s.slope, pair.dy, dx);
    const float power = exponent(s, pair.e, pair.dy);
    pair.alpha = alpha_of(power >= kLog2AlphaMin, power, transmittance);
    return pair;
  }

  // What SplatGradient sums of the exponent, from dL/dpower.
  static __device__ __forceinline__ void sums_of(const Pair& pair, float power, float* to) {
    const float e = power * pair.e, y = power * pair.dy;
    to[0] = power, to[1] = e, to[2] = y, to[3] = e * pair.e, to[4] = e * pair.dy, to[5] = y * pair.dy;
  }
};

__device__ __forceinline__ AffineView affine_view(const Splat* splats, const Tile& tile) {
  const Patch patch = patch_of_warp();
  const float period = float(tile.width);
  return {splats, tile, patch, pixel_of_thread(tile, patch), period, 1 / period};
}

// How a thread sees splats with exact projection, along the ray of its pixel.
struct RayView {
  struct alignas(16) Local {  // five float4, which eight lanes read at once from all banks
    float x[3], y[3], l[3], kappa, log2_opacity;
    float color[3], inverse_depth;
    int row;                                // of the splat
    float steep_x, steep_y, steep_l, open;  // RayBounds
  };
  struct Pair {
    float x, y, l, square, inverse;  // of rays.h: P, -1 / (l² + κ·P)
    float alpha;
  };
  static constexpr bool kWraps = false;
  static constexpr int kSums = kRayGradientFloats;

  const RaySplat* rays;
  Tile tile;
  Pixel pixel;
  float ray[3];
  PatchOf<float> patch;

  __device__ __forceinline__ bool localise(int row, Local& out) const {
    const RaySplat s = rays[row];
    const RayBounds b = bounds_of(s);
    out = {{s.x[0], s.x[1], s.x[2]},
           {s.y[0], s.y[1], s.y[2]},
           {s.l[0], s.l[1], s.l[2]},
           s.kappa,
           s.log2_opacity,
           {s.color[0], s.color[1], s.color[2]},
           s.inverse_depth,
           row,
           b.x,
           b.y,
           b.l,
           b.open};
    return false;
  }

  __device__ __forceinline__ bool meets(const Local& s) const {
    return may_meet(s, RayBounds{s.steep_x, s.steep_y, s.steep_l, s.open, room_of(s.log2_opacity)}, patch);
  }

  __device__ __forceinline__ float along(const float row[3]) const {
    return fmaf(row[0], ray[0], fmaf(row[1], ray[1], row[2] * ray[2]));
  }

  template <bool>
  __device__ __forceinline__ Pair evaluate(const Local& s, float transmittance) const {
    Pair pair;
    pair.x = along(s.x), pair.y = along(s.y), pair.l = along(s.l);
    pair.square = fmaf(pair.x, pair.x, pair.y * pair.y);
    pair.inverse = -1 / fmaf(s.kappa, pair.square, pair.l * pair.l);
    const float power = fmaf(pair.square, pair.inverse, s.log2_opacity);
    pair.alpha = alpha_of(power >= kLog2AlphaMin && pair.l > 0, power, transmittance);
    return pair;
  }

  // What RayGradient sums of the exponent, from dL/dpower.
  static __device__ __forceinline__ void sums_of(const Pair& pair, float power, float* to) {
    const float a = power * pair.inverse * pair.inverse, al = a * pair.l, lp = al * pair.square, shared = al * pair.l;
    const float hx = shared * pair.x, hy = shared * pair.y;
    to[0] = power, to[1] = hx * pair.x, to[2] = hx * pair.y, to[3] = hy * pair.y, to[4] = hx * pair.l;
    to[5] = hy * pair.l, to[6] = lp * pair.x, to[7] = lp * pair.y, to[8] = a * pair.square * pair.square;
  }
};

// azimuths, elevations: of every half pixel.
__device__ __forceinline__ RayView ray_view(const RaySplat* rays, const Angle* azimuths, const Angle* elevations,
                                            const Tile& tile) {
  const Patch patch = patch_of_warp();
  const Pixel pixel = pixel_of_thread(tile, patch);
  const Angle* const across = azimuths + 2 * tile.x0;
  const Angle* const down = elevations + 2 * tile.y0;
  const Angle u = across[int(2 * pixel.x)], v = down[int(2 * pixel.y)];
  return {rays,
          tile,
          pixel,
          {v.cosine * u.sine, v.sine, v.cosine * u.cosine},
          patch_around(across[int(patch.left + patch.right)], down[int(patch.top + patch.bottom)], kPatchWidth,
                       kPatchHeight, tile.width, tile.height)};
}

// Calls visit(splat, pair) for the splats of a batch that may reach the warp's patch. kWrap: some have two images.
template <bool kWrap, class View, class Local, class Visit>
__device__ __forceinline__ void each_of_batch(const View& view, const Batch<Local>& batch, int count,
                                              const float& transmittance, Visit visit) {
  const int lane = int(threadIdx.x % kWarp);
  for (int first = 0; first < count; first += kWarp) {
    if (!__any_sync(kAllLanes, transmittance >= kTransmittanceMin)) return;
    const Local& own = batch.splats[first + lane];
    const bool mine = first + lane < count && ((kWrap && own.row < 0) || view.meets(own));
    for (uint32_t met = __ballot_sync(kAllLanes, mine); met; met &= met - 1) {
      Local s = batch.splats[first + __ffs(int(met)) - 1];
      if (kWrap) s.row = max(s.row, ~s.row);
      visit(s, view.template evaluate<kWrap>(s, transmittance));
    }
  }
}

// Calls visit(splat, pair) nearest first, a whole warp at a time, until the pixels that `visit` darkens are opaque.
template <class View, class Local, class Visit>
__device__ __forceinline__ void each_splat(const View& view, Batch<Local>& batch, const float& transmittance,
                                           Visit visit) {
  const Tile& tile = view.tile;
  const int thread = int(threadIdx.x);
  for (int left = tile.end - tile.first; left > 0; left -= kTilePixels) {
    if (!__syncthreads_or(transmittance >= kTransmittanceMin)) return;
    const int count = min(left, kTilePixels);
    const bool wrapping = thread < count && view.localise(tile.entries[tile.end - left + thread], batch.splats[thread]);
    if constexpr (!View::kWraps) {
      __syncthreads();
      each_of_batch<false>(view, batch, count, transmittance, visit);
    }
    // the vote is for the compiler: it takes no barrier's result for the same in all lanes
    else if (__any_sync(kAllLanes, __syncthreads_or(wrapping)))
      each_of_batch<true>(view, batch, count, transmittance, visit);
    else
      each_of_batch<false>(view, batch, count, transmittance, visit);
  }
}

// Adds the sums over a warp's lanes of kCount values to as many consecutive floats, in one atomic instruction.
// Each exchange halves the values that a lane is responsible for: twelve shuffles instead of fifty for ten values.
template <int kCount>
__device__ __forceinline__ void add_sums(const float values[kCount], float* to) {
  constexpr int kHalf = (kCount + 1) / 2, kQuarter = (kHalf + 1) / 2;
  static_assert(kCount > 8 && kCount <= 16, "four exchanges leave one value");
  const int lane = int(threadIdx.x % kWarp);
  const bool b4 = lane & 16, b3 = lane & 8, b2 = lane & 4, b1 = lane & 2;
  float halves[2 * kQuarter], quarters[4], two[2];
  for (int i = 0; i < kHalf; ++i) {
    const float last = kHalf + i < kCount ? values[kHalf + i] : 0.0f;
    const float other = __shfl_xor_sync(kAllLanes, b4 ? values[i] : last, 16);
    halves[i] = (b4 ? last : values[i]) + other;
  }
  for (int i = kHalf; i < 2 * kQuarter; ++i) halves[i] = 0;
  for (int i = 0; i < kQuarter; ++i) {
    const float other = __shfl_xor_sync(kAllLanes, b3 ? halves[i] : halves[kQuarter + i], 8);
    quarters[i] = (b3 ? halves[kQuarter + i] : halves[i]) + other;
  }
  for (int i = kQuarter; i < 4; ++i) quarters[i] = 0;
  for (int i = 0; i < 2; ++i) {
    const float other = __shfl_xor_sync(kAllLanes, b2 ? quarters[i] : quarters[2 + i], 4);
    two[i] = (b2 ? quarters[2 + i] : quarters[i]) + other;
  }
  float one = (b1 ? two[1] : two[0]) + __shfl_xor_sync(kAllLanes, b1 ? two[0] : two[1], 2);
  one += __shfl_xor_sync(kAllLanes, one, 1);
  const int of_quarter = 2 * b2 + b1, of_half = kQuarter * b3 + of_quarter, of_all = kHalf * b4 + of_half;
  const bool held = of_quarter < kQuarter && of_half < kHalf && (kCount % 2 == 0 || of_all < kCount);
  if (!(lane & 1) && held) atomicAdd(to + of_all, one);
}

struct Images {
  float *color, *alpha, *inverse_depth;
};

struct Gradients {  // of the loss, and the finished images
  const float *color, *alpha, *inverse_depth, *grad_color, *grad_alpha, *grad_inverse_depth;
};

template <class View, class Local>
__device__ __forceinline__ void forward(const View& view, Batch<Local>& batch, const Images& out) {
  const Pixel& pixel = view.pixel;
  float t = pixel.at >= 0 ? 1.0f : 0.0f, r = 0, g = 0, b = 0, depth = 0;
  each_splat(view, batch, t, [&](const Local& s, const typename View::Pair& pair) {
    const float weight = pair.alpha * t;
    r += weight * s.color[0], g += weight * s.color[1], b += weight * s.color[2];
    depth += weight * s.inverse_depth;
    t = fmaf(-pair.alpha, t, t);
  });
  if (pixel.at < 0) return;
  out.color[3 * pixel.at] = r, out.color[3 * pixel.at + 1] = g, out.color[3 * pixel.at + 2] = b;
  out.alpha[pixel.at] = 1 - t, out.inverse_depth[pixel.at] = depth;
}

// Front to back: what lies behind a splat is the finished pixel less what has been composited so far.
template <class View, class Local>
__device__ __forceinline__ void backward(const View& view, Batch<Local>& batch, const Gradients& in, float* sums) {
  constexpr int kSums = View::kSums;
  float t = 0, behind = 0, gr = 0, gg = 0, gb = 0, ga = 0, gd = 0;
  if (const int64_t at = view.pixel.at; at >= 0) {
    t = 1;
    gr = in.grad_color[3 * at], gg = in.grad_color[3 * at + 1], gb = in.grad_color[3 * at + 2];
    ga = in.grad_alpha[at], gd = in.grad_inverse_depth[at];
    behind = gr * in.color[3 * at] + gg * in.color[3 * at + 1] + gb * in.color[3 * at + 2] + ga * in.alpha[at] +
             gd * in.inverse_depth[at];
  }
  each_splat(view, batch, t, [&](const Local& s, const typename View::Pair& pair) {
    if (!__any_sync(kAllLanes, pair.alpha > 0)) return;
    const float value = gr * s.color[0] + gg * s.color[1] + gb * s.color[2] + gd * s.inverse_depth + ga;
    const float weight = pair.alpha * t;
    behind -= weight * value;
    const float slope = t * value - behind / (1 - pair.alpha);  // dL/dalpha
    t = fmaf(-pair.alpha, t, t);
    // a capped alpha does not move with the exponent
    const float power = pair.alpha > 0 && pair.alpha < kAlphaMax ? slope * pair.alpha : 0.0f;
    float values[kSums];
    View::sums_of(pair, power, values);
    values[kSums - 4] = weight * gr, values[kSums - 3] = weight * gg, values[kSums - 2] = weight * gb;
    values[kSums - 1] = weight * gd;
    add_sums<kSums>(values, sums + int64_t(kSums) * s.row);
  });
}

}  // namespace
}  // namespace panolog

// entries: rows of the splats of each tile, those of tile i from starts[i] to starts[i + 1]. One block per tile.
extern "C" __global__ void __launch_bounds__(256)
    composite_forward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                      int64_t height, float* color, float* alpha, float* inverse_depth) {
  using namespace panolog;
  __shared__ Batch<AffineView::Local> batch;
  const AffineView view = affine_view(splats, tile_of_block(entries, starts, width, height));
  forward(view, batch, {color, alpha, inverse_depth});
}

// sums (N): zeros, to which each warp adds; in an order that differs from run to run, as rounding then does.
extern "C" __global__ void __launch_bounds__(256)
    composite_backward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                       int64_t height, const float* color, const float* alpha, const float* inverse_depth,
                       const float* grad_color, const float* grad_alpha, const float* grad_inverse_depth, float* sums) {
  using namespace panolog;
  static_assert(sizeof(SplatGradient) == kGradientFloats * sizeof(float), "ten floats");
  __shared__ Batch<AffineView::Local> batch;
  const AffineView view = affine_view(splats, tile_of_block(entries, starts, width, height));
  backward(view, batch, {color, alpha, inverse_depth, grad_color, grad_alpha, grad_inverse_depth}, sums);
}

// The same with exact projection. azimuths, elevations: of every half pixel of the tiles.
extern "C" __global__ void __launch_bounds__(256)
    composite_ray_forward(const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                          const panolog::Angle* elevations, const int32_t* entries, const int32_t* starts,
                          int64_t width, int64_t height, float* color, float* alpha, float* inverse_depth) {
  using namespace panolog;
  __shared__ Batch<RayView::Local> batch;
  const RayView view = ray_view(rays, azimuths, elevations, tile_of_block(entries, starts, width, height));
  forward(view, batch, {color, alpha, inverse_depth});
}

extern "C" __global__ void __launch_bounds__(256)
    composite_ray_backward(const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                           const panolog::Angle* elevations, const int32_t* entries, const int32_t* starts,
                           int64_t width, int64_t height, const float* color, const float* alpha,
                           const float* inverse_depth, const float* grad_color, const float* grad_alpha,
                           const float* grad_inverse_depth, float* sums) {
  using namespace panolog;
  static_assert(sizeof(RayGradient) == kRayGradientFloats * sizeof(float), "thirteen floats");
  __shared__ Batch<RayView::Local> batch;
  const RayView view = ray_view(rays, azimuths, elevations, tile_of_block(entries, starts, width, height));
  backward(view, batch, {color, alpha, inverse_depth, grad_color, grad_alpha, grad_inverse_depth}, sums);
}
