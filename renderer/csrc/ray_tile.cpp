// Compositing of one tile with exact projection (rays.h), in blocks of 4 × 4 pixels. Compiled once for each instruction
// set.
#include "tile.h"

namespace panolog::PANOLOG_ISA {
namespace {

struct Rays {  // of 16 pixels
  F x, y, z;
};

struct Pair {                  // one splat and 16 pixels
  F x, y, l, square, inverse;  // of rays.h: P, 1 / (l² + κ·P)
  Coverage cover;
};

inline F along(const float row[3], const Rays& r) {
  return fma(set(row[0]), r.x, fma(set(row[1]), r.y, set(row[2]) * r.z));
}

inline Pair evaluate(const RaySplat& s, const Rays& r, F t) {
  const F x = along(s.x, r), y = along(s.y, r), l = along(s.l, r);
  const F square = fma(x, x, y * y), inverse = reciprocal(fma(set(s.kappa), square, l * l));
  const F power = fnma(square, inverse, set(s.log2_opacity));
  return {x, y, l, square, inverse, cover(power, (power >= kLog2AlphaMin) & (l > 0), t)};
}

// Adds to the thirteen sums of RayGradient, in its order.
inline void add_sums(const Pair& p, F power, F weight, const PixelGradients& in, F sum[]) {
  const F a = power * p.inverse * p.inverse, al = a * p.l, lp = al * p.square, shared = al * p.l;
  const F hx = shared * p.x, hy = shared * p.y;
  sum[0] = sum[0] + power;
  sum[1] = fma(hx, p.x, sum[1]), sum[2] = fma(hx, p.y, sum[2]), sum[3] = fma(hy, p.y, sum[3]);
  sum[4] = fma(hx, p.l, sum[4]), sum[5] = fma(hy, p.l, sum[5]);
  sum[6] = fma(lp, p.x, sum[6]), sum[7] = fma(lp, p.y, sum[7]);
  sum[8] = fma(a * p.square, p.square, sum[8]);
  add_light_sums(weight, in, sum + 9);
}

Rays block_rays(const TileInput& in, int block) {
  const int x0 = in.x0 + (block >> 2) * 4, y0 = in.y0 + (block & 3) * 4;
  alignas(64) float x[kLanes], y[kLanes], z[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const int u = x0 + (lane & 3), v = y0 + (lane >> 2);
    x[lane] = in.pixels.cos_v[v] * in.pixels.sin_u[u];
    y[lane] = in.pixels.sin_v[v], z[lane] = in.pixels.cos_v[v] * in.pixels.cos_u[u];
  }
  return {load(x), load(y), load(z)};
}

PatchOf<F> patches(const TileInput& in) {  // a tile's blocks
  alignas(64) float sin_u[kLanes], cos_u[kLanes], sin_v[kLanes], cos_v[kLanes];
  for (int block = 0; block < kBlocks; ++block) {
    const int u = in.x0 / 4 + (block >> 2), v = in.y0 / 4 + (block & 3);
    sin_u[block] = in.blocks.sin_u[u], cos_u[block] = in.blocks.cos_u[u];
    sin_v[block] = in.blocks.sin_v[v], cos_v[block] = in.blocks.cos_v[v];
  }
  return patch_at(load(sin_u), load(cos_u), load(sin_v), load(cos_v), half_azimuth(4, in.width),
                  half_elevation(4, in.height));
}

struct Batch {
  RaySplat splats[kBatch];
  alignas(64) uint16_t met[kBatch];  // blocks that a footprint may meet
  uint16_t seen[kBatch];             // those of them with a pixel that composites it
};

// The next `count` splats.
void fill(Batch& batch, const TileInput& in, const PatchOf<F>& blocks, const Entry* entry, int count) {
  for (int i = 0; i < count; ++i) {
    if (entry + i + kAhead < in.end) __builtin_prefetch(&in.rays[entry[i + kAhead].splat]);
    const RaySplat& s = batch.splats[i] = in.rays[entry[i].splat];
    batch.met[i] = uint16_t(bits(may_meet(s, bounds_of(s), blocks))), batch.seen[i] = 0;
  }
  for (int i = count; i < (count + kWord - 1) / kWord * kWord; ++i) batch.met[i] = 0;
}

}  // namespace

void ray_tile_forward(const TileInput& in, const Images& out) {
  alignas(64) float state[kPlanes][kTilePixels] = {};
  uint32_t alive = open_pixels(in, state);
  const PatchOf<F> blocks = patches(in);
  Batch batch;
  uint8_t list[kBatch + 8];
  Entry* entry = in.begin;
  for (int count; entry < in.end && alive; entry += count) {
    count = in.end - entry < kBatch ? int(in.end - entry) : kBatch;
    fill(batch, in, blocks, entry, count);
    for (uint32_t rest = alive; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest), at = block * kLanes;
      Light light = load_light(state, at);
      const int length = list_of(batch.met, count, block, list);
      const Rays rays = block_rays(in, block);
      for (int i = 0; i < length; ++i) {
        const RaySplat& s = batch.splats[list[i]];
        const Coverage by = evaluate(s, rays, light.transmittance).cover;
        composite(s, by, light);
        batch.seen[list[i]] |= uint16_t((bits(by.counts) != 0) << block);
      }
      if (!store_light(light, state, at)) alive &= ~(1u << block);
    }
    for (int i = 0; i < count; ++i) entry[i].met = batch.seen[i];
  }
  for (; entry < in.end; ++entry) entry->met = 0;  // behind opaque pixels
  write_pixels(in, state, out);
}

void ray_tile_backward(const TileInput& in, const Images& done, const ImageGradients& grad, RayGradient* slots) {
  Rays rays[kBlocks];
  for (int block = 0; block < kBlocks; ++block) rays[block] = block_rays(in, block);
  TileGradients pixels(in, done, grad);
  static_assert(sizeof(RayGradient) == kRayGradientFloats * sizeof(float), "thirteen floats");
  BackBatch<RaySplat, RayGradient, 128> batch;
  uint8_t list[kBatch + 8];
  for (const Entry* entry = in.begin; entry < in.end;) {
    entry = batch.fill(in, in.rays, entry, slots);
    for (int block = 0; block < kBlocks; ++block) {
      const int length = list_of(batch.met, batch.count, block, list), at = block * kLanes;
      const PixelGradients gradients = pixels.gradients(at);
      Behind behind = pixels.behind(at);
      for (int i = 0; i < length; ++i) {
        const RaySplat& s = batch.splats[list[i]];
        const Pair pair = evaluate(s, rays[block], behind.transmittance);
        F weight, value;
        if (batch.slots[list[i]] == kNoSlot) {
          pass(s, pair.cover, gradients, behind, value);
          continue;
        }
        const F power = power_gradient(s, pair.cover, gradients, behind, weight);
        add_sums(pair, power, weight, gradients, batch.sums[list[i]]);
      }
      pixels.advance(behind, at);
    }
    batch.write(slots);
  }
}

}  // namespace panolog::PANOLOG_ISA
