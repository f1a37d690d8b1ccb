// Loops over ranges of Gaussians and rows of samples. Compiled once for each instruction set.
#include "exposure.h"
#include "kernels.h"

#include "rows.h"
#include "simd.h"
#include "tiles.h"

#define PANOLOG_TEXT_(x) #x
#define PANOLOG_TEXT(x) PANOLOG_TEXT_(x)

namespace panolog::PANOLOG_ISA {

void tile_forward(const TileInput&, const Images&);
void tile_backward(const TileInput&, const Images&, const ImageGradients&, SplatGradient*);
void tile_absolute_backward(const TileInput&, const Images&, const ImageGradients&, AbsoluteGradient*);
void ray_tile_forward(const TileInput&, const Images&);
void ray_tile_backward(const TileInput&, const Images&, const ImageGradients&, RayGradient*);

namespace {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // Wang et al. 2004, for samples in [0, 1]

struct Sixteen {  // Gaussians, or the gradients of as many
  F mean[3], quat[4], scale[3], opacity[1], sh0[3], shN[45], screen[2], absolute[2], motion[kMotion];
};

// Sixteen rows in turn from `out` on, which is aligned to 64 bytes, past the caches.
template <int kStride>
void stream_rows(const F* columns, float* out) {
  alignas(64) float block[kStride * kLanes];
  scatter<kStride>(columns, rows_from(0, kLanes), block);
  for (int i = 0; i < kStride * kLanes; i += kLanes) stream(out + i, load(block + i));
}

Parameters<F> parameters(const GaussianArrays& g, const Rows& rows, int sh_count, Sixteen& to) {
  fetch<3>(g.means, rows), fetch<4>(g.quats, rows), fetch<3>(g.scales, rows), fetch<3>(g.sh0, rows);
  if (sh_count > 1) fetch<45>(g.shN, rows);
  gather<3>(g.means, rows, 3, to.mean), gather<4>(g.quats, rows, 4, to.quat);
  gather<3>(g.scales, rows, 3, to.scale), gather<1>(g.opacities, rows, 1, to.opacity);
  gather<3>(g.sh0, rows, 3, to.sh0), gather<45>(g.shN, rows, 3 * (sh_count - 1), to.shN);
  return {to.mean, to.quat, to.scale, to.opacity[0], to.sh0, to.shN};
}

void write(const Sixteen& from, const Rows& rows, const GradientArrays& out) {
  const auto put = [&]<int kStride>(const F(&columns)[kStride], float* to) {
    float* const first = to + kStride * rows.first;
    if (out.streaming && rows.whole() && uintptr_t(first) % 64 == 0)
      stream_rows<kStride>(columns, first);
    else
      scatter<kStride>(columns, rows, to);
  };
  put(from.mean, out.means), put(from.quat, out.quats), put(from.scale, out.scales);
  put(from.opacity, out.opacities), put(from.sh0, out.sh0), put(from.shN, out.shN);
  if (out.screen) put(from.screen, out.screen);
  if (out.absolute) put(from.absolute, out.absolute);
}

void keep_all(Mask drawn, Sixteen& values) {
  for (F& x : values.mean) x = keep(drawn, x);
  for (F& x : values.quat) x = keep(drawn, x);
  for (F& x : values.scale) x = keep(drawn, x);
  for (F& x : values.sh0) x = keep(drawn, x);
  for (F& x : values.shN) x = keep(drawn, x);
  for (F& x : values.screen) x = keep(drawn, x);
  for (F& x : values.absolute) x = keep(drawn, x);
  values.opacity[0] = keep(drawn, values.opacity[0]);
}

// Sums of motion, apart by lanes so that the order is fixed.
struct MotionSums {
  double sums[kMotionSums][kLanes] = {};

