// What a camera sees of a block's frozen exterior: layers before and behind all of the block's own Gaussians, and the
// splats among these. Nothing of it changes while the exterior is frozen.
#pragma once
#include "rasterize.h"

namespace panolog {

struct Baked {
  Frame frame;            // of the exterior, its splats and rays are those of Exterior
  Buffer<float> spans;    // T × 2, as in Exterior; the first above the second where the tile is not active
  Buffer<uint8_t> among;  // N: 1 where a splat of the exterior lies in the span of one of its tiles
};

// A tile is active where own Gaussians can be seen in it or in a neighbour of it. Its span holds their distances in
// these nine tiles, farther by the fraction `slack`: own Gaussians move and grow. The layers composite what is nearer
// and what is farther; they are undefined in other tiles. Throws as `order`.
void bake(const GaussianArrays& own, const GaussianArrays& exterior, const Camera& camera, int sh_count, float slack,
          int threads, Baked& baked, const Images& front, const Images& back);

}  // namespace panolog
