// Gradients of the formulas: from sums over pixels to the parameters of a Gaussian and to the pose of its camera.
#pragma once
#include "formulas.h"

namespace panolog {

// The gradients of one Gaussian. shN has 15 × 3 floats; only sh_count - 1 rows are written. `absolute`: sums over
// pixels of the absolute values of the parts that each has in `screen`. `motion`, null or 6 values: its part in the
// gradient of the camera's pose.
template <class T>
struct ParameterGradients {
  T *mean, *quat, *scale, *opacity, *sh0, *shN, *screen, *absolute, *motion;
};

// Where an affine splat's shape depends on its place as on the tangent of the elevation, a Gaussian near a pole
// outweighs all others in a turn of the camera: nearer than this sine of the polar distance it takes no part. 0: none
// is left out.
constexpr float kMotionPole = 0;
constexpr int kMotion = 6;       // of a pose: x y z of a translation τ, and of a turn ω
constexpr int kMotionSums = 27;  // over Gaussians: of those, and of their products with each other, i ≤ j, row by row

// The part of one Gaussian in dL/d(τ, ω) as its camera moves, X_cam = exp(ω)·(R·X + t) + τ. That is as if all Gaussians
// moved the other way, but for the colours: turning about its own centre changes no direction of view in the world.
// `point`: dL/d(camera coordinates) without the colours; `mean`: dL/d(mean) with them; dM: dL/d(g.camera).
template <class T>
PANOLOG_HD void motion_of(const Geometry<T>& g, const Camera& cam, const T point[3], const T mean[3], const T dM[9],
                          T out[kMotion]) {
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    T turn = g.point[j] * point[k] - g.point[k] * point[j];
    for (int axis = 0; axis < 3; ++axis)
      turn += g.camera[3 * j + axis] * dM[3 * k + axis] - g.camera[3 * k + axis] * dM[3 * j + axis];
    out[i] = dot3(cam.rotation + 3 * i, mean), out[3 + i] = turn;
  }
}

template <class T>
PANOLOG_HD void color_backward(const Parameters<T>& p, const SplatOf<T>& s, const SplatGradientOf<T>& in, const T d[3],
                               int sh_count, const ParameterGradients<T>& out, T direction[3]) {
  T Y[16], weight[16], color[3];
  sh_basis(d, sh_count, Y);
  T clamped = s.clamped;
  for (int ch = 2; ch >= 0; --ch) {
    const MaskOf<T> cut = clamped >= 1 << ch;
    clamped -= select(cut, 1 << ch, 0);
    color[ch] = select(cut, 0, in.color[ch]);
    out.sh0[ch] = Y[0] * color[ch];
  }
  weight[0] = 0;
  for (int k = 1; k < sh_count; ++k) {
    weight[k] = dot3(p.shN + 3 * (k - 1), color);
    for (int ch = 0; ch < 3; ++ch) out.shN[3 * (k - 1) + ch] = Y[k] * color[ch];
  }
  sh_basis_backward(d, sh_count, weight, direction);
}

// dL/d(J rows) to dL/d(point): derivatives of the Jacobian of appendix B, away from the pole.
template <class T>
PANOLOG_HD void jacobian_backward(const Geometry<T>& g, const Camera& cam, const T dJu[3], const T dJv[3], T point[3]) {
  const T x = g.point[0], y = g.point[1], z = g.point[2];
  const float fx = cam.width / (2 * kPi), fy = cam.height / kPi;
  const T i2 = 1 / g.plane, r2 = 1 / g.square, rho = g.root;
  const T xi = x * i2, zi = z * i2;  // squares of 1 / plane would leave the range of floats
  const T k = r2 / rho;
  const T kx = -k * (2 * x * r2 + xi), ky = -2 * k * y * r2, kz = -k * (2 * z * r2 + zi);
  const T t = r2 / rho - 2 * rho * r2 * r2;
  point[0] += fx * (-2 * dJu[0] * xi * zi + dJu[2] * (2 * xi * xi - i2)) -
              fy * (dJv[0] * y * (k + x * kx) + dJv[2] * z * y * kx) + fy * dJv[1] * x * t;
  point[1] += -fy * (dJv[0] * x * (k + y * ky) + dJv[2] * z * (k + y * ky)) - fy * dJv[1] * 2 * y * rho * r2 * r2;
  point[2] += fx * (dJu[0] * (i2 - 2 * zi * zi) + 2 * dJu[2] * xi * zi) -
              fy * (dJv[0] * x * y * kz + dJv[2] * y * (k + z * kz)) + fy * dJv[1] * z * t;
}

