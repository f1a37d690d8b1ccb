#include "loss.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "team.h"

namespace panolog {
namespace {

constexpr int kTaps = 2 * kWindowRadius + 1;
constexpr int kBand = 128;  // rows, about

struct Window {
  float weight[kTaps];
  Window() {
    float sum = 0;
    for (int i = 0; i < kTaps; ++i)
      sum += weight[i] = std::exp(-(i - kWindowRadius) * (i - kWindowRadius) / (2 * 1.5f * 1.5f));
    for (float& w : weight) w /= sum;
  }
};
const Window kWindow;

struct Columns {  // of pixels
  int begin, end;
};
using Runs = std::vector<Columns>;

// Which columns of each row are computed: in cells of sixteen, so that sums have one order.
class Cover {
 public:
  Cover(const uint8_t* mask, int width, int height) : whole_{{0, width}} {
    if (!mask) return;
    const int cells = (width + kCell - 1) / kCell;
    std::vector<Cells> counting(height, Cells(cells, 0));
    for (int r = 0; r < height; ++r)
      for (int i = 0; i < width; ++i) counting[r][i / kCell] |= mask[int64_t(r) * width + i];
    for (int r = 0; r < height; ++r) {
      Cells near(cells, 0), around(cells, 0);
      for (int k = std::max(0, r - kWindowRadius); k <= std::min(height - 1, r + kWindowRadius); ++k)
        for (int i = 0; i < cells; ++i) near[i] |= counting[k][i];
      for (int i = 0; i < cells; ++i) around[i] = near[i] | near[(i + 1) % cells] | near[(i + cells - 1) % cells];
      if (width % kCell) around[0] |= near[std::max(0, cells - 2)], around[std::max(0, cells - 2)] |= near[0];
      counting_.push_back(runs_of(counting[r], width)), near_.push_back(runs_of(near, width));
      around_.push_back(runs_of(around, width));
    }
  }
  const Runs& counting(int r) const { return counting_.empty() ? whole_ : counting_[r]; }  // have pixels that count
  const Runs& near(int r) const { return near_.empty() ? whole_ : near_[r]; }        // or rows within a radius have
  const Runs& around(int r) const { return around_.empty() ? whole_ : around_[r]; }  // and within a radius of those

