// Compositing of tiles, forward and backward (eq. 1): a block for each tile, a thread for each pixel. A view is how a
// thread sees splats, with affine or with exact projection; everything else is the same.
// A tile's splats pass through shared memory in batches; a warp tests 32 of them at once against its 8 × 4 pixels
// and composites those that reach it.
// Both passes must agree to the bit on which pairs count. What decides is therefore written with fmaf, as on the CPU:
// contraction would be the compiler's choice in each kernel.
#include "views.cuh"

namespace panolog {
namespace {

constexpr float kWeightUnits = 1 << 22;  // in a weight of 1: 256 of them, those of a tile, are within 32 bits

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

// Calls visit(splat, pair, entry) for the splats of a batch that may reach the warp's patch. kWrap: some have two
// images.
template <bool kWrap, class View, class Local, class Visit>
__device__ __forceinline__ void each_of_batch(const View& view, const Batch<Local>& batch, int begin, int count,
                                              const float& transmittance, Visit visit) {
  const int lane = int(threadIdx.x % kWarp);
  for (int first = 0; first < count; first += kWarp) {
    if (!__any_sync(kAllLanes, transmittance >= kTransmittanceMin)) return;
    const Local& own = batch.splats[first + lane];
    const bool mine = first + lane < count && ((kWrap && own.row < 0) || view.meets(own));
    for (uint32_t met = __ballot_sync(kAllLanes, mine); met; met &= met - 1) {
      const int place = first + __ffs(int(met)) - 1;
      Local s = batch.splats[place];
      if (kWrap) s.row = max(s.row, ~s.row);
      visit(s, view.template evaluate<kWrap>(s, transmittance), begin + place);
    }
  }
}

// Calls visit(splat, pair, entry) nearest first, a whole warp at a time, until the pixels that `visit` darkens are
// opaque. entry: the place of the splat in the tile's list.
template <class View, class Local, class Visit>
__device__ __forceinline__ void each_splat(const View& view, Batch<Local>& batch, const float& transmittance,
                                           Visit visit) {
  const Tile& tile = view.tile;
  const int thread = int(threadIdx.x);
  for (int left = tile.end - tile.first; left > 0; left -= kTilePixels) {
    if (!__syncthreads_or(transmittance >= kTransmittanceMin)) return;
    const int count = min(left, kTilePixels), begin = tile.end - left;
    const bool wrapping = thread < count && view.localise(tile.entries[begin + thread], batch.splats[thread]);
    if constexpr (!View::kWraps) {
      __syncthreads();
      each_of_batch<false>(view, batch, begin, count, transmittance, visit);
    }
    // the vote is for the compiler: it takes no barrier's result for the same in all lanes
    else if (__any_sync(kAllLanes, __syncthreads_or(wrapping)))
      each_of_batch<true>(view, batch, begin, count, transmittance, visit);
    else
      each_of_batch<false>(view, batch, begin, count, transmittance, visit);
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

// What is frozen before and behind the splats of a tile.
struct Layers {
  const int32_t* places;      // of each tile in the layers, -1 for none; null: there are none
  const float *front, *back;  // A × 5 × kTilePixels: transmittance, r g b, inverse depth
};

struct Light {  // of a layer at one pixel
  float transmittance, r, g, b, inverse_depth;
};

// Clear where there is no layer.
__device__ __forceinline__ Light light_of(const float* layer, const int32_t* places, const Pixel& pixel) {
  const int place = places ? places[blockIdx.y * gridDim.x + blockIdx.x] : -1;
  if (place < 0) return {1, 0, 0, 0, 0};
  const float* const at = layer + int64_t(place) * 5 * kTilePixels + int(pixel.y) * kTile + int(pixel.x);
  return {at[0], at[kTilePixels], at[2 * kTilePixels], at[3 * kTilePixels], at[4 * kTilePixels]};
}

struct Images {
  float *color, *alpha, *inverse_depth;
};

struct Gradients {  // of the loss, and the finished images
  const float *color, *alpha, *inverse_depth, *grad_color, *grad_alpha, *grad_inverse_depth;
};

template <class View, class Local>
__device__ __forceinline__ void forward(const View& view, Batch<Local>& batch, const Layers& layers,
                                        const Images& out) {
  const Pixel& pixel = view.pixel;
  const Light front = light_of(layers.front, layers.places, pixel);
  float t = pixel.at >= 0 ? front.transmittance : 0.0f, r = front.r, g = front.g, b = front.b;
  float depth = front.inverse_depth;
  each_splat(view, batch, t, [&](const Local& s, const typename View::Pair& pair, int) {
    const float weight = pair.alpha * t;
    r += weight * s.color[0], g += weight * s.color[1], b += weight * s.color[2];
    depth += weight * s.inverse_depth;
    t = fmaf(-pair.alpha, t, t);
  });
  if (pixel.at < 0) return;
  const Light back = light_of(layers.back, layers.places, pixel);
  out.color[3 * pixel.at] = r + t * back.r, out.color[3 * pixel.at + 1] = g + t * back.g;
  out.color[3 * pixel.at + 2] = b + t * back.b;
  out.alpha[pixel.at] = 1 - t * back.transmittance, out.inverse_depth[pixel.at] = depth + t * back.inverse_depth;
}

// Front to back: what lies behind a splat is the finished pixel less what has been composited so far.
// Splats from row `own` on are frozen: they have no sums.
template <class View, class Local>
__device__ __forceinline__ void backward(const View& view, Batch<Local>& batch, const Layers& layers,
                                         const Gradients& in, int64_t own, float* sums) {
  constexpr int kSums = View::kSums, kLight = View::kLight;
  float t = 0, behind = 0, gr = 0, gg = 0, gb = 0, ga = 0, gd = 0;
  if (const int64_t at = view.pixel.at; at >= 0) {
    const Light front = light_of(layers.front, layers.places, view.pixel);
    t = front.transmittance;
    gr = in.grad_color[3 * at], gg = in.grad_color[3 * at + 1], gb = in.grad_color[3 * at + 2];
    ga = in.grad_alpha[at], gd = in.grad_inverse_depth[at];
    behind = gr * (in.color[3 * at] - front.r) + gg * (in.color[3 * at + 1] - front.g) +
             gb * (in.color[3 * at + 2] - front.b) + ga * (in.alpha[at] - (1 - t)) +
             gd * (in.inverse_depth[at] - front.inverse_depth);
  }
  each_splat(view, batch, t, [&](const Local& s, const typename View::Pair& pair, int) {
    if (!__any_sync(kAllLanes, pair.alpha > 0)) return;
    const float value = gr * s.color[0] + gg * s.color[1] + gb * s.color[2] + gd * s.inverse_depth + ga;
    const float weight = pair.alpha * t;
    behind -= weight * value;
    const float slope = t * value - behind / (1 - pair.alpha);  // dL/dalpha
    t = fmaf(-pair.alpha, t, t);
    if (s.row >= own) return;
    // a capped alpha does not move with the exponent
    const float power = pair.alpha > 0 && pair.alpha < kAlphaMax ? slope * pair.alpha : 0.0f;
    float values[kSums];
    View::sums_of(s, pair, power, values);
    values[kLight] = weight * gr, values[kLight + 1] = weight * gg, values[kLight + 2] = weight * gb;
    values[kLight + 3] = weight * gd;
    add_sums<kSums>(values, sums + int64_t(kSums) * s.row);
  });
}

// Adds up the weights of each entry of the tile's list in its pixels: as integers, whose sum has the same bits in any
// order. Nothing where the span of own splats is empty.
template <class View, class Local>
__device__ __forceinline__ void weigh(const View& view, Batch<Local>& batch, const float* spans, uint32_t* weights) {
  const float* const span = spans + 2 * int64_t(blockIdx.y * gridDim.x + blockIdx.x);
  if (span[0] > span[1]) return;
  float t = view.pixel.at >= 0 ? 1.0f : 0.0f;
  each_splat(view, batch, t, [&](const Local&, const typename View::Pair& pair, int entry) {
    if (!__any_sync(kAllLanes, pair.alpha > 0)) return;
    float weight = pair.alpha * t;
    t = fmaf(-pair.alpha, t, t);
    for (int step = kWarp / 2; step; step /= 2) weight += __shfl_down_sync(kAllLanes, weight, step);
    const uint32_t units = uint32_t(weight * kWeightUnits + 0.5f);
    if (threadIdx.x % kWarp == 0) atomicAdd(weights + entry, units);
  });
}

}  // namespace
}  // namespace panolog

// entries: rows of the splats of each tile, those of tile i from starts[i] to starts[i + 1]. One block per tile.
// places, front, back: of Layers.
extern "C" __global__ void __launch_bounds__(256)
    composite_forward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                      int64_t height, const int32_t* places, const float* front, const float* back, float* color,
                      float* alpha, float* inverse_depth) {
  using namespace panolog;
  __shared__ Batch<AffineView::Local> batch;
  const AffineView view = affine_view(splats, tile_of_block(entries, starts, width, height));
  forward(view, batch, {places, front, back}, {color, alpha, inverse_depth});
}

// sums (own): zeros, to which each warp adds; in an order that differs from run to run, as rounding then does.
extern "C" __global__ void __launch_bounds__(256)
    composite_backward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                       int64_t height, const int32_t* places, const float* front, const float* color,
                       const float* alpha, const float* inverse_depth, const float* grad_color, const float* grad_alpha,
                       const float* grad_inverse_depth, int64_t own, float* sums) {
  using namespace panolog;
  static_assert(sizeof(SplatGradient) == kGradientFloats * sizeof(float), "ten floats");
  __shared__ Batch<AffineView::Local> batch;
  const AffineView view = affine_view(splats, tile_of_block(entries, starts, width, height));
  backward(view, batch, {places, front, nullptr},
           {color, alpha, inverse_depth, grad_color, grad_alpha, grad_inverse_depth}, own, sums);
}

