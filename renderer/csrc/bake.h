// What a camera sees of a block's frozen exterior: layers before and behind all of the block's own Gaussians, and the
// splats among these. Nothing of it changes while the exterior is frozen.
#pragma once
#include "rasterize.h"

namespace panolog {

struct Baked {
  Frame frame;            // of all Gaussians
  Buffer<float> spans;    // T × 2, as in Exterior; the first above the second where the tile is not active
  Buffer<uint8_t> among;  // N: 1 for a splat of the exterior that can be seen in the span of one of its tiles
};

// All but the first `own` Gaussians as a camera sees them. A tile is active where own Gaussians can be seen in it or in
// a neighbour of it. Its span holds their distances in these nine tiles, farther by the fraction `slack`: own Gaussians
// move and grow. The layers composite what is nearer and what is farther; they are undefined in other tiles. What is
// within the span, but of whose weights a tile's pixels have `faint` at most, is in the layer behind: most of it is
// hidden by what lies before it. Throws as `order`.
void bake(const GaussianArrays& all, int64_t own, const Camera& camera, int sh_count, float slack, float faint,
          int threads, Baked& baked, const Images& front, const Images& back);

}  // namespace panolog
