// The kernels on plain arrays: C-contiguous, float32 unless said otherwise, checked for type and contiguity here.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <chrono>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <tuple>
#include <utility>

#include "loss.h"
#include "pairs.h"
#include "rasterize.h"

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace nb = nanobind;

namespace {

template <class T>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using InOut = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<nb::numpy, T>;

// Hands a buffer's memory to Python without a copy.
template <class Scalar, class T>
Out<Scalar> give(panolog::Buffer<T>&& buffer) {
  const size_t size = buffer.size * sizeof(T) / sizeof(Scalar);
  T* data = buffer.data.release();
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return Out<Scalar>(data, {size}, owner);
}

panolog::Camera camera_of(const In<float>& rotation, const In<float>& translation, int width, int height,
                          float near_cut) {
  if (rotation.size() != 9 || translation.size() != 3) throw std::invalid_argument("the pose is not 3 × 3 and 3");
  panolog::Camera camera;
  for (int i = 0; i < 9; ++i) camera.rotation[i] = rotation.data()[i];
  for (int i = 0; i < 3; ++i) camera.translation[i] = translation.data()[i];
  camera.width = width, camera.height = height, camera.near_cut = near_cut;
  return camera;
}

void expect(bool fits, const char* what) {
  if (!fits) throw std::invalid_argument(what);
}

struct Model {  // keeps the arrays alive and presents them to the kernels
  In<float> means, quats, scales, opacities, sh0, shN, screen;
  panolog::GaussianArrays arrays() const {
    const size_t n = opacities.size();
    expect(means.size() == 3 * n && quats.size() == 4 * n && scales.size() == 3 * n && sh0.size() == 3 * n &&
               shN.size() == 45 * n && screen.size() == 2 * n,
           "the parameters are not of equally many Gaussians");
    return {means.data(),     quats.data(), scales.data(), opacities.data(),
            sh0.data(),       shN.data(),   screen.data(), int64_t(opacities.size())};
  }
};

// Pairs per second of the loop in ceiling.cpp, on the thread that calls it.
double ceiling(bool backward, double seconds) {
  const auto loop = backward ? panolog::kernels().ceiling_backward : panolog::kernels().ceiling_forward;
  constexpr int64_t kRounds = 1 << 16, kPixels = 16;
  using Clock = std::chrono::steady_clock;
  volatile float step = 0, sink = loop(kRounds, step);  // also warms up
  const auto start = Clock::now();
  for (int64_t rounds = 0;;) {
    sink = loop(kRounds, step), rounds += kRounds;
    const double elapsed = std::chrono::duration<double>(Clock::now() - start).count();
    if (elapsed >= seconds) return double(rounds * kPixels) / elapsed;
  }
}

}  // namespace

