// Compositing of one tile, forward and backward (eq. 1), in blocks of 4 × 4 pixels.
// Compiled once for each instruction set.
#include "tile.h"

namespace panolog::PANOLOG_ISA {
namespace {

struct Pair {  // one splat and 16 pixels at x, y, in the coordinates of its centre
  F e, dy;
  Coverage cover;
};

// Transmittance t. With kWrap the nearest image of the splat on the cylinder of `width` counts for each pixel.
template <bool kWrap>
inline Pair evaluate(const Splat& s, F x, F y, F t, float width) {
  F dx = x - set(s.u);
  if (kWrap) dx = fnma(set(width), round(dx * set(1 / width)), dx);
  const F dy = y - set(s.v);
  const F e = fnma(set(s.slope), dy, dx);
  const F power = fma(dy, set(s.c) * dy, fma(e, set(s.a) * e, set(s.log2_opacity)));
  return {e, dy, cover(power, power >= kLog2AlphaMin, t)};
}

// Adds to the sums of SplatGradient or AbsoluteGradient, in its order.
template <class Gradient>
inline void add_sums(const Splat& s, const Pair& pair, F power, F weight, const PixelGradients& in, F sum[]) {
  const F pe = power * pair.e, py = power * pair.dy;
  sum[0] = sum[0] + power, sum[1] = sum[1] + pe, sum[2] = sum[2] + py;
  sum[3] = fma(pe, pair.e, sum[3]), sum[4] = fma(pe, pair.dy, sum[4]), sum[5] = fma(py, pair.dy, sum[5]);
  add_light_sums(weight, in, sum + 6);
  if constexpr (sizeof(Gradient) == sizeof(AbsoluteGradient)) {
    sum[10] = sum[10] + magnitude(pe);
    sum[11] = sum[11] + magnitude(fnma(set(s.slope * s.a), pe, set(s.c) * py));
  }
}

constexpr float kSlack = 1e-2f;  // pixels: blocks this close to a footprint are still tested pixel by pixel

const float kRowTop[16] = {0.5, 4.5, 8.5, 12.5, 0.5, 4.5, 8.5, 12.5, 0.5, 4.5, 8.5, 12.5, 0.5, 4.5, 8.5, 12.5};

F block_x(const TileInput& in, int block) { return load(kLaneX) + set(in.x0 + (block >> 2) * 4); }
F block_y(const TileInput& in, int block) { return load(kLaneY) + set(in.y0 + (block & 3) * 4); }

// How often to go around the cylinder to the image of a splat that is nearest to the middle of the tile.
F turns_to(F u, const TileInput& in) { return round((u - set(in.x0 + kTile / 2)) * set(1.0f / in.width)); }

// Which blocks the footprints of four splats meet, a bit for each block: see `band` of footprint.h.
// Also the u of their images that are nearest to the tile.
void blocks_met(const Splat* const s[4], const TileInput& in, uint16_t met[4], float nearest_u[kLanes]) {
  const float* const centers[4] = {&s[0]->u, &s[1]->u, &s[2]->u, &s[3]->u};
  const float* const shapes[4] = {&s[0]->reach, &s[1]->reach, &s[2]->reach, &s[3]->reach};
  const F center = load_fours(centers), shape = load_fours(shapes);  // u v a slope; reach tip waist half
  const F far = spread<0>(center), near = fnma(turns_to(far, in), set(in.width), far);
  const F u = near - set(in.x0), v = spread<1>(center) - set(in.y0), slope = spread<3>(center);
  const F reach = spread<0>(shape) + set(kSlack), tip = spread<1>(shape), waist = spread<2>(shape) + set(kSlack);
  const F none = set(0);
  const F v0 = load(kRowTop) - v, v1 = v0 + set(3);
  const F lo = max(v0, none - reach), hi = min(v1, reach);  // lanes: four rows of blocks of each splat
  const F right = min(max(tip, lo), hi), left = min(max(none - tip, lo), hi);
  const F inverse = reciprocal(reach);
  const F at_right = right * inverse, at_left = left * inverse;
  const F u1 = u + fma(slope, right, waist * sqrt(max(fnma(at_right, at_right, set(1)), none)));
  const F u0 = u + fnma(waist, sqrt(max(fnma(at_left, at_left, set(1)), none)), slope * left);
  const Mask some = hi >= lo;
  uint64_t columns = 0;  // 16 bits for each: four rows of four splats
  for (int column = 0; column < 4; ++column) {
    const float first = 4 * column + 0.5f, last = first + 3;
    columns |= uint64_t(bits(some & (u1 >= first) & (last >= u0))) << 16 * column;
  }
  for (int k = 0; k < 4; ++k) {
    const uint64_t rows = columns >> 4 * k & 0x000f000f000f000f;  // of this splat; packed into 16 bits:
    met[k] = uint16_t(rows | rows >> 12 | rows >> 24 | rows >> 36);
  }
  store(nearest_u, near);
}

struct Batch {
  Splat splats[kBatch];
  alignas(64) uint16_t met[kBatch];  // blocks that a footprint may meet
  uint16_t seen[kBatch];             // those of them with a pixel that composites it
  bool wraps;                        // any of them
};

// The next `count` splats.
void fill(Batch& batch, const TileInput& in, const Entry* entry, int count) {
  alignas(64) float u[kLanes];
  batch.wraps = false;
  for (int i = 0; i < count; i += 4) {
    const Splat* splats[4];
    for (int k = 0; k < 4; ++k) {
      splats[k] = &in.splats[entry[i + k < count ? i + k : i].splat];
      if (entry + i + k + kAhead < in.end) __builtin_prefetch(&in.splats[entry[i + k + kAhead].splat]);
    }
    blocks_met(splats, in, batch.met + i, u);
    for (int k = 0; k < 4 && i + k < count; ++k) {
      batch.splats[i + k] = *splats[k];
      batch.splats[i + k].u = u[4 * k];
      if (wraps(u[4 * k] - in.x0, splats[k]->half, in.width)) batch.met[i + k] = 0xffff, batch.wraps = true;
      batch.seen[i + k] = 0;
    }
  }
  for (int i = count; i < (count + kWord - 1) / kWord * kWord; ++i) batch.met[i] = 0;
}

template <bool kWrap>
void composite_block(const TileInput& in, Batch& batch, const uint8_t* list, int length, int block, Light& light) {
  const F x = block_x(in, block), y = block_y(in, block);
  for (int i = 0; i < length; ++i) {
    const Splat& s = batch.splats[list[i]];
    const Coverage by = evaluate<kWrap>(s, x, y, light.transmittance, in.width).cover;
    composite(s, by, light);
    batch.seen[list[i]] |= uint16_t((bits(by.counts) != 0) << block);
  }
}

}  // namespace

void tile_forward(const TileInput& in, const Images& out) {
  alignas(64) float state[kPlanes][kTilePixels] = {};  // transmittance; r g b inverse-depth
  uint32_t alive = open_pixels(in, state);
  Batch batch;
  uint8_t list[kBatch + 8];
  Entry* entry = in.begin;
  for (int count; entry < in.end && alive; entry += count) {
    count = in.end - entry < kBatch ? int(in.end - entry) : kBatch;
    fill(batch, in, entry, count);
    for (uint32_t rest = alive; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest), at = block * kLanes;
      Light light = load_light(state, at);
      const int length = list_of(batch.met, count, block, list);
      if (batch.wraps)
        composite_block<true>(in, batch, list, length, block, light);
      else
        composite_block<false>(in, batch, list, length, block, light);
      if (!store_light(light, state, at)) alive &= ~(1u << block);
    }
    for (int i = 0; i < count; ++i) entry[i].met = batch.seen[i];
  }
  for (; entry < in.end; ++entry) entry->met = 0;  // behind opaque pixels
  write_pixels(in, state, out);
}

