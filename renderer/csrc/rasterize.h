// The CPU rasterizer: projection, ordering, binning into tiles, compositing; and the way back.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "kernels.h"

namespace panolog {

// A frame in somebody else's memory.
struct FrameView {
  const Splat* splats;
  const uint32_t *ids, *slots;
  const Entry* entries;
  const uint32_t* tiles;
  int64_t count;  // V
};

// What the forward pass leaves for the backward pass.
struct Frame {
  std::vector<Splat> splats;       // V, nearest first
  std::vector<uint32_t> ids;       // V: row of the Gaussian
  std::vector<uint32_t> slots;     // V + 1: a splat's slots are slots[i] .. slots[i + 1]
  std::vector<Entry> entries;      // by tile, nearest first within it
  std::vector<uint32_t> tiles;     // tiles + 1: a tile's entries
  FrameView view() const {
    return {splats.data(), ids.data(), slots.data(), entries.data(), tiles.data(), int64_t(ids.size())};
  }
};

// Calls visit(begin, end) in parallel for ranges of `span` that cover 0 .. count.
template <class Visit>
void each_span(int64_t count, int threads, int64_t span, Visit visit) {
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int64_t begin = 0; begin < count; begin += span)
    visit(begin, begin + span < count ? begin + span : count);
}

// Fills `frame`, the images and state (N, of State). Throws std::length_error beyond 2³² tile entries.
void rasterize(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads, Frame& frame,
               const Images& images, uint8_t* state);

void rasterize_backward(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
                        const FrameView& frame, const Images& images, const ImageGradients& image_gradients,
                        const GradientArrays& gradients);

}  // namespace panolog
