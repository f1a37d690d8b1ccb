// Photometric and depth losses with their gradients. Blocks of 16 × 16 pixels or of 256 samples.
// Sums: in single precision over the few samples of a warp, in double over the warps of a block; one partial for each
// block, added by the caller in a fixed order.
// Of each window the samples are written before its first barrier and read before its second, the horizontal sums
// written between the two and read after. No thread therefore still reads what the next window overwrites.
#include "common.cuh"
#include "exposure.h"

namespace panolog {
namespace {

constexpr int kRadius = 5;  // of the SSIM window, as on the CPU
constexpr int kTaps = 2 * kRadius + 1;
constexpr int kSide = kTile + 2 * kRadius;
constexpr int kHalo = kSide * kSide, kLine = kSide * kTile;
constexpr int kTurns = (kHalo + kTilePixels - 1) / kTilePixels;  // of a block's threads through a halo
constexpr int kWarps = kTilePixels / kWarp;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // Wang et al. 2004, for samples in [0, 1]
constexpr int kNormal = 5;                                 // ExposureSums in kernels.h

struct Images {  // (H, W, 3), (H, W, 3), (H, W) or null, (2, 3) or null
  const float* color;
  const uint8_t *target, *mask;
  const float* exposure;
  int width, height;
};

struct ImagePair {  // one sample of the rendering, as it is exposed, and of the target; dx / dcolour
  float x, y, slope;
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
  int column = int(blockIdx.x) * kTile - kRadius + i % kSide;
  while (column < 0) column += width;  // at most once, unless the image is narrower than the halo
  while (column >= width) column -= width;
  return row < 0 || row >= height ? -1 : int64_t(row) * width + column;
}

// The pixel of this thread, -1 outside the image.
__device__ __forceinline__ int64_t own_pixel(int width, int height) {
  const int column = int(blockIdx.x) * kTile + int(threadIdx.x) % kTile;
  const int row = int(blockIdx.y) * kTile + int(threadIdx.x) / kTile;
  return column < width && row < height ? int64_t(row) * width + column : -1;
}

__device__ __forceinline__ bool masked(const Images& in, int64_t pixel) { return in.mask && !in.mask[pixel]; }

// Where masked both images are black, and windows are normalised without them.
__device__ __forceinline__ ImagePair sample(const Images& in, int64_t pixel, int channel) {
  if (masked(in, pixel)) return {0, 0, 0};
  const float byte = in.target[3 * pixel + channel], quotient = byte * (1 / 255.0f);
  const float y = fmaf(fmaf(-255.0f, quotient, byte), 1 / 255.0f, quotient);  // byte / 255, rounded likewise
  const float color = in.color[3 * pixel + channel];
  if (!in.exposure) return {color, y, 1};
  const float factor = in.exposure[channel], summand = in.exposure[3 + channel], value = factor * color + summand;
  const float x = y >= 1 ? below_white(value, factor + summand) : value;
  const bool beyond = (y >= 1 && x == 1) || (y <= 0 && x < 0);
  return {beyond ? y : x, y, beyond ? 0.0f : factor};
}

// What a sample that counts adds to the normal equations of the exposure.
__device__ __forceinline__ void add_normal(const Images& in, int64_t pixel, int channel, float row, float* sums) {
  const ImagePair sample_of = sample(in, pixel, channel);
  const float r = sample_of.x - sample_of.y, size = fabsf(r), s = in.color[3 * pixel + channel] + kToe;
  const float usual = size > kHuber ? kHuber / size : 1.0f;
  const float w = sample_of.slope == 0 || sample_of.y >= 1 ? 0.0f : row * usual;
  sums[0] += w, sums[1] += w * s, sums[2] += w * s * s, sums[3] += w * r, sums[4] += w * s * r;
}

// The window's horizontal part for the rows of the halo.
__device__ __forceinline__ void row_means(const float* halo, float* lines) {
  for (int i = int(threadIdx.x); i < kLine; i += kTilePixels) {
    const float* const first = halo + i / kTile * kSide + i % kTile;
    float sum = 0;
#pragma unroll
    for (int k = 0; k < kTaps; ++k) sum += window(k) * first[k];
    lines[i] = sum;
  }
}

// What the pixel's row counts in the loss; 1 without weights (H,). Pixels outside, -1, are given that of row 0.
__device__ __forceinline__ float row_weight(const float* rows, int64_t pixel, int width) {
  return rows ? rows[pixel / width] : 1.0f;
}

// The window's vertical part at this thread's pixel.
__device__ __forceinline__ float column_mean(const float* lines) {
  const float* top = lines + threadIdx.x;
  float sum = 0;
#pragma unroll
  for (int k = 0; k < kTaps; ++k) sum += window(k) * top[k * kTile];
  return sum;
}

// 1 / the weight of what is not masked of the window around this thread's pixel, 0 where the pixel is masked. The whole
// block takes part.
__device__ __forceinline__ float rest_of_window(const Images& in, int64_t pixel, float* halo, float* lines) {
  for (int i = int(threadIdx.x); i < kHalo; i += kTilePixels) {
    const int64_t at = halo_pixel(i, in.width, in.height);
    halo[i] = at >= 0 && masked(in, at) ? 1.0f : 0.0f;
  }
  __syncthreads();
  row_means(halo, lines);
  __syncthreads();
  return pixel >= 0 && !masked(in, pixel) ? 1 / (1 - column_mean(lines)) : 0.0f;
}

// Writes the sums over a block of 256 threads. Nothing else may use `warps`.
template <int kCount>
__device__ __forceinline__ void write_sums(float (&values)[kCount], float (&warps)[kCount][kWarps], double* to) {
  for (int m = 0; m < kCount; ++m)
    for (int step = kWarp / 2; step; step /= 2) values[m] += __shfl_down_sync(kAllLanes, values[m], step);
  if (threadIdx.x % kWarp == 0)
    for (int m = 0; m < kCount; ++m) warps[m][threadIdx.x / kWarp] = values[m];
  __syncthreads();
  if (threadIdx.x >= kCount) return;
  double total = 0;
  for (int warp = 0; warp < kWarps; ++warp) total += warps[threadIdx.x][warp];
  to[threadIdx.x] = total;
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
// rows: (H,) weights of the rows in the first two, or null; count: () how many samples the loss is a mean of.
// exposure: (2, 3) factors and summands of the colours, or null; normal: per block the sums for it (3, kNormal), or
// null.
extern "C" __global__ void __launch_bounds__(256)
    loss_similarity(const float* color, const uint8_t* target, const uint8_t* mask, const float* rows,
                    const float* exposure, int64_t width, int64_t height, float lambda_ssim, const double* count,
                    float* by, double* partials, double* normal) {
  using namespace panolog;
  __shared__ float x[kHalo], y[kHalo], lines[5][kLine];
  __shared__ float warps[3][kWarps], normal_warps[3 * kNormal][kWarps];
  const Images in = {color, target, mask, exposure, int(width), int(height)};
  const int64_t pixel = own_pixel(in.width, in.height), samples = 3 * width * height;
  const float row = row_weight(rows, pixel, in.width), weight = -lambda_ssim / float(*count) * row;
  const bool used = pixel >= 0 && !masked(in, pixel);
  const float rest = mask ? rest_of_window(in, pixel, x, lines[0]) : 1.0f;
  const int own = (int(threadIdx.x) / kTile + kRadius) * kSide + int(threadIdx.x) % kTile + kRadius;
  float totals[3] = {0, 0, 0};  // of |x - y|, SSIM, (x - y)²
  for (int channel = 0; channel < 3; ++channel) {
    for (int i = int(threadIdx.x); i < kHalo; i += kTilePixels) {
      const int64_t at = halo_pixel(i, in.width, in.height);
      const ImagePair s = at < 0 ? ImagePair{0, 0, 0} : sample(in, at, channel);
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
    const float difference = x[own] - y[own];  // 0 where masked
    __syncthreads();
    if (pixel < 0) continue;
    float means[5];
    for (int m = 0; m < 5; ++m) {
      means[m] = column_mean(lines[m]);
      if (mask) means[m] *= rest;
    }
    Similarity found = similarity(means[0], means[1], means[2], means[3], means[4]);
    if (!used) found = {0, 0, 0, 0};
    totals[0] += row * fabsf(difference), totals[1] += row * found.value, totals[2] += difference * difference;
    float* const out = by + 3 * pixel + channel;
    const float factor = weight * rest;
    out[0] = factor * found.by_x, out[samples] = factor * found.by_xx, out[2 * samples] = factor * found.by_xy;
  }
  const int64_t block = blockIdx.y * int64_t(gridDim.x) + blockIdx.x;
  write_sums(totals, warps, partials + 3 * block);
  if (!normal) return;
  float sums[3 * kNormal] = {};
  if (used)
    for (int channel = 0; channel < 3; ++channel) add_normal(in, pixel, channel, row, sums + channel * kNormal);
  write_sums(sums, normal_warps, normal + 3 * kNormal * block);
}

// The loss's gradient (H, W, 3) from the derivatives `by`, spread over their windows, and the L1 part.
extern "C" __global__ void __launch_bounds__(256)
    loss_gradient(const float* color, const uint8_t* target, const uint8_t* mask, const float* rows,
                  const float* exposure, int64_t width, int64_t height, float lambda_ssim, const double* count,
                  const float* by, float* gradient) {
  using namespace panolog;
  __shared__ float halo[kHalo], lines[kLine];
  const Images in = {color, target, mask, exposure, int(width), int(height)};
  const int64_t pixel = own_pixel(in.width, in.height), samples = 3 * width * height;
  const float weight = (1 - lambda_ssim) / float(*count) * row_weight(rows, pixel, in.width);
  int64_t brought[kTurns];  // the pixels of the halo that this thread brings, in all nine windows
#pragma unroll
  for (int turn = 0; turn < kTurns; ++turn)
    brought[turn] = halo_pixel(int(threadIdx.x) + turn * kTilePixels, in.width, in.height);
  for (int channel = 0; channel < 3; ++channel) {
    float spread[3];
    for (int m = 0; m < 3; ++m) {
      const float* const plane = by + m * samples + channel;
#pragma unroll
      for (int turn = 0; turn < kTurns; ++turn)
        if (const int i = int(threadIdx.x) + turn * kTilePixels; i < kHalo)
          halo[i] = brought[turn] < 0 ? 0.0f : plane[3 * brought[turn]];
      __syncthreads();
      row_means(halo, lines);
      __syncthreads();
      spread[m] = column_mean(lines);
    }
    if (pixel < 0) continue;
    const ImagePair s = sample(in, pixel, channel);
    const float sign = s.x > s.y ? weight : s.x < s.y ? -weight : 0.0f;
    const float sum = spread[0] + 2 * s.x * spread[1] + s.y * spread[2] + sign;
    gradient[3 * pixel + channel] = masked(in, pixel) ? 0.0f : s.slope * sum;
  }
}

// The gradient of mean |rendered - target| over valid pixels, and per block the sum of |rendered - target|.
extern "C" __global__ void __launch_bounds__(256)
    loss_absolute(const float* rendered, const float* target, const uint8_t* valid, int64_t pixels, const double* count,
                  float* gradient, double* partials) {
  using namespace panolog;
  __shared__ float warps[1][kWarps];
  const int64_t i = thread_of_grid();
  const float weight = 1 / float(*count);
  const float difference = i < pixels && valid[i] ? rendered[i] - target[i] : 0.0f;
  if (i < pixels) gradient[i] = difference > 0 ? weight : difference < 0 ? -weight : 0.0f;
  float sum[1] = {fabsf(difference)};
  write_sums(sum, warps, partials + blockIdx.x);
}