NB_MODULE(_core, m) {
  m.doc() = "PanoLOG's CPU kernels";
  m.def("instruction_set", [] { return panolog::kernels().name; });
  m.def("choose_instruction_set", [](const char* name) { return panolog::choose_kernels(name); },
        "For tests: avx512, avx2 or portable, for the whole process. False where the processor lacks it.");

  m.def("keep_memory", [] {
#if defined(__GLIBC__)
    if (!mallopt(M_MMAP_THRESHOLD, 1 << 30)) mallopt(M_MMAP_THRESHOLD, 1 << 25);  // the most that an old glibc takes
    mallopt(M_TRIM_THRESHOLD, std::numeric_limits<int>::max());
    malloc_trim(0);  // what was kept for an earlier task has the wrong sizes for this one
#endif
  }, "Large blocks stay with the process when freed: a training loop takes the same ones again at each iteration.\n"
     "What is free now goes back to the system.");

  m.def("rasterize", [](In<float> means, In<float> quats, In<float> scales, In<float> opacities, In<float> sh0,
                        In<float> shN, In<float> screen, In<float> rotation, In<float> translation, int width,
                        int height, int sh_degree, float near_cut, int threads, InOut<float> color,
                        InOut<float> alpha, InOut<float> inverse_depth, InOut<uint8_t> state) {
    const Model model{means, quats, scales, opacities, sh0, shN, screen};
    const panolog::Camera camera = camera_of(rotation, translation, width, height, near_cut);
    const size_t pixels = size_t(width) * height;
    expect(color.size() == 3 * pixels && alpha.size() == pixels && inverse_depth.size() == pixels &&
               state.size() == opacities.size(),
           "the outputs do not fit");
    panolog::Frame frame;
    {
      nb::gil_scoped_release release;
      panolog::rasterize(model.arrays(), camera, (sh_degree + 1) * (sh_degree + 1), threads, frame,
                         {color.data(), alpha.data(), inverse_depth.data()}, state.data());
    }
    return std::make_tuple(give<float>(std::move(frame.splats)), give<int32_t>(std::move(frame.slots)),
                           give<int32_t>(std::move(frame.entries)), give<int32_t>(std::move(frame.tiles)));
  });

  m.def("rasterize_backward",
        [](In<float> means, In<float> quats, In<float> scales, In<float> opacities, In<float> sh0, In<float> shN,
           In<float> screen, In<float> rotation, In<float> translation, int width, int height, int sh_degree,
           float near_cut, int threads, In<float> color, In<float> alpha, In<float> inverse_depth,
           In<float> splats, In<int32_t> slots, In<int32_t> entries, In<int32_t> tiles,
           In<float> grad_color, In<float> grad_alpha, In<float> grad_inverse_depth, InOut<float> out_means,
           InOut<float> out_quats, InOut<float> out_scales, InOut<float> out_opacities, InOut<float> out_sh0,
           InOut<float> out_shN, InOut<float> out_screen) {
          const Model model{means, quats, scales, opacities, sh0, shN, screen};
          const panolog::Camera camera = camera_of(rotation, translation, width, height, near_cut);
          const size_t pixels = size_t(width) * height;
          expect(color.size() == 3 * pixels && alpha.size() == pixels && inverse_depth.size() == pixels &&
                     grad_color.size() == 3 * pixels && grad_alpha.size() == pixels &&
                     grad_inverse_depth.size() == pixels && slots.size() == opacities.size() + 1,
                 "the images or the frame are not those of the forward pass");
          nb::gil_scoped_release release;
          const panolog::FrameView frame = {
              reinterpret_cast<const panolog::Splat*>(splats.data()),
              reinterpret_cast<const uint32_t*>(slots.data()),
              reinterpret_cast<panolog::Entry*>(const_cast<int32_t*>(entries.data())),
              reinterpret_cast<const uint32_t*>(tiles.data()),
          };
          panolog::rasterize_backward(
              model.arrays(), camera, (sh_degree + 1) * (sh_degree + 1), threads, frame,
              {const_cast<float*>(color.data()), const_cast<float*>(alpha.data()),
               const_cast<float*>(inverse_depth.data())},
              {grad_color.data(), grad_alpha.data(), grad_inverse_depth.data()},
              {out_means.data(), out_quats.data(), out_scales.data(), out_opacities.data(), out_sh0.data(),
               out_shN.data(), out_screen.data()});
        });

  m.def("photometric",
        [](In<float> color, In<uint8_t> target, std::optional<In<uint8_t>> mask, int width, int height,
           float lambda_ssim, int threads, InOut<float> gradient) {
          const size_t pixels = size_t(width) * height;
          expect(color.size() == 3 * pixels && target.size() == 3 * pixels && gradient.size() == 3 * pixels &&
                     (!mask || mask->size() == pixels),
                 "the images are not of one size");
          nb::gil_scoped_release release;
          const panolog::LossSums sums =
              panolog::photometric(color.data(), target.data(), mask ? mask->data() : nullptr, width, height,
                                   lambda_ssim, threads, gradient.data());
          return std::make_tuple(sums.l1, sums.ssim, sums.squared);
        },
        nb::arg("color"), nb::arg("target"), nb::arg("mask").none(), nb::arg("width"), nb::arg("height"),
        nb::arg("lambda_ssim"), nb::arg("threads"), nb::arg("gradient"));

  m.def("ssim_map", [](In<float> a, In<float> b, int width, int height, int threads, InOut<float> out) {
    nb::gil_scoped_release release;
    panolog::ssim_map(a.data(), b.data(), width, height, threads, out.data());
  });

  m.def("absolute_difference",
        [](In<float> rendered, In<float> target, In<uint8_t> valid, int threads, InOut<float> gradient) {
          nb::gil_scoped_release release;
          return panolog::absolute_difference(rendered.data(), target.data(), valid.data(),
                                              int64_t(rendered.size()), threads, gradient.data());
        });

  m.def("stages", [] {
    const panolog::Stages& s = panolog::latest;
    return std::make_tuple(s.project, s.order, s.composite, s.composite_backward, s.project_backward);
  }, "Seconds of the latest projection, ordering, compositing and the way back through both: for benchmarks.");

  m.def("ceiling", [](bool backward, double seconds) {
    nb::gil_scoped_release release;
    return ceiling(backward, seconds);
  }, nb::arg("backward"), nb::arg("seconds"),
        "Pairs per second of the tiles' arithmetic with everything in registers, on one thread: for benchmarks.");

  m.def("count_pairs", [](In<float> splats, In<int32_t> entries, In<int32_t> tiles, int width, int height) {
    const panolog::FrameView frame = {
        reinterpret_cast<const panolog::Splat*>(splats.data()), nullptr,
        reinterpret_cast<panolog::Entry*>(const_cast<int32_t*>(entries.data())),
        reinterpret_cast<const uint32_t*>(tiles.data())};
    expect(tiles.size() == size_t(panolog::tiles_across(width)) * panolog::tiles_across(height) + 1,
           "the tiles are not of this image");
    nb::gil_scoped_release release;
    const panolog::Pairs pairs = panolog::count_pairs(frame, width, height);
    return std::make_tuple(pairs.evaluated, pairs.useful);
  }, "Evaluated and useful pairs of pixel and splat of a frame that `rasterize` left: for benchmarks.");

  m.def("adam", [](InOut<float> parameter, In<float> gradient, InOut<float> mean, InOut<float> square, int64_t count,
                   float lr, float beta1, float beta2, float eps, int64_t step, int threads) {
    nb::gil_scoped_release release;
    const panolog::AdamStep state = {lr,
                                     beta1,
                                     beta2,
                                     eps,
                                     float(1 - std::pow(double(beta1), double(step))),
                                     float(1 - std::pow(double(beta2), double(step)))};
    panolog::each_span(count, threads, 1 << 15, [&](int64_t begin, int64_t end) {
      panolog::kernels().adam(state, begin, end, gradient.data(), parameter.data(), mean.data(), square.data());
    });
  });
}
