// Compositing of one tile, forward and backward (eq. 1). Compiled once for each instruction set.
#include "kernels.h"

#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

constexpr int kBatch = 128;
constexpr int kAhead = 8;  // entries: their splats lie anywhere in memory and are fetched in time
constexpr int kBlocks = 16;
constexpr float kLog2AlphaMin = -7.99435344f;  // log2(1/255)
constexpr float kSlack = 1e-3f;                // blocks this close to the cut are still tested pixel by pixel

struct Local {  // a splat as the pixels of this tile see it: its centre relative to the tile's corner
  float u, v, a, slope, c, log2_opacity, color[3], inverse_depth;
  float period, inverse_period;  // of u; 0 when one image of the splat serves the whole tile
};

const float kLaneX[16] = {0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5};
const float kLaneY[16] = {0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5};
const float kBlockX[16] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
const float kBlockY[16] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};

Local localise(const Splat& s, const TileInput& in) {
  // the image of the splat nearest to the middle of the tile: the panorama is a cylinder
  const float turns = __builtin_floorf((s.u - (in.x0 + kTile / 2)) / in.width + 0.5f);
  Local out = {s.u - in.x0 - turns * in.width, s.v - in.y0, s.a, s.slope, s.c, s.log2_opacity,
               {s.color[0], s.color[1], s.color[2]}, s.inverse_depth, 0, 0};
  if (s.flags & kWide) out.period = in.width, out.inverse_period = 1.0f / in.width;
  return out;
}

// Which of the tile's 16 blocks the footprint meets: the largest exponent over each block against the cut.
// The maximum of a concave form over a rectangle lies on the edges that face its centre.
uint32_t blocks_met(const Local& s) {
  if (s.period != 0) return 0xffff;
  const F left = load(kBlockX) + set(0.5f - s.u), right = left + set(3);
  const F top = load(kBlockY) + set(0.5f - s.v), bottom = top + set(3);
  const F x = max(left, min(right, set(0))), y = max(top, min(bottom, set(0)));  // nearest to the centre
  const F a = set(s.a), c = set(s.c), slope = set(s.slope);
  const F y_on_x = max(top, min(bottom, x * set(s.a * s.slope / (s.a * s.slope * s.slope + s.c))));
  const F x_on_y = max(left, min(right, y * slope));
  const F e_on_x = fnma(slope, y_on_x, x), e_on_y = fnma(slope, y, x_on_y);
  const F on_x = fma(a * e_on_x, e_on_x, c * y_on_x * y_on_x);
  const F on_y = fma(a * e_on_y, e_on_y, c * y * y);
  return bits(at_least(max(on_x, on_y), set(kLog2AlphaMin - kSlack - s.log2_opacity)));
}

struct Pair {  // 16 pixels and one Gaussian
  F e, dy, alpha;
};

inline Pair evaluate(const Local& s, F x, F y) {
  F dx = x - set(s.u);
  if (__builtin_expect(s.period != 0, 0)) dx = fnma(set(s.period), round(dx * set(s.inverse_period)), dx);
  const F dy = y - set(s.v);
  const F e = fnma(set(s.slope), dy, dx);
  const F power = fma(dy, set(s.c) * dy, fma(e, set(s.a) * e, set(s.log2_opacity)));
  return {e, dy, exp2(power)};
}

// Calls visit(index in block order, pixel of the image or -1 outside it) for every pixel of a tile.
template <class Visit>
void each_pixel(const TileInput& in, Visit visit) {
  for (int block = 0; block < kBlocks; ++block)
    for (int lane = 0; lane < kLanes; ++lane) {
      const int x = in.x0 + (block & 3) * 4 + (lane & 3), y = in.y0 + (block >> 2) * 4 + (lane >> 2);
      visit(block * kLanes + lane, x < in.width && y < in.height ? long(y) * in.width + x : -1);
    }
}

}  // namespace

void tile_forward(const TileInput& in, const Images& out) {
  alignas(64) float T[kTilePixels], C[5][kTilePixels] = {};  // transmittance; r g b alpha inverse-depth
  uint32_t alive = 0;
  each_pixel(in, [&](int i, long pixel) {
    T[i] = pixel >= 0 ? 1.0f : 0.0f;
    if (pixel >= 0) alive |= 1u << (i / kLanes);
  });
  Local batch[kBatch];
  uint8_t lists[kBlocks][kBatch];
  for (const Entry* entry = in.begin; entry < in.end && alive; entry += kBatch) {
    const int count = in.end - entry < kBatch ? int(in.end - entry) : kBatch;
    int lengths[kBlocks] = {};
    for (int i = 0; i < count; ++i) {
      if (entry + i + kAhead < in.end) __builtin_prefetch(&in.splats[entry[i + kAhead].splat]);
      batch[i] = localise(in.splats[entry[i].splat], in);
      for (uint32_t met = blocks_met(batch[i]) & alive; met; met &= met - 1) {
        const int block = __builtin_ctz(met);
        lists[block][lengths[block]++] = uint8_t(i);
      }
    }
    for (uint32_t rest = alive; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest), at = block * kLanes;
      const F x = load(kLaneX) + set((block & 3) * 4), y = load(kLaneY) + set((block >> 2) * 4);
      F t = load(T + at), r = load(C[0] + at), g = load(C[1] + at), b = load(C[2] + at);
      F a = load(C[3] + at), d = load(C[4] + at);
      for (int i = 0; i < lengths[block]; ++i) {
        const Local& s = batch[lists[block][i]];
        const F alpha = min(evaluate(s, x, y).alpha, set(kAlphaMax));
        const Mask counts = both(at_least(alpha, set(kAlphaMin)), at_least(t, set(kTransmittanceMin)));
        const F weight = keep(counts, alpha * t);
        r = fma(weight, set(s.color[0]), r), g = fma(weight, set(s.color[1]), g);
        b = fma(weight, set(s.color[2]), b), d = fma(weight, set(s.inverse_depth), d);
        a = a + weight, t = t - weight;
      }
      store(T + at, t), store(C[0] + at, r), store(C[1] + at, g), store(C[2] + at, b);
      store(C[3] + at, a), store(C[4] + at, d);
      if (!bits(at_least(t, set(kTransmittanceMin)))) alive &= ~(1u << block);
    }
  }
  each_pixel(in, [&](int i, long pixel) {
    if (pixel < 0) return;
    for (int ch = 0; ch < 3; ++ch) out.color[3 * pixel + ch] = C[ch][i];
    out.alpha[pixel] = C[3][i], out.inverse_depth[pixel] = C[4][i];
  });
}

