// Photometric and depth losses with their gradients. Sums: a tree over each block in double precision, one partial
// for each block, added by the caller in a fixed order. Blocks of 16 × 16 pixels or of 256 samples.
#include "common.cuh"

namespace panolog {
namespace {

constexpr int kRadius = 5;  // of the SSIM window, as on the CPU
constexpr int kTaps = 2 * kRadius + 1;
constexpr int kSide = kTile + 2 * kRadius;
constexpr int kHalo = kSide * kSide, kLine = kSide * kTile;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // Wang et al. 2004, for samples in [0, 1]

struct Images {  // (H, W, 3), (H, W, 3), (H, W) or null
  const float* color;
  const uint8_t *target, *mask;
  int width, height;
};

struct ImagePair {  // one sample of the rendering and of the target
  float x, y;
};

// σ = 1.5, normalised
__device__ __forceinline__ float window(int tap) {
  constexpr float weights[kRadius + 1] = {0.00102838008f, 0.00759875814f, 0.0360007721f,
                                          0.10936069f,    0.213005538f,   0.266011725f};
  return weights[tap <= kRadius ? tap : kTaps - 1 - tap];
}

// A pixel around the block's tile, periodic in x; -1 beyond the poles. `i` runs over the rows of the halo.
__device__ __forceinline__ int64_t halo_pixel(int i, int width, int height) {
  const int row = int(blockIdx.y) * kTile - kRadius + i / kSide;
  const int column = (int(blockIdx.x) * kTile - kRadius + i % kSide) % width;
  return row < 0 || row >= height ? -1 : int64_t(row) * width + (column < 0 ? column + width : column);
}

// The pixel of this thread, -1 outside the image.
__device__ __forceinline__ int64_t own_pixel(int width, int height) {
  const int column = int(blockIdx.x) * kTile + int(threadIdx.x) % kTile;
  const int row = int(blockIdx.y) * kTile + int(threadIdx.x) / kTile;
  return column < width && row < height ? int64_t(row) * width + column : -1;
}

// Where masked both images count as equal.
__device__ __forceinline__ ImagePair sample(const Images& in, int64_t pixel, int channel) {
  const float y = in.target[3 * pixel + channel] / 255.0f;
  return {in.mask && !in.mask[pixel] ? y : in.color[3 * pixel + channel], y};
}

// The window's vertical part at this thread's pixel.
__device__ __forceinline__ float column_mean(const float* lines) {
  const float* top = lines + threadIdx.x;
  float sum = 0;
#pragma unroll
  for (int k = 0; k < kTaps; ++k) sum += window(k) * top[k * kTile];
  return sum;
}

// The sum over a block of 256 threads, in thread 0.
__device__ __forceinline__ double block_sum(double value, double warps[kTilePixels / kWarp]) {
  for (int step = kWarp / 2; step; step /= 2) value += __shfl_down_sync(kAllLanes, value, step);
  __syncthreads();  // other threads may still read the previous sums
  if (threadIdx.x % kWarp == 0) warps[threadIdx.x / kWarp] = value;
  __syncthreads();
  double total = 0;
  for (int warp = 0; warp < kTilePixels / kWarp; ++warp) total += warps[warp];
  return total;
}

struct Similarity {
  float value, by_x, by_xx, by_xy;  // SSIM and its derivatives by the window means of x, x², xy
};

__device__ __forceinline__ Similarity similarity(float mx, float my, float mxx, float myy, float mxy) {
  const float a = 2 * mx * my + kC1, b = 2 * (mxy - mx * my) + kC2;
  const float c = mx * mx + my * my + kC1, d = (mxx - mx * mx) + (myy - my * my) + kC2;
  const float inverse = 1 / (c * d), value = a * b * inverse;
  return {value, 2 * my * (b - a) * inverse - 2 * mx * value * (d - c) * inverse, -value * c * inverse,
          2 * a * inverse};
}

}  // namespace
}  // namespace panolog

