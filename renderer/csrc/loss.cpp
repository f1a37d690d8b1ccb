#include "loss.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"

namespace panolog {
namespace {

struct Window {
  float weight[2 * kWindowRadius + 1];
  Window() {
    float sum = 0;
    for (int i = -kWindowRadius; i <= kWindowRadius; ++i)
      sum += weight[i + kWindowRadius] = std::exp(-i * i / (2 * 1.5f * 1.5f));
    for (float& w : weight) w /= sum;
  }
};
const Window kWindow;

// Window means of x, y, x², y², xy for every row, horizontally only.
struct Moments {
  std::vector<float> maps[5];
};

void horizontal_moments(const float* x, const float* y, int width, int height, int threads, Moments& out) {
  const int stride = 3 * width;
  for (auto& map : out.maps) map.resize(size_t(stride) * height);
#pragma omp parallel num_threads(threads)
  {
    std::vector<float> padded(stride + 6 * kWindowRadius), product(stride);
#pragma omp for schedule(static)
    for (int row = 0; row < height; ++row) {
      const int64_t at = int64_t(row) * stride;
      const float *a = x + at, *b = y + at;
      const float* pairs[5][2] = {{a, nullptr}, {b, nullptr}, {a, a}, {b, b}, {a, b}};
      for (int m = 0; m < 5; ++m) {
        const float *p = pairs[m][0], *q = pairs[m][1];
        if (q)
          for (int i = 0; i < stride; ++i) product[i] = p[i] * q[i];
        kernels().blur_row(q ? product.data() : p, width, kWindow.weight, padded.data(), out.maps[m].data() + at);
      }
    }
  }
}

// Buffers of one thread: the finished window means of one row, SSIM and its three derivatives.
struct RowBuffers {
  std::vector<float> storage;
  RowMoments moments;
  float *value, *by[3], *padded;
  explicit RowBuffers(int stride) : storage(size_t(stride) * 10 + 6 * kWindowRadius) {
    float* next = storage.data();
    for (float*& map : moments.maps) map = next, next += stride;
    value = next, next += stride;
    for (float*& map : by) map = next, next += stride;
    padded = next;
  }
  void compute(const Moments& all, int row, int stride, int height) {
    for (int m = 0; m < 5; ++m)
      kernels().blur_columns(all.maps[m].data(), row, stride, height, kWindow.weight, moments.maps[m]);
    kernels().ssim_row(moments, stride, value, by[0], by[1], by[2]);
  }
};

double sum_in_order(const std::vector<double>& parts) {
  double total = 0;
  for (double part : parts) total += part;
  return total;
}

}  // namespace

void ssim_map(const float* a, const float* b, int width, int height, int threads, float* out) {
  const int stride = 3 * width;
  Moments moments;
  horizontal_moments(a, b, width, height, threads, moments);
#pragma omp parallel num_threads(threads)
  {
    RowBuffers line(stride);
#pragma omp for schedule(static)
    for (int row = 0; row < height; ++row) {
      line.compute(moments, row, stride, height);
      for (int i = 0; i < width; ++i)
        out[int64_t(row) * width + i] = (line.value[3 * i] + line.value[3 * i + 1] + line.value[3 * i + 2]) / 3;
    }
  }
}

LossSums photometric(const float* color, const uint8_t* target, const uint8_t* mask, int width, int height,
                     float lambda_ssim, int threads, float* gradient) {
  const int stride = 3 * width;
  const size_t samples = size_t(stride) * height;
  std::vector<float> x(samples), y(samples);
  std::vector<double> l1(height), squared(height), ssim(height), used(height);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int row = 0; row < height; ++row)
    for (int i = 0; i < stride; ++i) {
      const int64_t at = int64_t(row) * stride + i;
      const bool on = !mask || mask[at / 3];
      y[at] = target[at] / 255.0f;
      x[at] = on ? color[at] : y[at];
      const float difference = x[at] - y[at];
      l1[row] += std::fabs(difference), squared[row] += difference * difference, used[row] += on;
    }
  const double count = std::max(1.0, sum_in_order(used));
  Moments moments;
  horizontal_moments(x.data(), y.data(), width, height, threads, moments);

  // the derivatives by the window means, then each spread back over its window
  std::vector<float> by[3];
  for (auto& map : by) map.resize(samples);
  const float scale = float(-lambda_ssim / count);
#pragma omp parallel num_threads(threads)
  {
    RowBuffers line(stride);
#pragma omp for schedule(static)
    for (int row = 0; row < height; ++row) {
      const int64_t at = int64_t(row) * stride;
      line.compute(moments, row, stride, height);
      float sum = 0;
      for (int i = 0; i < stride; ++i) {
        const float on = !mask || mask[(at + i) / 3] ? 1.0f : 0.0f;
        sum += on * line.value[i];
        for (float* part : line.by) part[i] *= on * scale;
      }
      ssim[row] = sum;
      for (int m = 0; m < 3; ++m)
        kernels().blur_row(line.by[m], width, kWindow.weight, line.padded, by[m].data() + at);
    }
#pragma omp for schedule(static)
    for (int row = 0; row < height; ++row) {
      const int64_t at = int64_t(row) * stride;
      for (int m = 0; m < 3; ++m)
        kernels().blur_columns(by[m].data(), row, stride, height, kWindow.weight, line.by[m]);
      for (int i = 0; i < stride; ++i) {
        const float a = x[at + i], b = y[at + i];
        const float sign = a > b ? 1.0f : a < b ? -1.0f : 0.0f;
        const float value = line.by[0][i] + 2 * a * line.by[1][i] + b * line.by[2][i] +
                            float((1 - lambda_ssim) / count) * sign;
        gradient[at + i] = !mask || mask[(at + i) / 3] ? value : 0.0f;
      }
    }
  }
  return {sum_in_order(l1) / count, sum_in_order(ssim) / count, sum_in_order(squared) / count};
}

double absolute_difference(const float* rendered, const float* target, const uint8_t* valid, int64_t pixels,
                           int threads, float* gradient) {
  constexpr int64_t kPart = 4096;
  const int64_t parts = (pixels + kPart - 1) / kPart;
  std::vector<double> sums(parts), used(parts);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t part = 0; part < parts; ++part)
    for (int64_t i = part * kPart; i < std::min(pixels, (part + 1) * kPart); ++i) {
      const float difference = valid[i] ? rendered[i] - target[i] : 0.0f;
      gradient[i] = difference > 0 ? 1.0f : difference < 0 ? -1.0f : 0.0f;
      sums[part] += std::fabs(difference), used[part] += valid[i] != 0;
    }
  const double count = std::max(1.0, sum_in_order(used));
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t i = 0; i < pixels; ++i) gradient[i] = float(gradient[i] / count);
  return sum_in_order(sums) / count;
}

}  // namespace panolog
