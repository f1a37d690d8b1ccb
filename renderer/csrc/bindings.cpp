// The kernels on plain arrays: C-contiguous, float32 unless said otherwise, checked for type and contiguity here.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <tuple>
#include <utility>

#include "bake.h"
#include "loss.h"
#include "rasterize.h"
#include "team.h"

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using InOut = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<nb::numpy, T>;

// An array that owns the memory of a buffer: no copy.
template <class Scalar, class T>
Out<Scalar> to_numpy(panolog::Buffer<T>&& buffer) {
  const size_t size = buffer.size * sizeof(T) / sizeof(Scalar);
  T* data = buffer.data.release();
  nb::capsule owner(data, [](void* memory) noexcept { std::free(memory); });
  return Out<Scalar>(data, {size}, owner);
}

panolog::Camera camera_of(const In<float>& rotation, const In<float>& translation, int width, int height, float near,
                          bool exact) {
  if (rotation.size() != 9 || translation.size() != 3) throw std::invalid_argument("the pose is not 3 × 3 and 3");
  panolog::Camera camera;
  for (int i = 0; i < 9; ++i) camera.rotation[i] = rotation.data()[i];
  for (int i = 0; i < 3; ++i) camera.translation[i] = translation.data()[i];
  camera.width = width, camera.height = height, camera.near = near, camera.exact = exact;
  return camera;
}

void expect(bool fits, const char* what) {
  if (!fits) throw std::invalid_argument(what);
}

constexpr size_t kSplatFloats = sizeof(panolog::Splat) / sizeof(float);
static_assert(sizeof(panolog::RaySplat) == sizeof(panolog::Splat), "both are one cache line");

struct Model {  // keeps the arrays alive and presents them to the kernels
  In<float> means, quats, scales, opacities, sh0, shN, screen;
  panolog::GaussianArrays arrays() const {
    const size_t n = opacities.size();
    expect(means.size() == 3 * n && quats.size() == 4 * n && scales.size() == 3 * n && sh0.size() == 3 * n &&
               shN.size() == 45 * n && screen.size() == 2 * n,
           "the parameters are not of equally many Gaussians");
    return {.means = means.data(),
            .quats = quats.data(),
            .scales = scales.data(),
            .opacities = opacities.data(),
            .sh0 = sh0.data(),
            .shN = shN.data(),
            .screen = screen.data(),
            .count = int64_t(n)};
  }
};

// Splats, rays, places, spans, front and back layers of panolog::Exterior.
using ExteriorArrays = std::tuple<In<float>, In<float>, In<int32_t>, In<float>, In<float>, In<float>>;

std::optional<panolog::Exterior> view_of(const std::optional<ExteriorArrays>& arrays, const panolog::Camera& camera) {
  if (!arrays) return {};
  const auto& [splats, rays, places, spans, front, back] = *arrays;
  const size_t tiles = size_t(panolog::tiles_across(camera.width)) * panolog::tiles_across(camera.height);
  const size_t layer = panolog::kPlanes * panolog::kTilePixels;
  expect(places.size() == tiles && spans.size() == 2 * tiles && front.size() == back.size() &&
             splats.size() % kSplatFloats == 0 && rays.size() == (camera.exact ? splats.size() : 0),
         "the exterior is not one of this camera");
  for (size_t tile = 0; tile < tiles; ++tile)
    expect(places.data()[tile] < int64_t(front.size() / layer), "a layer of the exterior is missing");
  return panolog::Exterior{.splats = reinterpret_cast<const panolog::Splat*>(splats.data()),
                           .rays = reinterpret_cast<const panolog::RaySplat*>(rays.data()),
                           .count = int64_t(splats.size() / kSplatFloats),
                           .places = places.data(),
                           .spans = spans.data(),
                           .front = front.data(),
                           .back = back.data()};
}

void bind_process(nb::module_& m) {
  m.def("instruction_set", [] { return panolog::kernels().name; });
  m.def(
      "choose_instruction_set", [](const char* name) { return panolog::choose_kernels(name); }, "name"_a,
      "For tests: avx512, avx2 or portable, for the whole process. False where the processor lacks it.");

  m.def(
      "keep_memory",
      [] {
#if defined(__GLIBC__)
        if (!mallopt(M_MMAP_THRESHOLD, 1 << 30))
          mallopt(M_MMAP_THRESHOLD, 1 << 25);  // the most that an old glibc takes
        mallopt(M_TRIM_THRESHOLD, std::numeric_limits<int>::max());
#endif
      },
      "Keeps large freed blocks in the process: each iteration of training allocates the same ones again.");

  m.def(
      "release_memory",
      [] {
#if defined(__GLIBC__)
        malloc_trim(0);
#endif
      },
      "Returns memory to the system that is free now, though it is kept: what follows needs other sizes.");

  // For benchmarks.
  m.def(
      "stages",
      [] {
        const panolog::Stages& s = panolog::latest;
        return std::make_tuple(s.project, s.order, s.composite, s.composite_backward, s.project_backward);
      },
      "Seconds of the latest projection, ordering, compositing, and the backward passes of compositing and "
      "projection.");
}

