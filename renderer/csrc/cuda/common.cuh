// Shared by the CUDA kernels. NVRTC compiles them for a card; the tests compile them for the host as well.
// A kernel's name begins with that of its file.
#pragma once
#include "footprint.h"
#include "rays.h"

namespace panolog {

constexpr int kTilePixels = kTile * kTile;  // one block of threads composites a tile
constexpr int kWarp = 32;
constexpr uint32_t kAllLanes = 0xffffffffu;

// Why no step of the optimiser may be taken any more, until the host has read it.
enum Status : int32_t {
  kNoRoom = 1,          // there were more pairs of splats and tiles than room
  kBrokenLoss = 2,      // it was not finite
  kBrokenGradient = 4,  // one of the first parameter was not finite; of the others the bits above
};

// Of an azimuth or an elevation. Kernels read them for every half pixel: those of centres, and of middles between them.
struct alignas(8) Angle {
  float sine, cosine;
};

// The centres of `columns` × `rows` pixels around a direction.
__device__ __forceinline__ PatchOf<float> patch_around(Angle azimuth, Angle elevation, int columns, int rows, int width,
                                                       int height) {
  return patch_at(azimuth.sine, azimuth.cosine, elevation.sine, elevation.cosine, half_azimuth(columns, width),
                  half_elevation(rows, height));
}

__device__ __forceinline__ int64_t thread_of_grid() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }

}  // namespace panolog