// The same with absolute gradients.
extern "C" __global__ void __launch_bounds__(256)
    composite_absolute_backward(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts,
                                int64_t width, int64_t height, const int32_t* places, const float* front,
                                const float* color, const float* alpha, const float* inverse_depth,
                                const float* grad_color, const float* grad_alpha, const float* grad_inverse_depth,
                                int64_t own, float* sums) {
  using namespace panolog;
  static_assert(sizeof(AbsoluteGradient) == kAbsoluteGradientFloats * sizeof(float), "twelve floats");
  __shared__ Batch<AffineView::Local> batch;
  const AbsoluteView view = {affine_view(splats, tile_of_block(entries, starts, width, height))};
  backward(view, batch, {places, front, nullptr},
           {color, alpha, inverse_depth, grad_color, grad_alpha, grad_inverse_depth}, own, sums);
}

// The same with exact projection. azimuths, elevations: of every half pixel of the tiles.
extern "C" __global__ void __launch_bounds__(256)
    composite_ray_forward(const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                          const panolog::Angle* elevations, const int32_t* entries, const int32_t* starts,
                          int64_t width, int64_t height, const int32_t* places, const float* front, const float* back,
                          float* color, float* alpha, float* inverse_depth) {
  using namespace panolog;
  __shared__ Batch<RayView::Local> batch;
  const RayView view = ray_view(rays, azimuths, elevations, tile_of_block(entries, starts, width, height));
  forward(view, batch, {places, front, back}, {color, alpha, inverse_depth});
}