void bind_rasterize(nb::module_& m) {
  m.def(
      "rasterize",
      [](In<float> means, In<float> quats, In<float> scales, In<float> opacities, In<float> sh0, In<float> shN,
         In<float> screen, In<float> rotation, In<float> translation, int width, int height, int sh_degree, float near,
         bool exact, int threads, InOut<float> color, InOut<float> alpha, InOut<float> inverse_depth,
         InOut<uint8_t> state, const std::optional<ExteriorArrays>& exterior) {
        const Model model{means, quats, scales, opacities, sh0, shN, screen};
        const panolog::Camera camera = camera_of(rotation, translation, width, height, near, exact);
        const size_t pixels = size_t(width) * height;
        expect(color.size() == 3 * pixels && alpha.size() == pixels && inverse_depth.size() == pixels &&
                   state.size() == opacities.size(),
               "the outputs do not fit");
        const std::optional<panolog::Exterior> frozen = view_of(exterior, camera);
        panolog::Frame frame;
        {
          nb::gil_scoped_release release;
          panolog::rasterize(
              model.arrays(), camera, (sh_degree + 1) * (sh_degree + 1), threads, frozen ? &*frozen : nullptr, frame,
              {.color = color.data(), .alpha = alpha.data(), .inverse_depth = inverse_depth.data()}, state.data());
        }
        return std::make_tuple(to_numpy<float>(std::move(frame.splats)), to_numpy<float>(std::move(frame.rays)),
                               to_numpy<int32_t>(std::move(frame.slots)), to_numpy<int32_t>(std::move(frame.entries)),
                               to_numpy<int32_t>(std::move(frame.tiles)));
      },
      "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh0"_a, "shN"_a, "screen"_a, "rotation"_a, "translation"_a,
      "width"_a, "height"_a, "sh_degree"_a, "near"_a, "exact"_a, "threads"_a, "color"_a, "alpha"_a, "inverse_depth"_a,
      "state"_a, "exterior"_a.none(),
      "Eq. 1. Writes the images and states; returns splats, rays, slots, entries and tiles for the backward pass.");
}

// Of means, quats, scales, opacities, sh0 and shN.
using ParameterArrays = std::array<InOut<float>, panolog::kParameters>;

// A parameter of a step, its moments, how many of its values move, its rate and that rate's units: panolog::Moving.
using MovingArrays = std::tuple<InOut<float>, InOut<float>, InOut<float>, int64_t, float, std::optional<In<float>>>;

// The parameters that move, β₁, β₂, ε and the number of the step.
using StepArrays =
    std::tuple<std::array<std::optional<MovingArrays>, panolog::kParameters>, float, float, float, int64_t>;

panolog::Step step_of(const StepArrays& arrays, size_t count) {
  const auto& [parameters, beta1, beta2, eps, number] = arrays;
  panolog::Step step = {};
  for (int k = 0; k < panolog::kParameters; ++k) {
    if (!parameters[k]) continue;
    const auto& [values, exp_avg, exp_avg_sq, moving, lr, units] = *parameters[k];
    const int64_t stride = panolog::kParameterFloats[k];
    expect(values.size() == count * stride && exp_avg.size() == values.size() && exp_avg_sq.size() == values.size() &&
               0 <= moving && moving <= int64_t(values.size()) && (!units || units->size() == count),
           "a parameter that moves, its moments or units are not of equally many Gaussians");
    step.parameters[k] = {.values = values.data(),
                          .exp_avg = exp_avg.data(),
                          .exp_avg_sq = exp_avg_sq.data(),
                          .count = moving,
                          .stride = stride,
                          .step = {.lr = lr,
                                   .beta1 = beta1,
                                   .beta2 = beta2,
                                   .eps = eps,
                                   .correction1 = float(1 - std::pow(double(beta1), double(number))),
                                   .correction2 = float(1 - std::pow(double(beta2), double(number))),
                                   .units = units ? units->data() : nullptr,
                                   .values = stride}};
  }
  return step;
}