 private:
  static constexpr int kCell = 16;
  using Cells = std::vector<uint8_t>;
  static Runs runs_of(const Cells& cells, int width) {
    Runs out;
    for (int i = 0; i < int(cells.size()); ++i) {
      if (!cells[i]) continue;
      const int begin = i * kCell, end = std::min(width, begin + kCell);
      if (!out.empty() && out.back().end == begin)
        out.back().end = end;
      else
        out.push_back({begin, end});
    }
    return out;
  }
  Runs whole_;
  std::vector<Runs> counting_, near_, around_;  // of each row; none without a mask
};

// A ring buffer of the last eleven rows, for the vertical window; row r is stored at index r % 11.
struct Ring {
  int stride;
  std::vector<float> storage;
  explicit Ring(int stride) : stride(stride), storage(size_t(stride) * kTaps) {}
  float* row(int r) { return storage.data() + size_t(r % kTaps) * stride; }
  // the vertical window around row r of an image with `height` rows, zero beyond them
  void blur(int r, int height, const Runs& runs, float* out) {
    const int first = std::max(0, r - kWindowRadius), last = std::min(height - 1, r + kWindowRadius);
    for (const auto& [begin, end] : runs) {
      const float* rows[kTaps];
      for (int i = first; i <= last; ++i) rows[i - first] = row(i) + 3 * begin;
      kernels().weighted_sum(rows, kWindow.weight + (first - r + kWindowRadius), last - first + 1, 3 * (end - begin),
                             out + 3 * begin);
    }
  }
};

// SSIM of two images, row after row in memory of a few rows: feed(r) in order, then compute(r - radius). With a mask,
// samples are 0 where it is, and the means are those of the rest of the window. `counts`: the mask, for each sample.
class SsimRows {
 public:
  SsimRows(int width, int height, const Cover& cover, bool masked)
      : width_(width),
        height_(height),
        cover_(cover),
        rings_(masked ? 6 : 5, Ring(3 * width)),
        storage_(size_t(width) * 36 + 6 * kWindowRadius) {
    float* next = storage_.data();
    for (float** line : {&value, &by[0], &by[1], &by[2], &rest_}) *line = next, next += 3 * width;
    for (float*& line : means_) line = next, next += 3 * width;
    product_ = next, padded = next + 3 * width;
  }
  // row r of the two images, 3 · width samples each
  void feed(int r, const float* x, const float* y, const uint8_t* counts) {
    const float* factors[5][2] = {{x, nullptr}, {y, nullptr}, {x, x}, {y, y}, {x, y}};
    for (int m = 0; m < 5; ++m) {
      const float *a = factors[m][0], *b = factors[m][1];
      if (b)
        for (const auto& [begin, end] : cover_.around(r))
          for (int i = 3 * begin; i < 3 * end; ++i) product_[i] = a[i] * b[i];
      blur(r, b ? product_ : a, rings_[m].row(r));
    }
    if (!counts) return;
    for (const auto& [begin, end] : cover_.around(r))
      for (int i = 3 * begin; i < 3 * end; ++i) product_[i] = counts[i] ? 0.0f : 1.0f;
    blur(r, product_, rings_[5].row(r));
  }
  // fills value and by for row r, once the rows up to r + radius are fed
  void compute(int r, const uint8_t* counts, float weight, RowSums& sums) {
    const Runs& runs = cover_.counting(r);
    for (int m = 0; m < 5; ++m) rings_[m].blur(r, height_, runs, means_[m]);
    if (counts) {
      for (float* derivative : by)
        for (const auto& [begin, end] : cover_.around(r)) std::fill(derivative + 3 * begin, derivative + 3 * end, 0.0f);
      rings_[5].blur(r, height_, runs, rest_);
      for (const auto& [begin, end] : runs)
        for (int i = 3 * begin; i < 3 * end; ++i) rest_[i] = counts[i] ? 1 / (1 - rest_[i]) : 0.0f;
      for (float* mean : means_) multiply(runs, mean);
    }
    for (const auto& [begin, end] : runs)
      kernels().ssim_row(means_, counts ? counts + 3 * begin : nullptr, 3 * begin, 3 * (end - begin), weight, value, by,
                         sums);
    if (counts)
      for (float* derivative : by) multiply(runs, derivative);
  }
  // the horizontal window over row r
  void blur(int r, const float* row, float* out) {
    for (const auto& [begin, end] : cover_.near(r))
      kernels().blur_row(row, width_, begin, end, kWindow.weight, padded, out);
  }
  float *value, *by[3], *padded;