extern "C" __global__ void __launch_bounds__(256)
    composite_ray_backward(const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                           const panolog::Angle* elevations, const int32_t* entries, const int32_t* starts,
                           int64_t width, int64_t height, const int32_t* places, const float* front, const float* color,
                           const float* alpha, const float* inverse_depth, const float* grad_color,
                           const float* grad_alpha, const float* grad_inverse_depth, int64_t own, float* sums) {
  using namespace panolog;
  static_assert(sizeof(RayGradient) == kRayGradientFloats * sizeof(float), "thirteen floats");
  __shared__ Batch<RayView::Local> batch;
  const RayView view = ray_view(rays, azimuths, elevations, tile_of_block(entries, starts, width, height));
  backward(view, batch, {places, front, nullptr},
           {color, alpha, inverse_depth, grad_color, grad_alpha, grad_inverse_depth}, own, sums);
}

// The weights by which bake.h decides what is composited among own splats. weights (E): zeros, to which those of each
// entry are added. spans (T × 2): of own splats.
extern "C" __global__ void __launch_bounds__(256)
    composite_weights(const panolog::Splat* splats, const int32_t* entries, const int32_t* starts, int64_t width,
                      int64_t height, const float* spans, uint32_t* weights) {
  using namespace panolog;
  __shared__ Batch<AffineView::Local> batch;
  weigh(affine_view(splats, tile_of_block(entries, starts, width, height)), batch, spans, weights);
}

// The same with exact projection.
extern "C" __global__ void __launch_bounds__(256)
    composite_ray_weights(const panolog::RaySplat* rays, const panolog::Angle* azimuths,
                          const panolog::Angle* elevations, const int32_t* entries, const int32_t* starts,
                          int64_t width, int64_t height, const float* spans, uint32_t* weights) {
  using namespace panolog;
  __shared__ Batch<RayView::Local> batch;
  const RayView view = ray_view(rays, azimuths, elevations, tile_of_block(entries, starts, width, height));
  weigh(view, batch, spans, weights);
}