panolog::GradientArrays gradients_of(const std::optional<ParameterArrays>& out,
                                     const std::optional<InOut<float>>& screen,
                                     const std::optional<InOut<float>>& absolute,
                                     const std::optional<InOut<double>>& motion, size_t count) {
  for (int k = 0; out && k < panolog::kParameters; ++k)
    expect((*out)[k].size() == count * panolog::kParameterFloats[k], "a gradient has not the size of its parameter");
  expect((!screen || screen->size() == 2 * count) && (!absolute || absolute->size() == 2 * count) &&
             (!motion || motion->size() == panolog::kMotionSums),
         "the gradients of screen or motion have another size");
  const auto at = [&](int k) { return out ? (*out)[k].data() : nullptr; };
  return {.means = at(0),
          .quats = at(1),
          .scales = at(2),
          .opacities = at(3),
          .sh0 = at(4),
          .shN = at(5),
          .screen = screen ? screen->data() : nullptr,
          .absolute = absolute ? absolute->data() : nullptr,
          .motion = motion ? motion->data() : nullptr};
}

void bind_backward(nb::module_& m) {
  m.def(
      "rasterize_backward",
      [](In<float> means, In<float> quats, In<float> scales, In<float> opacities, In<float> sh0, In<float> shN,
         In<float> screen, In<float> rotation, In<float> translation, int width, int height, int sh_degree, float near,
         bool exact, int threads, In<float> color, In<float> alpha, In<float> inverse_depth, In<float> splats,
         In<float> rays, In<int32_t> slots, In<int32_t> entries, In<int32_t> tiles, In<float> grad_color,
         In<float> grad_alpha, In<float> grad_inverse_depth, const std::optional<ExteriorArrays>& exterior,
         const std::optional<ParameterArrays>& out, std::optional<InOut<float>> out_screen,
         std::optional<InOut<double>> out_motion, std::optional<InOut<float>> out_absolute,
         const std::optional<StepArrays>& step) {
        const Model model{means, quats, scales, opacities, sh0, shN, screen};
        const panolog::Camera camera = camera_of(rotation, translation, width, height, near, exact);
        const size_t pixels = size_t(width) * height;
        expect(color.size() == 3 * pixels && alpha.size() == pixels && inverse_depth.size() == pixels &&
                   grad_color.size() == 3 * pixels && grad_alpha.size() == pixels &&
                   grad_inverse_depth.size() == pixels && slots.size() == opacities.size() + 1 &&
                   !(out_absolute && exact),
               "the images or the frame are not those of the forward pass");
        expect(bool(out) != bool(step), "gradients are written or take a step");
        const panolog::GradientArrays gradients =
            gradients_of(out, out_screen, out_absolute, out_motion, opacities.size());
        panolog::Step taken = step ? step_of(*step, opacities.size()) : panolog::Step{};
        const std::optional<panolog::Exterior> frozen = view_of(exterior, camera);
        nb::gil_scoped_release release;
        const panolog::FrameView frame = {
            .splats = reinterpret_cast<const panolog::Splat*>(splats.data()),
            .rays = rays.size() ? reinterpret_cast<const panolog::RaySplat*>(rays.data()) : nullptr,
            .slots = reinterpret_cast<const uint32_t*>(slots.data()),
            .entries = reinterpret_cast<panolog::Entry*>(const_cast<int32_t*>(entries.data())),
            .tiles = reinterpret_cast<const uint32_t*>(tiles.data()),
        };
        panolog::rasterize_backward(
            model.arrays(), camera, (sh_degree + 1) * (sh_degree + 1), threads, frozen ? &*frozen : nullptr, frame,
            {.color = const_cast<float*>(color.data()),
             .alpha = const_cast<float*>(alpha.data()),
             .inverse_depth = const_cast<float*>(inverse_depth.data())},
            {.color = grad_color.data(), .alpha = grad_alpha.data(), .inverse_depth = grad_inverse_depth.data()},
            gradients, step ? &taken : nullptr);
        return taken.broken;
      },
      "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh0"_a, "shN"_a, "screen"_a, "rotation"_a, "translation"_a,
      "width"_a, "height"_a, "sh_degree"_a, "near"_a, "exact"_a, "threads"_a, "color"_a, "alpha"_a, "inverse_depth"_a,
      "splats"_a, "rays"_a, "slots"_a, "entries"_a, "tiles"_a, "grad_color"_a, "grad_alpha"_a, "grad_inverse_depth"_a,
      "exterior"_a.none(), "out"_a = nb::none(), "out_screen"_a = nb::none(), "out_motion"_a = nb::none(),
      "out_absolute"_a = nb::none(), "step"_a = nb::none(),
      "From the gradients of the three images writes those of the parameters, or moves these by a step of Adam, and "
      "returns a bit for each whose gradient is not finite. With out_screen, out_motion and out_absolute also those of "
      "the pixels, the sums of camera motion, and absolute gradients of affine splats (csrc/gradients.h).");
}