template <class T>
PANOLOG_HD void quaternion_backward(const Geometry<T>& g, const T dR[9], T out[4]) {
  const T w = g.quat[0], x = g.quat[1], y = g.quat[2], z = g.quat[3];
  T d[4];
  d[0] = 2 * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
  d[1] = 2 * (w * (dR[7] - dR[5]) + y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) - 2 * x * (dR[4] + dR[8]));
  d[2] = 2 * (w * (dR[2] - dR[6]) + x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) - 2 * y * (dR[0] + dR[8]));
  d[3] = 2 * (w * (dR[3] - dR[1]) + x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) - 2 * z * (dR[0] + dR[4]));
  const T along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
  for (int i = 0; i < 4; ++i) out[i] = (d[i] - along * g.quat[i]) / g.norm;
}

// From the sums over pixels to the gradients of one Gaussian's parameters.
template <class T>
PANOLOG_HD void project_backward(const Parameters<T>& p, const Camera& cam, int sh_count, const SplatOf<T>& s,
                                 const SplatGradientOf<T>& in, const ParameterGradients<T>& out) {
  Geometry<T> g;
  geometry_of(p, cam, g);
  const float* R = cam.rotation;

  // power = -(A·e² + C·dy²)/2 with A = var_v/det, e = dx - slope·dy, slope = cov/var_v, C = 1/var_v
  const T A = s.a * (-2 / kLog2E), C = s.c * (-2 / kLog2E), k = s.slope;
  const T du = A * in.e, dv = C * in.y - k * du;
  out.screen[0] = du, out.screen[1] = dv;
  const T opacity = 1 / (1 + exp(-p.opacity));
  *out.opacity = in.power * (1 - opacity);

  T dmu[3], dmv[3], dJu[3] = {0, 0, 0}, dJv[3] = {0, 0, 0}, dM[9];
  // mu - slope·mv, which would cancel for a needle: (mv × (mu × mv) + low-pass · mu) / var_v
  T normal[3], across[3];
  cross(g.mu, g.mv, normal);
  cross(g.mv, normal, across);
  for (int j = 0; j < 3; ++j) {
    const T rest = (across[j] + kLowPass * g.mu[j]) * C;
    const T along_u = A * A * in.ee * rest + A * C * in.ey * g.mv[j];
    dmu[j] = along_u * g.size[j];
    dmv[j] = (A * C * in.ey * rest + C * C * in.yy * g.mv[j] - k * along_u) * g.size[j];
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      dJu[i] += g.camera[3 * i + j] * dmu[j];
      dJv[i] += g.camera[3 * i + j] * dmv[j];
      dM[3 * i + j] = g.Ju[i] * dmu[j] + g.Jv[i] * dmv[j];  // d(W·R) column j, already times its size
    }
  T dR[9];  // rotated back into the world
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) dR[3 * i + j] = R[i] * dM[j] + R[3 + i] * dM[3 + j] + R[6 + i] * dM[6 + j];
  for (int j = 0; j < 3; ++j)
    out.scale[j] = dR[j] * g.world[j] + dR[3 + j] * g.world[3 + j] + dR[6 + j] * g.world[6 + j];
  quaternion_backward(g, dR, out.quat);

  T point[3];
  const T dr = -in.inverse_depth / (g.square * g.distance);
  for (int i = 0; i < 3; ++i) point[i] = dr * g.point[i];
  point[1] += g.Jv[1] * dv;
  T turned[3] = {g.Ju[0] * du + g.Jv[0] * dv, 0, g.Ju[2] * du + g.Jv[2] * dv};
  jacobian_backward(g, cam, dJu, dJv, turned);
  for (int i = 0; i < 3; ++i) point[i] += select(g.pole, 0, turned[i]);  // constants at the pole

  T d[3], direction[3];
  view_direction(g, cam, d);
  color_backward(p, s, in, d, sh_count, out, direction);
  const T along = dot3(direction, d);
  for (int i = 0; i < 3; ++i)
    out.mean[i] =
        R[i] * point[0] + R[3 + i] * point[1] + R[6 + i] * point[2] + (direction[i] - along * d[i]) / g.distance;
  if (!out.motion) return;
  motion_of(g, cam, point, out.mean, dM, out.motion);
  const MaskOf<T> counts = g.plane >= kMotionPole * kMotionPole * g.square;
  for (int k = 0; k < kMotion; ++k) out.motion[k] = select(counts, out.motion[k], 0);
}

template <class T>
PANOLOG_HD void project_backward(const Parameters<T>& p, const Camera& cam, int sh_count, const SplatOf<T>& s,
                                 const AbsoluteGradientOf<T>& in, const ParameterGradients<T>& out) {
  const SplatGradientOf<T>& sums = in;
  project_backward(p, cam, sh_count, s, sums, out);
  out.absolute[0] = s.a * (-2 / kLog2E) * in.across, out.absolute[1] = 2 / kLog2E * in.down;
}

}  // namespace panolog