namespace {

template <class Gradient>
using Back = BackBatch<Splat, Gradient, 160>;

template <bool kWrap, class Gradient>
void block_backward(const TileInput& in, Back<Gradient>& batch, const uint8_t* list, int length, int block,
                    TileGradients& pixels) {
  const int at = block * kLanes;
  const F x = block_x(in, block), y = block_y(in, block);
  const PixelGradients gradients = pixels.gradients(at);
  Behind behind = pixels.behind(at);
  for (int i = 0; i < length; ++i) {
    const Splat& s = batch.splats[list[i]];
    const Pair pair = evaluate<kWrap>(s, x, y, behind.transmittance, in.width);
    F weight, value;
    if (batch.slots[list[i]] == kNoSlot) {
      pass(s, pair.cover, gradients, behind, value);
      continue;
    }
    const F power = power_gradient(s, pair.cover, gradients, behind, weight);
    add_sums<Gradient>(s, pair, power, weight, gradients, batch.sums[list[i]]);
  }
  pixels.advance(behind, at);
}

// Moves splats to their images that are nearest to the tile; returns whether one reaches around the cylinder.
template <class Gradient>
bool unwrap(const TileInput& in, Back<Gradient>& batch) {
  bool found = false;
  for (int i = 0; i < batch.count; ++i) {
    float& u = batch.splats[i].u;
    if (__builtin_expect(__builtin_fabsf(u - (in.x0 + kTile / 2)) > 0.5f * in.width, 0)) {
      float turns[kLanes];
      store(turns, turns_to(set(u), in));
      u = __builtin_fmaf(-turns[0], in.width, u);
    }
    found |= wraps(u - in.x0, batch.splats[i].half, in.width);
  }
  return found;
}

// Front to back: what lies behind a Gaussian is the finished pixel less what has been composited so far.
template <class Gradient>
void backward(const TileInput& in, const Images& done, const ImageGradients& grad, Gradient* slots) {
  TileGradients pixels(in, done, grad);
  Back<Gradient> batch;
  uint8_t list[kBatch + 8];
  for (const Entry* entry = in.begin; entry < in.end;) {
    entry = batch.fill(in, in.splats, entry, slots);
    const bool wrapped = unwrap(in, batch);
    for (int block = 0; block < kBlocks; ++block) {
      const int length = list_of(batch.met, batch.count, block, list);
      if (wrapped)
        block_backward<true>(in, batch, list, length, block, pixels);
      else
        block_backward<false>(in, batch, list, length, block, pixels);
    }
    batch.write(slots);
  }
}

}  // namespace

void tile_backward(const TileInput& in, const Images& done, const ImageGradients& grad, SplatGradient* slots) {
  static_assert(sizeof(SplatGradient) == kGradientFloats * sizeof(float), "ten floats");
  backward(in, done, grad, slots);
}

void tile_absolute_backward(const TileInput& in, const Images& done, const ImageGradients& grad,
                            AbsoluteGradient* slots) {
  static_assert(sizeof(AbsoluteGradient) == kAbsoluteGradientFloats * sizeof(float), "twelve floats");
  backward(in, done, grad, slots);
}

}  // namespace panolog::PANOLOG_ISA