// Writes the derivatives `by` (3, H, W, 3) of λ(1 - SSIM), and per block the sums of |x - y|, SSIM, (x - y)².
// count: () how many samples the loss is a mean of.
extern "C" __global__ void __launch_bounds__(256)
    loss_similarity(const float* color, const uint8_t* target, const uint8_t* mask, int64_t width, int64_t height,
                    float lambda_ssim, const double* count, float* by, double* partials) {
  using namespace panolog;
  __shared__ float x[kHalo], y[kHalo], lines[5][kLine];
  __shared__ double warps[kTilePixels / kWarp];
  const Images in = {color, target, mask, int(width), int(height)};
  const int64_t pixel = own_pixel(in.width, in.height), samples = 3 * width * height;
  const float weight = float(-lambda_ssim / *count);
  double l1 = 0, ssim = 0, squared = 0;
  for (int channel = 0; channel < 3; ++channel) {
    __syncthreads();  // other threads may still read the previous channel
    for (int i = int(threadIdx.x); i < kHalo; i += kTilePixels) {
      const int64_t at = halo_pixel(i, in.width, in.height);
      const ImagePair s = at < 0 ? ImagePair{0, 0} : sample(in, at, channel);
      x[i] = s.x, y[i] = s.y;
    }
    __syncthreads();
    for (int i = int(threadIdx.x); i < kLine; i += kTilePixels) {
      const int first = i / kTile * kSide + i % kTile;
      float sums[5] = {0, 0, 0, 0, 0};
#pragma unroll
      for (int k = 0; k < kTaps; ++k) {
        const float w = window(k), p = x[first + k], q = y[first + k];
        sums[0] += w * p, sums[1] += w * q, sums[2] += w * p * p, sums[3] += w * q * q, sums[4] += w * p * q;
      }
      for (int m = 0; m < 5; ++m) lines[m][i] = sums[m];
    }
    __syncthreads();
    if (pixel < 0) continue;
    Similarity found = similarity(column_mean(lines[0]), column_mean(lines[1]), column_mean(lines[2]),
                                  column_mean(lines[3]), column_mean(lines[4]));
    if (mask && !mask[pixel]) found = {0, 0, 0, 0};
    const ImagePair s = sample(in, pixel, channel);
    l1 += fabsf(s.x - s.y), squared += (s.x - s.y) * (s.x - s.y), ssim += found.value;
    float* const out = by + 3 * pixel + channel;
    out[0] = weight * found.by_x, out[samples] = weight * found.by_xx, out[2 * samples] = weight * found.by_xy;
  }
  double* const to = partials + 3 * (blockIdx.y * int64_t(gridDim.x) + blockIdx.x);
  l1 = block_sum(l1, warps), ssim = block_sum(ssim, warps), squared = block_sum(squared, warps);
  if (threadIdx.x == 0) to[0] = l1, to[1] = ssim, to[2] = squared;
}

// The loss's gradient (H, W, 3) from the derivatives `by`, spread over their windows, and the L1 part.
extern "C" __global__ void __launch_bounds__(256)
    loss_gradient(const float* color, const uint8_t* target, const uint8_t* mask, int64_t width, int64_t height,
                  float lambda_ssim, const double* count, const float* by, float* gradient) {
  using namespace panolog;
  __shared__ float halo[kHalo], lines[kLine];
  const Images in = {color, target, mask, int(width), int(height)};
  const int64_t pixel = own_pixel(in.width, in.height), samples = 3 * width * height;
  const float weight = float((1 - lambda_ssim) / *count);
  for (int channel = 0; channel < 3; ++channel) {
    float spread[3];
    for (int m = 0; m < 3; ++m) {
      __syncthreads();  // other threads may still read the previous derivative
      for (int i = int(threadIdx.x); i < kHalo; i += kTilePixels) {
        const int64_t at = halo_pixel(i, in.width, in.height);
        halo[i] = at < 0 ? 0.0f : by[m * samples + 3 * at + channel];
      }
      __syncthreads();
      for (int i = int(threadIdx.x); i < kLine; i += kTilePixels) {
        const float* const first = halo + i / kTile * kSide + i % kTile;
        float sum = 0;
#pragma unroll
        for (int k = 0; k < kTaps; ++k) sum += window(k) * first[k];
        lines[i] = sum;
      }
      __syncthreads();
      spread[m] = column_mean(lines);
    }
    if (pixel < 0) continue;
    const ImagePair s = sample(in, pixel, channel);
    const float sign = s.x > s.y ? weight : s.x < s.y ? -weight : 0.0f;
    const float sum = spread[0] + 2 * s.x * spread[1] + s.y * spread[2] + sign;
    gradient[3 * pixel + channel] = mask && !mask[pixel] ? 0.0f : sum;
  }
}

// The gradient of mean |rendered - target| over valid pixels, and per block the sum of |rendered - target|.
extern "C" __global__ void __launch_bounds__(256)
    loss_absolute(const float* rendered, const float* target, const uint8_t* valid, int64_t pixels, const double* count,
                  float* gradient, double* partials) {
  using namespace panolog;
  __shared__ double warps[kTilePixels / kWarp];
  const int64_t i = thread_of_grid();
  const float weight = float(1 / *count);
  const float difference = i < pixels && valid[i] ? rendered[i] - target[i] : 0.0f;
  if (i < pixels) gradient[i] = difference > 0 ? weight : difference < 0 ? -weight : 0.0f;
  const double sum = block_sum(fabsf(difference), warps);
  if (threadIdx.x == 0) partials[blockIdx.x] = sum;
}