  void add(const F motion[kMotion], int rows) {  // of the first `rows` lanes
    alignas(64) float values[kMotion][kLanes];
    for (int i = 0; i < kMotion; ++i) {
      store(values[i], motion[i]);
      for (int lane = rows; lane < kLanes; ++lane) values[i][lane] = 0;
    }
    double (*to)[kLanes] = sums + kMotion;
    for (int i = 0; i < kMotion; ++i) {
      for (int lane = 0; lane < kLanes; ++lane) sums[i][lane] += values[i][lane];
      for (int j = i; j < kMotion; ++j, ++to)
        for (int lane = 0; lane < kLanes; ++lane) (*to)[lane] += double(values[i][lane]) * values[j][lane];
    }
  }

  void add_to(double* totals) const {
    for (int k = 0; k < kMotionSums; ++k)
      for (int lane = 0; lane < kLanes; ++lane) totals[k] += sums[k][lane];
  }
};

void note_states(const Visibility<F>& seen, const Rows& rows, const SplatOf<F>& s, const Camera& camera,
                 uint8_t* state) {
  const uint32_t visible = bits(seen.visible), invalid = bits(seen.invalid);
  const Mask beyond = s.v + s.reach<0.5f, below = s.v - s.reach> F(camera.height - 0.5f);  // as above_or_below
  const uint32_t drawn = visible & ~bits(beyond | below);
  for (int lane = 0; lane < rows.count; ++lane)
    state[rows.first + lane] = drawn >> lane & 1 ? kVisible : invalid >> lane & 1 ? kInvalid : kHidden;
}

// Sixteen rows of a cache line each, past the caches: they are read when all are there.
void write_lines(const F* columns, const Rows& rows, float* to) {
  if (rows.whole())
    stream_rows<kSplatFloats>(columns, to + kSplatFloats * rows.first);
  else
    scatter<kSplatFloats>(columns, rows, to);
}

void project_span(const GaussianArrays& g, const Camera& camera, int sh_count, int64_t begin, int64_t end,
                  Splat* splats, uint8_t* state) {
  Sixteen from;
  SplatOf<F> s;
  for (int64_t at = begin; at < end; at += kLanes) {
    const Rows rows = rows_from(at, end);
    const Parameters<F> p = parameters(g, rows, sh_count, from);
    gather<2>(g.screen, rows, 2, from.screen);
    const Visibility<F> seen = project(p, camera, sh_count, from.screen, s);
    note_states(seen, rows, s, camera, state);
    write_lines(&s.u, rows, reinterpret_cast<float*>(splats));
  }
  streamed();
}

void project_rays_span(const GaussianArrays& g, const Camera& camera, int sh_count, int64_t begin, int64_t end,
                       Splat* splats, RaySplat* rays, uint8_t* state) {
  Sixteen from;
  SplatOf<F> s;
  RaySplatOf<F> ray;
  for (int64_t at = begin; at < end; at += kLanes) {
    const Rows rows = rows_from(at, end);
    const Visibility<F> seen = project_ray(parameters(g, rows, sh_count, from), camera, sh_count, s, ray);
    note_states(seen, rows, s, camera, state);
    write_lines(&s.u, rows, reinterpret_cast<float*>(splats));
    write_lines(ray.x, rows, reinterpret_cast<float*>(rays));
  }
  streamed();
}

// Of structs of floats. Most splats have one part or two: no branch depends on which.
template <class Sums>
Sums sum_of_parts(const Sums* part, int64_t count) {
  static const Sums kNone = {};
  constexpr int kFloats = sizeof(Sums) / sizeof(float);
  const Sums* const firsts[2][2] = {{&kNone, part}, {&kNone, part + 1}};
  const Sums &one = *firsts[0][count > 0], &two = *firsts[1][count > 1];
  Sums total = {};
  for (int i = 0; i < kFloats; ++i) (&total.power)[i] += (&one.power)[i];
  for (int i = 0; i < kFloats; ++i) (&total.power)[i] += (&two.power)[i];
  for (int64_t k = 2; k < count; ++k)
    for (int i = 0; i < kFloats; ++i) (&total.power)[i] += (&part[k].power)[i];
  return total;
}

template <template <class> class SumsOf>
void project_backward_span(const GaussianArrays& g, const Camera& camera, int sh_count, int64_t count,
                           const Splat* splats, const uint32_t* slots, const SumsOf<float>* parts,
                           const GradientArrays& out) {
  constexpr int kFloats = sizeof(SumsOf<float>) / sizeof(float);
  Sixteen from, to = {};  // coefficients from sh_count on stay 0
  SplatOf<F> s;
  SumsOf<F> sums;
  MotionSums motion;
  const ParameterGradients<F> gradients = {
      to.mean, to.quat, to.scale, to.opacity, to.sh0, to.shN, to.screen, to.absolute, out.motion ? to.motion : nullptr};
  for (int64_t at = 0; at < count; at += kLanes) {
    const Rows rows = rows_from(at, count);
    alignas(64) float met[kLanes];
    SumsOf<float> totals[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const int64_t row = at + (lane < rows.count ? lane : rows.count - 1);
      const uint32_t first = slots[row], last = slots[row + 1];
      totals[lane] = sum_of_parts(parts + first, last - first);
      met[lane] = float(last - first);
    }
    fetch<kSplatFloats>(reinterpret_cast<const float*>(splats), rows);
    const Mask drawn = load(met) > 0;
    if (bits(drawn)) {
      gather<kSplatFloats>(reinterpret_cast<const float*>(splats), rows, kSplatFloats, &s.u);
      gather<kFloats>(&totals[0].power, rows_from(0, kLanes), kFloats, &sums.power);
      project_backward(parameters(g, rows, sh_count, from), camera, sh_count, s, sums, gradients);
    }
    keep_all(drawn, to);
    if (out.motion && bits(drawn)) {
      for (F& x : to.motion) x = keep(drawn, x);
      motion.add(to.motion, count - at < kLanes ? int(count - at) : kLanes);
    }
    write(to, rows, out);
  }
  if (out.motion) motion.add_to(out.motion);
  streamed();
}

// Σ weights[k] · rows[k]
void weighted_sum(const float* const* rows, const float* weights, int taps, int count, float* out) {
  int at = 0;
  for (; at + 4 * kLanes <= count; at += 4 * kLanes) {  // four sums at once hide the latency of each
    F sum[4] = {set(0), set(0), set(0), set(0)};
    for (int k = 0; k < taps; ++k)
      for (int i = 0; i < 4; ++i) sum[i] = fma(set(weights[k]), load(rows[k] + at + i * kLanes), sum[i]);
    for (int i = 0; i < 4; ++i) store(out + at + i * kLanes, sum[i]);
  }
  for (; at + kLanes <= count; at += kLanes) {
    F sum = set(0);
    for (int k = 0; k < taps; ++k) sum = fma(set(weights[k]), load(rows[k] + at), sum);
    store(out + at, sum);
  }
  for (; at < count; ++at) {
    float sum = 0;
    for (int k = 0; k < taps; ++k) sum += weights[k] * rows[k][at];
    out[at] = sum;
  }
}

void blur_row(const float* row, int width, int begin, int end, const float* window, float* __restrict padded,
              float* __restrict out) {
  const int edge = 3 * kWindowRadius, count = 3 * (end - begin);
  const auto at = [&](int pixel) { return row + 3 * ((pixel % width + width) % width); };
  for (int i = 0; i < edge; ++i) {  // a panorama narrower than the window wraps more than once
    padded[i] = at(begin + i / 3 - kWindowRadius)[i % 3];
    padded[edge + count + i] = at(end + i / 3)[i % 3];
  }
  for (int i = 0; i < count; ++i) padded[edge + i] = row[3 * begin + i];
  const float* taps[2 * kWindowRadius + 1];
  for (int k = 0; k <= 2 * kWindowRadius; ++k) taps[k] = padded + 3 * k;
  weighted_sum(taps, window, 2 * kWindowRadius + 1, count, out + 3 * begin);
}

void samples_row(const float* color, const uint8_t* target, const uint8_t* counts, int count, float* __restrict x,
                 float* __restrict y, RowSums& sums) {
  for (int i = 0; i < count; ++i) x[i] = color[i], y[i] = target[i] / 255.0f;
  if (counts)
    for (int i = 0; i < count; ++i) x[i] = counts[i] ? x[i] : 0.0f, y[i] = counts[i] ? y[i] : 0.0f;
  int at = 0;
  for (; at + RowSums::kParts <= count; at += RowSums::kParts)
    for (int i = 0; i < RowSums::kParts; ++i) {
      const float difference = x[at + i] - y[at + i];
      sums.l1[i] += fabsf(difference), sums.squared[i] += difference * difference;
    }
  for (; at < count; ++at) sums.rest_l1 += fabsf(x[at] - y[at]), sums.rest_squared += (x[at] - y[at]) * (x[at] - y[at]);
}

void exposed_row(const float* color, const uint8_t* target, const uint8_t* counts, int count, const float* affine,
                 float* __restrict exposed, float* __restrict slope, ExposureSums& sums) {
  constexpr int kParts = ExposureSums::kParts;
  float factor[kParts], summand[kParts];
  for (int i = 0; i < kParts; ++i) factor[i] = affine[i % 3], summand[i] = affine[3 + i % 3];
  for (int at = 0; at < count; at += kParts) {
    const int some = count - at < kParts ? count - at : kParts;
    const auto visit = [&](int i) {
      const float y = target[at + i] / 255.0f, value = factor[i] * color[at + i] + summand[i];
      const float x = y >= 1 ? below_white(value, factor[i] + summand[i]) : value;
      const bool beyond = (y >= 1 && x == 1) || (y <= 0 && x < 0), used = !counts || counts[at + i];
      exposed[at + i] = beyond ? y : x, slope[at + i] = beyond ? 0.0f : factor[i];
      const float r = x - y, size = fabsf(r), s = color[at + i] + kToe;
      const float w = beyond || !used || y >= 1 ? 0.0f : size > kHuber ? kHuber / size : 1.0f;
      sums.parts[0][i] += w, sums.parts[1][i] += w * s, sums.parts[2][i] += w * s * s;
      sums.parts[3][i] += w * r, sums.parts[4][i] += w * s * r;
    };
    if (some == kParts) {
#pragma GCC ivdep
      for (int i = 0; i < kParts; ++i) visit(i);
    } else {
      for (int i = 0; i < some; ++i) visit(i);
    }
  }
}

void ssim_row(const float* const means[5], const uint8_t* counts, int begin, int count, float weight,
              float* __restrict value, float* const by[3], RowSums& sums) {
  const float *px = means[0] + begin, *py = means[1] + begin, *pxx = means[2] + begin, *pyy = means[3] + begin;
  const float* pxy = means[4] + begin;
  float* __restrict by_x = by[0] + begin, * __restrict by_xx = by[1] + begin, * __restrict by_xy = by[2] + begin;
#pragma GCC ivdep  // the arrays do not overlap: too many for the compiler to check
  for (int i = 0; i < count; ++i) {
    const float mx = px[i], my = py[i];
    const float a = 2 * mx * my + kC1, b = 2 * (pxy[i] - mx * my) + kC2;
    const float c = mx * mx + my * my + kC1, d = (pxx[i] - mx * mx) + (pyy[i] - my * my) + kC2;
    const float inverse = 1 / (c * d), ssim = a * b * inverse;
    value[i] = ssim;
    by_x[i] = weight * (2 * my * (b - a) * inverse - 2 * mx * ssim * (d - c) * inverse);
    by_xx[i] = weight * -ssim * c * inverse;
    by_xy[i] = weight * 2 * a * inverse;
  }
  if (counts)
    for (int i = 0; i < count; ++i) {
      value[i] = counts[i] ? value[i] : 0.0f, by_x[i] = counts[i] ? by_x[i] : 0.0f;
      by_xx[i] = counts[i] ? by_xx[i] : 0.0f, by_xy[i] = counts[i] ? by_xy[i] : 0.0f;
    }
  int at = 0;
  for (; at + kLanes <= count; at += kLanes) store(sums.ssim, load(sums.ssim) + load(value + at));
  for (; at < count; ++at) sums.rest_ssim += value[at];
}

void gradient_row(const float* const by[3], const float* x, const float* y, const uint8_t* counts, int count,
                  float l1_weight, float* __restrict out) {
  const float *by_x = by[0], *by_xx = by[1], *by_xy = by[2];
  for (int i = 0; i < count; ++i) {
    const float difference = x[i] - y[i];
    const float sign = difference > 0 ? l1_weight : difference < 0 ? -l1_weight : 0.0f;
    out[i] = by_x[i] + 2 * x[i] * by_xx[i] + y[i] * by_xy[i] + sign;
  }
  if (counts)
    for (int i = 0; i < count; ++i) out[i] = counts[i] ? out[i] : 0.0f;
}

// Of values in turn from `first` on, what the rate of each is a multiple of: the unit of its row.
void units_of(const AdamStep& s, int64_t first, int count, float* units) {
  for (int64_t row = first / s.values, at = first; at < first + count; ++row) {
    const int64_t next = (row + 1) * s.values, last = next < first + count ? next : first + count;
    for (const float unit = s.units[row]; at < last; ++at) units[at - first] = unit;
  }
}

bool adam(const AdamStep& s, int64_t count, const float* gradient, float* parameter, float* exp_avg,
          float* exp_avg_sq) {
  constexpr int kAtOnce = 45 * kLanes, kAhead = 512;
  alignas(64) float units[kAtOnce];
  if (!s.units)
    for (float& unit : units) unit = 1;
  const F rate = s.lr / s.correction1, root = 1 / sqrtf(s.correction2), eps = s.eps;
  const F beta1 = s.beta1, beta2 = s.beta2, rest1 = 1 - s.beta1, rest2 = 1 - s.beta2;
  F broken = 0;  // NaN where a gradient was not finite
  const auto step = [&](const float* unit, const float* by, float* value, float* first, float* second) {
    fetch_line(first + kAhead), fetch_line(second + kAhead);
    const F g = load(by), m = fma(beta1, load(first), rest1 * g), v = fma(beta2, load(second), rest2 * g * g);
    broken = fma(g, F(0), broken);
    store(first, m), store(second, v);
    store(value, load(value) - load(unit) * rate * m / fma(sqrt(v), root, eps));
  };
  for (int64_t at = 0; at < count; at += kAtOnce) {
    const int some = count - at < kAtOnce ? int(count - at) : kAtOnce, whole = some / kLanes * kLanes;
    if (s.units) units_of(s, at, some, units);
    for (int i = 0; i < whole; i += kLanes)
      step(units + i, gradient + at + i, parameter + at + i, exp_avg + at + i, exp_avg_sq + at + i);
    if (whole == some) continue;
    float last[4][kLanes] = {};
    const size_t bytes = (some - whole) * sizeof(float);
    float* const moved[3] = {parameter + at + whole, exp_avg + at + whole, exp_avg_sq + at + whole};
    for (int k = 0; k < 3; ++k) __builtin_memcpy(last[k], moved[k], bytes);
    __builtin_memcpy(last[3], gradient + at + whole, bytes);
    step(units + whole, last[3], last[0], last[1], last[2]);
    for (int k = 0; k < 3; ++k) __builtin_memcpy(moved[k], last[k], bytes);
  }
  return bits(broken >= 0) == 0xffff;
}

}  // namespace

extern const Kernels kKernels = {PANOLOG_TEXT(PANOLOG_ISA),
                                 project_span,
                                 project_backward_span<SplatGradientOf>,
                                 project_backward_span<AbsoluteGradientOf>,
                                 project_rays_span,
                                 project_backward_span<RayGradientOf>,
                                 tiles_of,
                                 tile_forward,
                                 tile_backward,
                                 tile_absolute_backward,
                                 ray_tiles_of,
                                 ray_tile_forward,
                                 ray_tile_backward,
                                 samples_row,
                                 exposed_row,
                                 blur_row,
                                 weighted_sum,
                                 ssim_row,
                                 gradient_row,
                                 adam};

}  // namespace panolog::PANOLOG_ISA
