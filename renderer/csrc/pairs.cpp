#include "pairs.h"

#include <algorithm>
#include <cmath>

namespace panolog {
namespace {

constexpr int kBlock = 4, kBlocks = 16;  // pixels a side; of a tile, by columns, as tile.cpp has them

// One splat in a block whose corner pixel is (x0, y0). Pixels beyond the image have no transmittance left.
int composite(const Splat& s, int x0, int y0, int width, float* transmittance) {
  int useful = 0;
  for (int i = 0; i < kBlock * kBlock; ++i) {
    float dx = x0 + i % kBlock + 0.5f - s.u;
    dx -= width * std::rint(dx / width);
    const float dy = y0 + i / kBlock + 0.5f - s.v, e = dx - s.slope * dy;
    const float alpha = std::min(std::exp2(s.log2_opacity + s.a * e * e + s.c * dy * dy), kAlphaMax);
    if (alpha < kAlphaMin || transmittance[i] < kTransmittanceMin) continue;
    transmittance[i] -= alpha * transmittance[i];
    ++useful;
  }
  return useful;
}

Pairs count_tile(const FrameView& frame, int tile, int width, int height) {
  const int across = tiles_across(width), x0 = tile % across * kTile, y0 = tile / across * kTile;
  float clear[kBlocks][kBlock * kBlock];
  for (int block = 0; block < kBlocks; ++block)
    for (int i = 0; i < kBlock * kBlock; ++i) {
      const int x = x0 + block / 4 * kBlock + i % kBlock, y = y0 + block % 4 * kBlock + i / kBlock;
      clear[block][i] = x < width && y < height ? 1.0f : 0.0f;
    }
  Pairs pairs = {0, 0};
  for (uint32_t k = frame.tiles[tile]; k < frame.tiles[tile + 1]; ++k)
    for (int block = 0; block < kBlocks; ++block) {
      float* const left = clear[block];
      const bool alive = *std::max_element(left, left + kBlock * kBlock) >= kTransmittanceMin;
      if (!alive || !(frame.entries[k].met >> block & 1)) continue;
      pairs.evaluated += kBlock * kBlock;
      pairs.useful += composite(frame.splats[frame.entries[k].splat], x0 + block / 4 * kBlock, y0 + block % 4 * kBlock,
                                width, left);
    }
  return pairs;
}

}  // namespace

Pairs count_pairs(const FrameView& frame, int width, int height) {
  const int tiles = tiles_across(width) * tiles_across(height);
  int64_t evaluated = 0, useful = 0;
#pragma omp parallel for schedule(dynamic, 1) reduction(+ : evaluated, useful)
  for (int tile = 0; tile < tiles; ++tile) {
    const Pairs pairs = count_tile(frame, tile, width, height);
    evaluated += pairs.evaluated, useful += pairs.useful;
  }
  return {evaluated, useful};
}

}  // namespace panolog
