// What compositing of one tile needs whatever the shape of its splats. Included only by what is compiled once for each
// instruction set.
#pragma once
#include "kernels.h"
#include "simd.h"

namespace panolog::PANOLOG_ISA {
namespace {

struct Coverage {  // of 16 pixels by one splat
  F exponential, alpha;
  Mask counts;
};

// From log2 alpha, whether the splat reaches the pixel, and the transmittance t before it.
inline Coverage cover(F power, Mask reached, F t) {
  const F exponential = exp2(power);
  return {exponential, min(exponential, set(kAlphaMax)), reached & (t >= kTransmittanceMin)};
}

struct Light {  // accumulated at 16 pixels so far
  F transmittance, r, g, b, inverse_depth;
};

template <class S>
inline void composite(const S& s, const Coverage& by, Light& light) {
  const F weight = keep(by.counts, by.alpha * light.transmittance);
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

// Passes on to what lies behind a splat. Returns its weight at 16 pixels, and in `value` dL/dweight.
template <class S>
inline F pass(const S& s, const Coverage& by, const PixelGradients& in, Behind& behind, F& value) {
  value = fma(set(s.color[0]), in.r, in.alpha);
  value = fma(set(s.color[1]), in.g, fma(set(s.color[2]), in.b, fma(set(s.inverse_depth), in.inverse_depth, value)));
  const F weight = keep(by.counts, by.alpha * behind.transmittance);
  behind.rest = fnma(weight, value, behind.rest), behind.transmittance = behind.transmittance - weight;
  return weight;
}

// dL/d(ln alpha) at 16 pixels before the cap, and the splat's weight in them; passes on to what lies behind it.
template <class S>
inline F power_gradient(const S& s, const Coverage& by, const PixelGradients& in, Behind& behind, F& weight) {
  const F t = behind.transmittance;
  F value;
  weight = pass(s, by, in, behind, value);
  const F slope = fnma(behind.rest, reciprocal(set(1) - by.alpha), t * value);  // dL/dalpha
  // a capped alpha does not move with the exponent
  return keep(by.counts & (kAlphaMax >= by.exponential), slope * by.alpha);
}

inline void add_light_sums(F weight, const PixelGradients& in, F sum[4]) {
  sum[0] = fma(weight, in.r, sum[0]), sum[1] = fma(weight, in.g, sum[1]), sum[2] = fma(weight, in.b, sum[2]);
  sum[3] = fma(weight, in.inverse_depth, sum[3]);
}

constexpr int kBatch = 256;     // splats whose blocks are found before any is composited; they stay in the first cache
constexpr int kWord = 32;       // of them whose bits are read at once
constexpr int kAhead = 40;      // entries: their splats lie anywhere in memory and are fetched in time
constexpr int kBackAhead = 24;  // the same in the backward pass, which also fetches where gradients go
constexpr int kBlocks = 16;     // of a tile, by columns: block b has its corner at 4·(b / 4), 4·(b % 4)

const float kLaneX[16] = {0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5};
const float kLaneY[16] = {0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5};

// Calls visit(index in block order, index in a plane of a layer, pixel of the image or -1 outside it) for every pixel
// of a tile.
template <class Visit>
void each_pixel(const TileInput& in, Visit visit) {
  for (int block = 0; block < kBlocks; ++block)
    for (int lane = 0; lane < kLanes; ++lane) {
      const int across = (block >> 2) * 4 + (lane & 3), down = (block & 3) * 4 + (lane >> 2);
      const int x = in.x0 + across, y = in.y0 + down;
      visit(block * kLanes + lane, down * kTile + across, x < in.width && y < in.height ? long(y) * in.width + x : -1);
    }
}

// Transmittance, r g b and inverse depth of a tile's pixels before its first splat, in block order. Returns the blocks
// with pixels of the image that are not opaque.
inline uint32_t open_pixels(const TileInput& in, float state[kPlanes][kTilePixels]) {
  uint32_t alive = 0;
  each_pixel(in, [&](int i, int at, long pixel) {
    state[0][i] = pixel >= 0 ? 1.0f : 0.0f;
    if (pixel >= 0 && in.front)
      for (int plane = 0; plane < kPlanes; ++plane) state[plane][i] = in.front[plane * kTilePixels + at];
    if (state[0][i] >= kTransmittanceMin) alive |= 1u << (i / kLanes);
  });
  return alive;
}

inline Light load_light(const float state[kPlanes][kTilePixels], int at) {
  return {load(state[0] + at), load(state[1] + at), load(state[2] + at), load(state[3] + at), load(state[4] + at)};
}

// False where all pixels of the block are opaque.
inline bool store_light(const Light& light, float state[kPlanes][kTilePixels], int at) {
  store(state[0] + at, light.transmittance), store(state[1] + at, light.r), store(state[2] + at, light.g);
  store(state[3] + at, light.b), store(state[4] + at, light.inverse_depth);
  return bits(light.transmittance >= kTransmittanceMin);
}

inline void write_pixels(const TileInput& in, const float state[kPlanes][kTilePixels], const Images& out) {
  each_pixel(in, [&](int i, int at, long pixel) {
    if (pixel < 0) return;
    const float before = state[0][i];  // the back layer
    const auto behind = [&](int plane) { return in.back ? before * in.back[plane * kTilePixels + at] : 0.0f; };
    for (int ch = 0; ch < 3; ++ch) out.color[3 * pixel + ch] = state[1 + ch][i] + behind(1 + ch);
    out.alpha[pixel] = 1 - (in.back ? behind(0) : before), out.inverse_depth[pixel] = state[4][i] + behind(4);
  });
}

// The pixels of a tile in the backward pass, in block order.
struct TileGradients {
  alignas(64) float T[kTilePixels], rest[kTilePixels], G[5][kTilePixels];  // as Behind and PixelGradients

  TileGradients(const TileInput& in, const Images& done, const ImageGradients& grad) {
    each_pixel(in, [&](int i, int at, long pixel) {
      const auto front = [&](int plane) { return in.front ? in.front[plane * kTilePixels + at] : 0.0f; };
      T[i] = pixel >= 0 ? (in.front ? front(0) : 1.0f) : 0.0f;
      float total = 0;
      for (int ch = 0; ch < 5; ++ch) G[ch][i] = 0;
      if (pixel >= 0) {
        for (int ch = 0; ch < 3; ++ch) {
          G[ch][i] = grad.color[3 * pixel + ch];
          total += G[ch][i] * (done.color[3 * pixel + ch] - front(1 + ch));
        }
        G[3][i] = grad.alpha[pixel], G[4][i] = grad.inverse_depth[pixel];
        total += G[3][i] * (done.alpha[pixel] - (1 - T[i])) + G[4][i] * (done.inverse_depth[pixel] - front(4));
      }
      rest[i] = total;
    });
  }

  Behind behind(int at) const { return {load(T + at), load(rest + at)}; }

  PixelGradients gradients(int at) const {
    return {load(G[0] + at), load(G[1] + at), load(G[2] + at), load(G[3] + at), load(G[4] + at)};
  }

  void advance(const Behind& now, int at) { store(T + at, now.transmittance), store(rest + at, now.rest); }
};

struct SetBits {
  uint64_t places[256];  // of the set bits of a byte, one in each byte from the lowest on
  uint8_t count[256];
};

constexpr SetBits set_bits() {
  SetBits out = {};
  for (int byte = 0; byte < 256; ++byte)
    for (int bit = 0; bit < 8; ++bit)
      if (byte >> bit & 1) out.places[byte] |= uint64_t(bit) << 8 * out.count[byte]++;
  return out;
}

constexpr SetBits kSetBits = set_bits();

// Which of the first `count` splats meet the block, by their bits, in order; returns how many. A list without a branch
// on any bit: the loop over it ends once, where one over the bits would be mispredicted every few splats.
inline int list_of(const uint16_t* met_blocks, int count, int block, uint8_t list[kBatch + 8]) {
  int length = 0;
  for (int first = 0; first < count; first += kWord) {
    const uint32_t met = bit_of_each(met_blocks + first, block);
    for (int k = 0; k < kWord; k += 8) {
      const int byte = met >> k & 255;
      const uint64_t places = kSetBits.places[byte] + uint64_t(first + k) * 0x0101010101010101u;
      __builtin_memcpy(list + length, &places, sizeof places);
      length += kSetBits.count[byte];
    }
  }
  return length;
}

// Splats of the backward pass that composite in a tile, with their sums so far: few, so that these stay in the second
// cache. Block by block, as in the forward pass, no branch depends on how many blocks a splat meets.
template <class S, class Gradient, int kSplats>
struct BackBatch {
  static constexpr int kSums = sizeof(Gradient) / sizeof(float);
  S splats[kSplats];
  alignas(64) uint16_t met[kSplats];  // blocks
  uint32_t slots[kSplats];
  alignas(64) F sums[kSplats][kSums];
  int count;

  // Takes splats from `entry` on until there is no more room; returns the next entry. Sets the gradients of those that
  // composite nowhere to 0.
  const Entry* fill(const TileInput& in, const S* from, const Entry* entry, Gradient* gradients) {
    Gradient nowhere;
    for (count = 0; entry < in.end && count < kSplats; ++entry) {
      if (entry + kBackAhead < in.end) {
        const Entry& next = entry[kBackAhead];
        __builtin_prefetch(&from[next.splat]);
        if (next.slot != kNoSlot) __builtin_prefetch(&gradients[next.slot], 1);
      }
      *(entry->slot == kNoSlot ? &nowhere : &gradients[entry->slot]) = Gradient{};
      splats[count] = from[entry->splat];
      met[count] = uint16_t(entry->met), slots[count] = entry->slot;
      count += entry->met != 0;
    }
    for (int i = 0; i < count; ++i)
      for (F& sum : sums[i]) sum = set(0);
    for (int i = count; i < (count + kWord - 1) / kWord * kWord; ++i) met[i] = 0;
    return entry;
  }

  void write(Gradient* gradients) const {
    for (int i = 0; i < count; ++i)
      if (slots[i] != kNoSlot) sums_of<kSums>(sums[i], &gradients[slots[i]].power);
  }
};

}  // namespace
}  // namespace panolog::PANOLOG_ISA
