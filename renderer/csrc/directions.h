// Directions of the pixels of a panorama, for exact projection.
#pragma once
#include <cmath>
#include <vector>

#include "kernels.h"

namespace panolog {

// Directions on a grid of `step` pixels, which covers whole tiles: `Grid` over memory of its own.
class Directions {
 public:
  Directions() = default;  // none, as affine projection needs
  Directions(const Camera& camera, int step) {
    const int columns = tiles_across(camera.width) * kTile / step, rows = tiles_across(camera.height) * kTile / step;
    const auto angles = [&](int count, double turn, double middle, std::vector<float>& sines,
                            std::vector<float>& cosines) {
      for (int i = 0; i < count; ++i) {
        const double angle = turn * ((i + 0.5) * step - middle);
        sines.push_back(float(std::sin(angle))), cosines.push_back(float(std::cos(angle)));
      }
    };
    constexpr double kPiExact = 3.14159265358979323846;
    angles(columns, 2 * kPiExact / camera.width, 0.5 * camera.width, sin_u_, cos_u_);
    angles(rows, kPiExact / camera.height, 0.5 * camera.height, sin_v_, cos_v_);
  }
  Grid grid() const { return {sin_u_.data(), cos_u_.data(), sin_v_.data(), cos_v_.data()}; }

 private:
  std::vector<float> sin_u_, cos_u_, sin_v_, cos_v_;
};

}  // namespace panolog
