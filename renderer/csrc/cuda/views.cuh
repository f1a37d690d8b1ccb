// How a thread of composite.cu sees the splats of its tile and its pixel: with affine and with exact projection.
// What decides which pairs count is written with fmaf, as composite.cu says.
#pragma once
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
  static constexpr bool kWraps = true;                       // a tile may see two images of a splat
  static constexpr int kSums = kGradientFloats, kLight = 6;  // the first of the colours in them

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
  static __device__ __forceinline__ void sums_of(const Local&, const Pair& pair, float power, float* to) {
    const float e = power * pair.e, y = power * pair.dy;
    to[0] = power, to[1] = e, to[2] = y, to[3] = e * pair.e, to[4] = e * pair.dy, to[5] = y * pair.dy;
  }
};

// The same with absolute gradients.
struct AbsoluteView : AffineView {
  static constexpr int kSums = kAbsoluteGradientFloats;

  static __device__ __forceinline__ void sums_of(const Local& s, const Pair& pair, float power, float* to) {
    AffineView::sums_of(s, pair, power, to);
    to[10] = fabsf(to[1]), to[11] = fabsf(s.c * to[2] - s.slope * s.a * to[1]);
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
  static constexpr int kSums = kRayGradientFloats, kLight = 9;

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
  static __device__ __forceinline__ void sums_of(const Local&, const Pair& pair, float power, float* to) {
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

}  // namespace
}  // namespace panolog