 private:
  void multiply(const Runs& runs, float* __restrict row) {
    for (const auto& [begin, end] : runs)
      for (int i = 3 * begin; i < 3 * end; ++i) row[i] *= rest_[i];
  }
  int width_, height_;
  const Cover& cover_;
  std::vector<Ring> rings_;
  std::vector<float> storage_;
  float *means_[5], *product_, *rest_;  // rest_: 1 / the weight of a window that is not masked
};

// Calls visit(begin, end) in parallel for bands of rows: at least as many as threads, and few, because the windows
// of a band reach into its neighbours.
template <class Visit>
void each_band(int height, int threads, Visit visit) {
  const int64_t bands = int64_t(threads) * (threads == 1 ? 1 : std::max(1, height / (threads * kBand)));
  share(bands, threads, [&](int64_t band) { visit(int(height * band / bands), int(height * (band + 1) / bands)); });
}

double sum_in_order(const std::vector<double>& parts) {
  double total = 0;
  for (double part : parts) total += part;
  return total;
}

}  // namespace

void ssim_map(const float* a, const float* b, int width, int height, int threads, float* out) {
  const Cover cover(nullptr, width, height);
  each_band(height, threads, [&](int begin, int end) {
    SsimRows rows(width, height, cover, false);
    for (int r = std::max(0, begin - kWindowRadius); r < end + kWindowRadius; ++r) {
      const int64_t at = int64_t(r) * 3 * width;
      if (r < height) rows.feed(r, a + at, b + at, nullptr);
      const int ready = r - kWindowRadius;
      if (ready < begin) continue;
      RowSums sums;
      rows.compute(ready, nullptr, 1, sums);
      for (int i = 0; i < width; ++i)
        out[int64_t(ready) * width + i] = (rows.value[3 * i] + rows.value[3 * i + 1] + rows.value[3 * i + 2]) / 3;
    }
  });
}

namespace {

float total(float rest, const float parts[RowSums::kParts]) {
  for (int i = 0; i < RowSums::kParts; ++i) rest += parts[i];
  return rest;
}

struct Problem {
  const float* color;
  const uint8_t *target, *counts;  // counts: for each sample; null: all do
  const float* rows;
  int width, height;
  float l1_weight, ssim_weight;  // of one sample
  Exposure exposure;
  float weight_of(int row) const { return rows ? rows[row] : 1.0f; }
};

constexpr int kNormal = 3 * ExposureSums::kSums;

struct RowTotals {
  std::vector<double> l1, squared, ssim;
  std::vector<double> normal;  // kNormal of each row, channel by channel
};

void add_normal(const ExposureSums& sums, double weight, double* to) {
  for (int part = 0; part < ExposureSums::kParts; ++part)
    for (int m = 0; m < ExposureSums::kSums; ++m)
      to[part % 3 * ExposureSums::kSums + m] += weight * sums.parts[m][part];
}

// Rows [begin, end) of the gradient and of the totals, in one sweep: samples → window means → SSIM and its
// derivatives → their windows → gradient. Each step runs a window's radius behind the one before. The gradient is
// written where the cover counts.
void photometric_rows(const Problem& p, const Cover& cover, int begin, int end, RowTotals& totals, float* gradient) {
  const int stride = 3 * p.width;
  SsimRows ssim(p.width, p.height, cover, p.counts != nullptr);
  const bool exposes = p.exposure.affine != nullptr;
  Ring spread[3] = {Ring(stride), Ring(stride), Ring(stride)}, x(stride), y(stride), slope(exposes ? stride : 0);
  std::vector<float> storage(size_t(stride) * 4);
  float* const lines[3] = {storage.data(), storage.data() + stride, storage.data() + 2 * stride};
  float* const exposed = storage.data() + 3 * stride;
  const auto counts_of = [&](int r, int at) { return p.counts ? p.counts + int64_t(r) * stride + at : nullptr; };
  for (int r = std::max(0, begin - 2 * kWindowRadius); r < end + 2 * kWindowRadius; ++r) {
    if (r < p.height) {
      RowSums sums;
      ExposureSums exposure_sums;
      for (const auto& [first, last] : cover.around(r)) {
        const int at = 3 * first, count = 3 * (last - first);
        const int64_t from = int64_t(r) * stride + at;
        const float* color = p.color + from;
        if (exposes) {
          kernels().exposed_row(color, p.target + from, counts_of(r, at), count, p.exposure.affine, exposed,
                                slope.row(r) + at, exposure_sums);
          color = exposed;
        }
        kernels().samples_row(color, p.target + from, counts_of(r, at), count, x.row(r) + at, y.row(r) + at, sums);
      }
      if (r >= begin && r < end) {
        if (exposes) add_normal(exposure_sums, p.weight_of(r), totals.normal.data() + size_t(r) * kNormal);
        totals.l1[r] = double(total(sums.rest_l1, sums.l1)) * p.weight_of(r);
        totals.squared[r] = total(sums.rest_squared, sums.squared);
      }
      ssim.feed(r, x.row(r), y.row(r), counts_of(r, 0));
    }
    const int middle = r - kWindowRadius;
    if (middle >= std::max(0, begin - kWindowRadius) && middle < p.height) {
      const float row = p.weight_of(middle);
      RowSums sums;
      ssim.compute(middle, counts_of(middle, 0), p.ssim_weight * row, sums);
      if (middle >= begin && middle < end) totals.ssim[middle] = double(total(sums.rest_ssim, sums.ssim)) * row;
      for (int m = 0; m < 3; ++m) ssim.blur(middle, ssim.by[m], spread[m].row(middle));
    }
    const int done = r - 2 * kWindowRadius;
    if (done < begin) continue;
    for (int m = 0; m < 3; ++m) spread[m].blur(done, p.height, cover.counting(done), lines[m]);
    for (const auto& [first, last] : cover.counting(done)) {
      const int at = 3 * first;
      const float* const by[3] = {lines[0] + at, lines[1] + at, lines[2] + at};
      kernels().gradient_row(by, x.row(done) + at, y.row(done) + at, counts_of(done, at), 3 * (last - first),
                             p.l1_weight * p.weight_of(done), gradient + int64_t(done) * stride + at);
      if (!exposes) continue;
      const float* const by_color = slope.row(done) + at;
      float* const out = gradient + int64_t(done) * stride + at;
      for (int i = 0; i < 3 * (last - first); ++i) out[i] *= by_color[i];
    }
  }
}

// The part of a masked image that has all pixels that count, with a margin of a window around them: pixels beyond it
// change nothing. Columns go around the cylinder.
struct Crop {
  int left, top, width, height;
};

Crop crop_of(const uint8_t* mask, int width, int height) {
  std::vector<uint8_t> used(width, 0);
  int top = height, bottom = 0;
  for (int r = 0; r < height; ++r) {
    const uint8_t* row = mask + int64_t(r) * width;
    uint8_t any = 0;
    for (int i = 0; i < width; ++i) used[i] |= row[i], any |= row[i];
    if (any) top = std::min(top, r), bottom = r + 1;
  }
  if (bottom == 0) return {0, 0, 0, 0};
  int gap = 0, end = 0;  // the longest run of columns that do not count, and where it ends
  for (int i = 0, run = 0; i < 2 * width; ++i) {
    run = used[i % width] ? 0 : run + 1;
    if (run > gap) gap = run, end = i + 1;
  }
  top = std::max(0, top - kWindowRadius), bottom = std::min(height, bottom + kWindowRadius);
  if (gap <= 2 * kWindowRadius) return {0, top, width, bottom - top};
  return {(end - kWindowRadius) % width, top, width - gap + 2 * kWindowRadius, bottom - top};
}

// Calls visit(first pixel in the image, first pixel in the crop, how many) for all runs of pixels of a crop.
template <class Visit>
void each_run(const Crop& crop, int width, Visit visit) {
  const int before = std::min(crop.width, width - crop.left);  // the seam
  for (int r = 0; r < crop.height; ++r) {
    const int64_t row = int64_t(crop.top + r) * width, at = int64_t(r) * crop.width;
    visit(row + crop.left, at, before);
    if (before < crop.width) visit(row, at + before, crop.width - before);
  }
}

std::vector<uint8_t> for_each_sample(const uint8_t* mask, int64_t pixels) {
  std::vector<uint8_t> out(3 * pixels);
  for (int64_t i = 0; i < pixels; ++i) out[3 * i] = out[3 * i + 1] = out[3 * i + 2] = mask[i];
  return out;
}

// The gradient is 0 where the mask is and need not be written there.
LossSums photometric_sums(Problem problem, const uint8_t* mask, double count, int threads, float* gradient) {
  const Cover cover(mask, problem.width, problem.height);
  std::vector<uint8_t> counts;
  if (mask) counts = for_each_sample(mask, int64_t(problem.width) * problem.height), problem.counts = counts.data();
  RowTotals totals;
  for (auto* total : {&totals.l1, &totals.squared, &totals.ssim}) total->resize(problem.height);
  if (problem.exposure.affine) totals.normal.resize(size_t(problem.height) * kNormal);
  each_band(problem.height, threads,
            [&](int begin, int end) { photometric_rows(problem, cover, begin, end, totals, gradient); });
  if (problem.exposure.affine) {
    std::fill_n(problem.exposure.normal, kNormal, 0.0);
    for (size_t i = 0; i < totals.normal.size(); ++i) problem.exposure.normal[i % kNormal] += totals.normal[i];
  }
  return {sum_in_order(totals.l1) / count, sum_in_order(totals.ssim) / count, sum_in_order(totals.squared) / count};
}

}  // namespace

LossSums photometric(const float* color, const uint8_t* target, const uint8_t* mask, const float* rows, int width,
                     int height, float lambda_ssim, const Exposure& exposure, int threads, float* gradient) {
  const int64_t pixels = int64_t(width) * height;
  const int64_t used = mask ? pixels - std::count(mask, mask + pixels, uint8_t(0)) : pixels;
  const double count = std::max(1.0, 3.0 * used);
  const float l1_weight = float((1 - lambda_ssim) / count), ssim_weight = float(-lambda_ssim / count);
  Problem problem = {color, target, nullptr, rows, width, height, l1_weight, ssim_weight, exposure};
  if (mask) std::fill_n(gradient, 3 * pixels, 0.0f);
  const Crop crop = mask ? crop_of(mask, width, height) : Crop{0, 0, width, height};
  if (crop.width == width && crop.height == height) return photometric_sums(problem, mask, count, threads, gradient);
  const size_t size = size_t(crop.width) * crop.height;
  std::vector<float> part_color(3 * size), part_gradient(3 * size);
  std::vector<uint8_t> part_target(3 * size), part_mask(size);
  each_run(crop, width, [&](int64_t from, int64_t to, int length) {
    std::copy_n(color + 3 * from, 3 * length, part_color.data() + 3 * to);
    std::copy_n(target + 3 * from, 3 * length, part_target.data() + 3 * to);
    std::copy_n(mask + from, length, part_mask.data() + to);
  });
  problem.color = part_color.data(), problem.target = part_target.data();
  problem.rows = rows ? rows + crop.top : nullptr, problem.width = crop.width, problem.height = crop.height;
  const LossSums sums = photometric_sums(problem, part_mask.data(), count, threads, part_gradient.data());
  each_run(crop, width, [&](int64_t to, int64_t from, int length) {
    std::copy_n(part_gradient.data() + 3 * from, 3 * length, gradient + 3 * to);
  });
  return sums;
}

double absolute_difference(const float* rendered, const float* target, const uint8_t* valid, int64_t pixels,
                           int threads, float* gradient) {
  constexpr int64_t kPart = 4096;
  const int64_t parts = (pixels + kPart - 1) / kPart;
  std::vector<double> sums(parts);
  const double count = std::max(1.0, double(pixels - std::count(valid, valid + pixels, uint8_t(0))));
  const float weight = float(1 / count);
  share(parts, threads, [&](int64_t part) {
    for (int64_t i = part * kPart; i < std::min(pixels, (part + 1) * kPart); ++i) {
      const float difference = valid[i] ? rendered[i] - target[i] : 0.0f;
      gradient[i] = difference > 0 ? weight : difference < 0 ? -weight : 0.0f;
      sums[part] += std::fabs(difference);
    }
  });
  return sum_in_order(sums) / count;
}

}  // namespace panolog