// Front to back: what lies behind a Gaussian is the finished pixel less what has been composited so far.
void tile_backward(const TileInput& in, const Images& done, const ImageGradients& grad, SplatGradient* slots) {
  alignas(64) float T[kTilePixels], behind[kTilePixels], G[5][kTilePixels];  // G: dL/d(r g b alpha inverse-depth)
  uint32_t alive = 0;
  each_pixel(in, [&](int i, long pixel) {
    T[i] = pixel >= 0 ? 1.0f : 0.0f;
    float total = 0;
    for (int ch = 0; ch < 5; ++ch) G[ch][i] = 0;
    if (pixel >= 0) {
      alive |= 1u << (i / kLanes);
      for (int ch = 0; ch < 3; ++ch) {
        G[ch][i] = grad.color[3 * pixel + ch];
        total += G[ch][i] * done.color[3 * pixel + ch];
      }
      G[3][i] = grad.alpha[pixel], G[4][i] = grad.inverse_depth[pixel];
      total += G[3][i] * done.alpha[pixel] + G[4][i] * done.inverse_depth[pixel];
    }
    behind[i] = total;
  });
  static_assert(sizeof(SplatGradient) == kGradientFloats * sizeof(float), "ten floats");
  for (const Entry* entry = in.begin; entry < in.end; ++entry) {
    if (entry + kAhead < in.end) {
      __builtin_prefetch(&in.splats[entry[kAhead].splat]);
      __builtin_prefetch(&slots[entry[kAhead].slot], 1);
    }
    SplatGradient& out = slots[entry->slot];
    const Local s = localise(in.splats[entry->splat], in);
    uint32_t met = alive ? blocks_met(s) & alive : 0;
    if (!met) {
      out = SplatGradient{};
      continue;
    }
    F sum[kGradientFloats];
    for (F& value : sum) value = set(0);
    for (; met; met &= met - 1) {
      const int block = __builtin_ctz(met), at = block * kLanes;
      const F x = load(kLaneX) + set((block & 3) * 4), y = load(kLaneY) + set((block >> 2) * 4);
      const Pair pair = evaluate(s, x, y);
      const F alpha = min(pair.alpha, set(kAlphaMax)), t = load(T + at);
      const Mask counts = both(at_least(alpha, set(kAlphaMin)), at_least(t, set(kTransmittanceMin)));
      if (!bits(counts)) continue;
      const F gr = load(G[0] + at), gg = load(G[1] + at), gb = load(G[2] + at), gd = load(G[4] + at);
      F value = fma(set(s.color[0]), gr, load(G[3] + at));
      value = fma(set(s.color[1]), gg, fma(set(s.color[2]), gb, fma(set(s.inverse_depth), gd, value)));
      const F weight = keep(counts, alpha * t), rest = fnma(weight, value, load(behind + at));
      const F left = t - weight;
      store(behind + at, rest), store(T + at, left);
      const F slope = fnma(rest, reciprocal(set(1) - alpha), t * value);  // dL/dalpha
      // a capped alpha does not move with the exponent
      const F power = keep(both(counts, at_least(set(kAlphaMax), pair.alpha)), slope * alpha);
      const F pe = power * pair.e, py = power * pair.dy;
      sum[0] = sum[0] + power, sum[1] = sum[1] + pe, sum[2] = sum[2] + py;
      sum[3] = fma(pe, pair.e, sum[3]), sum[4] = fma(pe, pair.dy, sum[4]), sum[5] = fma(py, pair.dy, sum[5]);
      sum[6] = fma(weight, gr, sum[6]), sum[7] = fma(weight, gg, sum[7]), sum[8] = fma(weight, gb, sum[8]);
      sum[9] = fma(weight, gd, sum[9]);
      if (!bits(at_least(left, set(kTransmittanceMin)))) alive &= ~(1u << block);
    }
    sums_of_ten(sum, &out.power);
  }
}

}  // namespace panolog::PANOLOG_ISA
