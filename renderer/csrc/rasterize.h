// The CPU rasterizer: projection, ordering, binning into tiles, compositing; and their backward passes.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <functional>
#include <memory>

#include "adam.h"
#include "kernels.h"
#include "team.h"

namespace panolog {

// Memory of at least `bytes`, aligned to 64; of large pages where there is much of it: splats are read in any order.
// Throws std::bad_alloc.
void* allocate(size_t bytes);

struct Free {
  void operator()(void* memory) const { std::free(memory); }
};

// Memory whose values are all about to be written: no time is spent on zeros.
template <class T>
struct Buffer {
  std::unique_ptr<T[], Free> data;
  size_t size = 0;
  Buffer() = default;
  explicit Buffer(size_t size) : data(static_cast<T*>(allocate(size * sizeof(T)))), size(size) {}
  T& operator[](size_t i) { return data[i]; }
  const T& operator[](size_t i) const { return data[i]; }
};

// What is frozen around the Gaussians of a frame, as its camera sees it (bake.h). T tiles, A of them active.
struct Exterior {
  const Splat* splats;  // those that composite among the Gaussians
  const RaySplat* rays;
  int64_t count;
  const int32_t* places;      // T: of a tile in the layers; -1: not active, it stays empty
  const float* spans;         // T × 2: distances between which frozen splats composite in a tile
  const float *front, *back;  // A × kPlanes × kTilePixels: all others, before and behind those
};

// A frame in memory that the caller owns.
struct FrameView {
  const Splat* splats;
  const RaySplat* rays;  // null with affine projection
  const uint32_t* slots;
  Entry* entries;
  const uint32_t* tiles;
};

// Results of the forward pass that the backward pass reads.
struct Frame {
  Buffer<Splat> splats;    // N, unset where the Gaussian is not visible, and those of the exterior
  Buffer<RaySplat> rays;   // the same with exact projection; else none
  Buffer<uint32_t> slots;  // N + 1: the slots of splat i are slots[i] .. slots[i + 1], none if it is not visible
  Buffer<Entry> entries;   // by tile, nearest first within it
  Buffer<uint32_t> tiles;  // tiles + 1: a tile's entries
  FrameView view() const {
    return {splats.data.get(), rays.data.get(), slots.data.get(), entries.data.get(), tiles.data.get()};
  }
};

// Seconds that the stages of the latest passes took: for benchmarks, which run one at a time.
struct Stages {
  double project, order, composite, composite_backward, project_backward;
};
extern Stages latest;

constexpr int64_t kSpan = 1024;  // Gaussians per unit of work of a thread
constexpr int kParameters = 6;   // means, quats, scales, opacities, sh0, shN
constexpr int kParameterFloats[kParameters] = {3, 4, 3, 1, 3, 45};

// A step of Adam in a backward pass: the gradients of the parameters need no memory.
struct Step {
  Moving parameters[kParameters];
  uint32_t broken = 0;  // a bit for each of them: whether its gradient was not finite; then all are invalid
  // Returns such bits of these rows.
  uint32_t take(const GradientArrays& found, int64_t row, int64_t rows) const;
};

// Fills `frame` and state (N, of State). Throws std::length_error beyond 2³¹ tile entries.
void order(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads, const Exterior* exterior,
           Frame& frame, uint8_t* state);

// Calls visit for every tile of the image, on several threads.
void each_tile(const Camera& camera, const FrameView& frame, int threads, const Exterior* exterior,
               const std::function<void(const TileInput&)>& visit);

// As `order`, then the images. `exterior` may be null.
void rasterize(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
               const Exterior* exterior, Frame& frame, const Images& images, uint8_t* state);

// With a step the parameters move, and of the gradients only `screen`, `absolute` and `motion` are written.
void rasterize_backward(const GaussianArrays& gaussians, const Camera& camera, int sh_count, int threads,
                        const Exterior* exterior, const FrameView& frame, const Images& images,
                        const ImageGradients& image_gradients, const GradientArrays& gradients, Step* step = nullptr);

}  // namespace panolog