void bind_bake(nb::module_& m) {
  m.def(
      "bake",
      [](In<float> means, In<float> quats, In<float> scales, In<float> opacities, In<float> sh0, In<float> shN,
         In<float> screen, int64_t own, In<float> rotation, In<float> translation, int width, int height, int sh_degree,
         float near, bool exact, float slack, float faint, int threads, InOut<float> front_color,
         InOut<float> front_alpha, InOut<float> front_inverse_depth, InOut<float> back_color, InOut<float> back_alpha,
         InOut<float> back_inverse_depth) {
        const panolog::Camera camera = camera_of(rotation, translation, width, height, near, exact);
        const size_t pixels = size_t(width) * height;
        expect(front_color.size() == 3 * pixels && front_alpha.size() == pixels &&
                   front_inverse_depth.size() == pixels && back_color.size() == 3 * pixels &&
                   back_alpha.size() == pixels && back_inverse_depth.size() == pixels,
               "the layers do not fit");
        const panolog::GaussianArrays all = Model{means, quats, scales, opacities, sh0, shN, screen}.arrays();
        expect(0 <= own && own <= all.count, "there are not so many own Gaussians");
        panolog::Baked baked;
        {
          nb::gil_scoped_release release;
          panolog::bake(all, own, camera, (sh_degree + 1) * (sh_degree + 1), slack, faint, threads, baked,
                        {front_color.data(), front_alpha.data(), front_inverse_depth.data()},
                        {back_color.data(), back_alpha.data(), back_inverse_depth.data()});
        }
        return std::make_tuple(to_numpy<float>(std::move(baked.spans)), to_numpy<uint8_t>(std::move(baked.among)),
                               to_numpy<float>(std::move(baked.frame.splats)),
                               to_numpy<float>(std::move(baked.frame.rays)));
      },
      "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh0"_a, "shN"_a, "screen"_a, "own"_a, "rotation"_a,
      "translation"_a, "width"_a, "height"_a, "sh_degree"_a, "near"_a, "exact"_a, "slack"_a, "faint"_a, "threads"_a,
      "front_color"_a, "front_alpha"_a, "front_inverse_depth"_a, "back_color"_a, "back_alpha"_a, "back_inverse_depth"_a,
      "All but the first `own` Gaussians as a camera sees them, before and behind those; see csrc/bake.h. Returns "
      "spans, which Gaussians composite among the own ones, splats and rays of all.");
}

void bind_losses(nb::module_& m) {
  m.def(
      "photometric",
      [](In<float> color, In<uint8_t> target, std::optional<In<uint8_t>> mask, int width, int height, float lambda_ssim,
         int threads, InOut<float> gradient, std::optional<In<float>> rows, std::optional<In<float>> exposure,
         std::optional<InOut<double>> normal) {
        const size_t pixels = size_t(width) * height;
        expect(color.size() == 3 * pixels && target.size() == 3 * pixels && gradient.size() == 3 * pixels &&
                   (!mask || mask->size() == pixels) && (!rows || rows->size() == size_t(height)),
               "the images are not of one size");
        expect(bool(exposure) == bool(normal) && (!exposure || (exposure->size() == 6 && normal->size() == 15)),
               "the exposure has not the size of one");
        nb::gil_scoped_release release;
        const panolog::LossSums sums = panolog::photometric(
            color.data(), target.data(), mask ? mask->data() : nullptr, rows ? rows->data() : nullptr, width, height,
            lambda_ssim, {exposure ? exposure->data() : nullptr, normal ? normal->data() : nullptr}, threads,
            gradient.data());
        return std::make_tuple(sums.l1, sums.ssim, sums.squared);
      },
      "color"_a, "target"_a, "mask"_a.none(), "width"_a, "height"_a, "lambda_ssim"_a, "threads"_a, "gradient"_a,
      "rows"_a = nb::none(), "exposure"_a = nb::none(), "normal"_a = nb::none(),
      "Returns the means of L1, SSIM and the squared error; writes the gradient of the loss of eq. 6.");

  m.def(
      "ssim_map",
      [](In<float> a, In<float> b, int width, int height, int threads, InOut<float> out) {
        nb::gil_scoped_release release;
        panolog::ssim_map(a.data(), b.data(), width, height, threads, out.data());
      },
      "a"_a, "b"_a, "width"_a, "height"_a, "threads"_a, "out"_a);

  m.def(
      "absolute_difference",
      [](In<float> rendered, In<float> target, In<uint8_t> valid, int threads, InOut<float> gradient) {
        nb::gil_scoped_release release;
        return panolog::absolute_difference(rendered.data(), target.data(), valid.data(), int64_t(rendered.size()),
                                            threads, gradient.data());
      },
      "rendered"_a, "target"_a, "valid"_a, "threads"_a, "gradient"_a,
      "Returns the mean over valid pixels (eq. 5); writes its gradient.");
}

}  // namespace

NB_MODULE(_core, m) {
  m.doc() = "PanoLOG's CPU kernels";
  bind_process(m);
  bind_rasterize(m);
  bind_backward(m);
  bind_bake(m);
  bind_losses(m);
}
