// Projection, Jacobian, conic, spherical harmonics and their derivatives, once for host and device.
// Equation numbers are those of the paper; tests/renderer/reference.py defines the same in PyTorch.
// T is the type of the arithmetic: float, or the sixteen floats of simd.h. Branches are therefore written as select.
#pragma once
#if defined(__CUDACC_RTC__)  // NVRTC has the functions of math.h built in, and no headers of the system
typedef unsigned char uint8_t;
typedef short int16_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
#else
#include <math.h>
#include <stdint.h>
#endif

#if defined(__CUDACC__)
#define PANOLOG_HD __host__ __device__ __forceinline__
#else
#define PANOLOG_HD static inline  // each instruction set keeps its own copy: the linker must not merge them
#endif

namespace panolog {

constexpr float kAlphaMin = 1.0f / 255.0f;  // a pair below this does not count
constexpr float kAlphaMax = 0.99f;
constexpr float kTransmittanceMin = 1e-4f;  // below this a pixel is opaque
constexpr float kLowPass = 0.3f;            // px² on the diagonal of the 2D covariance
constexpr float kCutSlack = 1e-3f;          // bounds may be too large: each pixel is tested anyway
constexpr float kPole = 1e-4f;              // sine of the polar distance below which azimuth is undefined
constexpr float kLeastNorm = 1e-18f;        // of a quaternion: the square of a smaller one is no normal float
constexpr float kPi = 3.14159265358979f;
constexpr float kLog2E = 1.44269504088896f;
constexpr float kLog2AlphaMin = -7.99435344f;  // log2(1/255)

// The functions that simd.h has for sixteen floats.
PANOLOG_HD float sqrt(float x) { return sqrtf(x); }
PANOLOG_HD float exp(float x) { return expf(x); }
PANOLOG_HD float log2(float x) { return log2f(x); }
PANOLOG_HD float atan2(float y, float x) { return atan2f(y, x); }
PANOLOG_HD float select(bool mask, float yes, float no) { return mask ? yes : no; }

template <class T>
using MaskOf = decltype(T() > T());  // bool for float

enum State : uint8_t { kHidden = 0, kVisible = 1, kInvalid = 2 };

struct Camera {
  float rotation[9];  // world to camera, row-major
  float translation[3];
  int width, height;
  float near;  // world units
  int exact;   // whether pixels see Gaussians along their rays (rays.h) or as affine splats (eq. 2)
};

template <class T>
struct Parameters {
  const T *mean, *quat, *scale;  // 3, 4 (w x y z), 3 (log)
  T opacity;                     // logit
  const T *sh0, *shN;            // 3, 45
};

// One Gaussian on the panorama: 16 floats, one cache line.
template <class T>
struct alignas(64) SplatOf {
  T u, v;         // pixels
  T a, slope, c;  // log2 alpha = log2_opacity + a·e² + c·dy² with e = dx - slope·dy: no term cancels another
  T log2_opacity;
  T color[3];
  T inverse_depth;
  T distance;  // radial, world units
  T clamped;   // the sum of 1, 2 and 4 for the colour channels that were below 0
  // The footprint ends where alpha is 1/255, on an ellipse: pixels from its centre to its largest v; the dv at which
  // u is largest; its half width on the row of the centre, and in all.
  T reach, tip, waist, half;
};
using Splat = SplatOf<float>;

// Gradients of the pixels for one Gaussian: sums over pixels of dL/dpower times 1, e, dy, e², e·dy, dy² (e as in
// Splat), and of the colours.
template <class T>
struct SplatGradientOf {
  T power, e, y, ee, ey, yy;
  T color[3];
  T inverse_depth;
};
using SplatGradient = SplatGradientOf<float>;
constexpr int kGradientFloats = 10;

// The same and what absolute gradients (Ye et al. 2024) need: sums over pixels of |e·dL/dpower|, and of
// |(c·dy - slope·a·e)·dL/dpower|.
template <class T>
struct AbsoluteGradientOf : SplatGradientOf<T> {
  T across, down;
};
using AbsoluteGradient = AbsoluteGradientOf<float>;
constexpr int kAbsoluteGradientFloats = 12;

template <class A, class B>
PANOLOG_HD B dot3(const A* a, const B* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Whether all of them are finite: 0 times anything else is not 0.
template <class T>
PANOLOG_HD MaskOf<T> finite(const T* values, int count) {
  T sum = 0;
  for (int i = 0; i < count; ++i) sum += 0 * values[i];
  return sum >= 0;
}

template <class T>
PANOLOG_HD void matrix_of(const T q[4], T R[9]) {  // unit w x y z
  const T w = q[0], x = q[1], y = q[2], z = q[3];
  R[0] = 1 - 2 * (y * y + z * z), R[1] = 2 * (x * y - w * z), R[2] = 2 * (x * z + w * y);
  R[3] = 2 * (x * y + w * z), R[4] = 1 - 2 * (x * x + z * z), R[5] = 2 * (y * z - w * x);
  R[6] = 2 * (x * z - w * y), R[7] = 2 * (y * z + w * x), R[8] = 1 - 2 * (x * x + y * y);
}

template <class T>
PANOLOG_HD void multiply(const float A[9], const T B[9], T C[9]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) C[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
}

// Real spherical harmonics of the first `count` coefficients, signs as in 3DGS.
template <class T>
PANOLOG_HD void sh_basis(const T d[3], int count, T Y[16]) {
  const T x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
  Y[0] = 0.28209479177387814f;
  if (count <= 1) return;
  Y[1] = -0.4886025119029199f * y, Y[2] = 0.4886025119029199f * z, Y[3] = -0.4886025119029199f * x;
  if (count <= 4) return;
  Y[4] = 1.0925484305920792f * x * y, Y[5] = -1.0925484305920792f * y * z;
  Y[6] = 0.31539156525252005f * (2 * zz - xx - yy);
  Y[7] = -1.0925484305920792f * x * z, Y[8] = 0.5462742152960396f * (xx - yy);
  if (count <= 9) return;
  Y[9] = -0.5900435899266435f * y * (3 * xx - yy), Y[10] = 2.890611442640554f * x * y * z;
  Y[11] = -0.4570457994644658f * y * (4 * zz - xx - yy);
  Y[12] = 0.3731763325901154f * z * (2 * zz - 3 * xx - 3 * yy);
  Y[13] = -0.4570457994644658f * x * (4 * zz - xx - yy);
  Y[14] = 1.445305721320277f * z * (xx - yy), Y[15] = -0.5900435899266435f * x * (xx - 3 * yy);
}

// dY/d(x, y, z), contracted with the weights g of the basis: gradient with respect to the direction.
template <class T>
PANOLOG_HD void sh_basis_backward(const T d[3], int count, const T g[16], T out[3]) {
  const T x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
  T gx = 0, gy = 0, gz = 0;
  if (count > 1) {
    const float k = 0.4886025119029199f;
    gy -= k * g[1], gz += k * g[2], gx -= k * g[3];
  }
  if (count > 4) {
    const float k = 1.0925484305920792f, m = 0.31539156525252005f, n = 0.5462742152960396f;
    gx += k * y * g[4] - 2 * m * x * g[6] - k * z * g[7] + 2 * n * x * g[8];
    gy += k * x * g[4] - k * z * g[5] - 2 * m * y * g[6] - 2 * n * y * g[8];
    gz += -k * y * g[5] + 4 * m * z * g[6] - k * x * g[7];
  }
  if (count > 9) {
    const float a = 0.5900435899266435f, b = 2.890611442640554f, c = 0.4570457994644658f;
    const float e = 0.3731763325901154f, f = 1.445305721320277f;
    gx += -6 * a * x * y * g[9] + b * y * z * g[10] + 2 * c * x * y * g[11] - 6 * e * x * z * g[12] -
          c * (4 * zz - 3 * xx - yy) * g[13] + 2 * f * x * z * g[14] - 3 * a * (xx - yy) * g[15];
    gy += -3 * a * (xx - yy) * g[9] + b * x * z * g[10] - c * (4 * zz - xx - 3 * yy) * g[11] - 6 * e * y * z * g[12] +
          2 * c * x * y * g[13] - 2 * f * y * z * g[14] + 6 * a * x * y * g[15];
    gz += b * x * y * g[10] - 8 * c * y * z * g[11] + e * (6 * zz - 3 * xx - 3 * yy) * g[12] - 8 * c * x * z * g[13] +
          f * (xx - yy) * g[14];
  }
  out[0] = gx, out[1] = gy, out[2] = gz;
}

// A Gaussian in camera coordinates, for the forward and the backward projection.
template <class T>
struct Geometry {
  T point[3], size[3], quat[4], norm;  // camera frame; exp(scale); unit quaternion and its norm before
  T square, distance, plane, root;     // r², r, x² + z² (held at the pole), its root
  T ux, uz;                            // x and z over that root; at the pole the direction of the azimuth
  MaskOf<T> pole;
  T world[9], camera[9];  // rotation of the Gaussian in the world, and in the camera
  T Ju[3], Jv[3];         // rows of the ERP Jacobian (appendix B)
  T mu[3], mv[3];         // rows of J·W·R·S, so that eq. 2 is their Gram matrix
};

template <class T>
PANOLOG_HD void geometry_of(const Parameters<T>& p, const Camera& cam, Geometry<T>& g) {
  const float* R = cam.rotation;
  for (int i = 0; i < 3; ++i) g.point[i] = dot3(R + 3 * i, p.mean) + cam.translation[i];
  const T x = g.point[0], y = g.point[1], z = g.point[2];
  g.square = x * x + y * y + z * z;
  g.distance = sqrt(g.square);
  g.plane = x * x + z * z;
  g.pole = g.plane < kPole * kPole * g.square;
  const T rho = sqrt(g.plane);
  g.ux = select(rho > 0, x / rho, 0), g.uz = select(rho > 0, z / rho, 1);
  g.plane = select(g.pole, kPole * kPole * g.square, g.plane);
  g.root = select(g.pole, kPole * g.distance, rho);
  g.norm = sqrt(p.quat[0] * p.quat[0] + p.quat[1] * p.quat[1] + p.quat[2] * p.quat[2] + p.quat[3] * p.quat[3]);
  for (int i = 0; i < 4; ++i) g.quat[i] = p.quat[i] / g.norm;
  for (int i = 0; i < 3; ++i) g.size[i] = exp(p.scale[i]);
  matrix_of(g.quat, g.world);
  multiply(R, g.world, g.camera);
  const float fx = cam.width / (2 * kPi), fy = cam.height / kPi;
  g.Ju[0] = fx * g.uz / g.root, g.Ju[1] = 0, g.Ju[2] = -fx * g.ux / g.root;
  g.Jv[0] = -fy * g.ux * y / g.square, g.Jv[1] = fy * g.root / g.square, g.Jv[2] = -fy * g.uz * y / g.square;
  for (int j = 0; j < 3; ++j) {
    g.mu[j] = (g.Ju[0] * g.camera[j] + g.Ju[2] * g.camera[6 + j]) * g.size[j];
    g.mv[j] = (g.Jv[0] * g.camera[j] + g.Jv[1] * g.camera[3 + j] + g.Jv[2] * g.camera[6 + j]) * g.size[j];
  }
}

template <class T>
PANOLOG_HD void cross(const T a[3], const T b[3], T out[3]) {
  for (int i = 0; i < 3; ++i) out[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

// det(MMᵀ + sI) without cancellation: Lagrange's identity for the Gram determinant, all terms positive.
template <class T>
PANOLOG_HD T determinant(const Geometry<T>& g, T tr) {
  T normal[3];
  cross(g.mu, g.mv, normal);
  return dot3(normal, normal) + kLowPass * tr + kLowPass * kLowPass;
}

template <class T>
PANOLOG_HD void view_direction(const Geometry<T>& g, const Camera& cam, T d[3]) {  // in the world
  const float* R = cam.rotation;
  for (int i = 0; i < 3; ++i) d[i] = (R[i] * g.point[0] + R[3 + i] * g.point[1] + R[6 + i] * g.point[2]) / g.distance;
}

// Whether all parameters are finite, and the quaternion has a direction.
template <class T>
PANOLOG_HD MaskOf<T> usable(const Parameters<T>& p, int sh_count, const Geometry<T>& g) {
  return finite(p.mean, 3) & finite(p.quat, 4) & finite(p.scale, 3) & finite(&p.opacity, 1) & finite(p.sh0, 3) &
         finite(p.shN, 3 * (sh_count - 1)) & (g.norm > kLeastNorm);
}

// Neither visible nor invalid means hidden: too near, or too faint for any pixel.
template <class T>
struct Visibility {
  MaskOf<T> visible, invalid;
};

// `given`: what came in is usable; `regular`, `colored`: the sizes and the colour that follow from it are finite.
template <class T>
PANOLOG_HD Visibility<T> visibility_of(const Geometry<T>& g, const Camera& cam, T opacity, MaskOf<T> given,
                                       MaskOf<T> regular, MaskOf<T> colored) {
  const MaskOf<T> far = g.distance > cam.near, bright = opacity >= kAlphaMin;
  const MaskOf<T> drawable = given & far & regular & bright;
  // the order matters: a Gaussian that is too near is hidden even if its covariance overflows
  const MaskOf<T> visible = drawable & colored, invalid = (!given) | (far & !regular) | (drawable & !colored);
  return {visible, invalid};
}

// The colour of the splat, and whether it is finite.
template <class T>
PANOLOG_HD MaskOf<T> color_of(const Parameters<T>& p, const T d[3], int sh_count, SplatOf<T>& s) {
  T Y[16], value[3];
  sh_basis(d, sh_count, Y);
  s.clamped = 0;
  for (int ch = 0; ch < 3; ++ch) {
    value[ch] = Y[0] * p.sh0[ch] + 0.5f;
    for (int k = 1; k < sh_count; ++k) value[ch] += Y[k] * p.shN[3 * (k - 1) + ch];
    s.clamped += select(value[ch] < 0, 1 << ch, 0);
    s.color[ch] = select(value[ch] < 0, 0, value[ch]);
  }
  return finite(value, 3);
}

// Eq. 2 and appendix B. `screen` is added to the pixel. `s` is undefined unless the Gaussian is visible.
template <class T>
PANOLOG_HD Visibility<T> project(const Parameters<T>& p, const Camera& cam, int sh_count, const T screen[2],
                                 SplatOf<T>& s) {
  Geometry<T> g;
  geometry_of(p, cam, g);
  const MaskOf<T> given = finite(screen, 2) & usable(p, sh_count, g);
  const T su = dot3(g.mu, g.mu), sv = dot3(g.mv, g.mv), det = determinant(g, su + sv);
  const T sizes[3] = {det, g.norm, 16 * (su + sv)};
  const T opacity = 1 / (1 + exp(-p.opacity));
  const T var_u = su + kLowPass, cov = dot3(g.mu, g.mv), var_v = sv + kLowPass;
  s.a = -0.5f * kLog2E * var_v / det, s.slope = cov / var_v, s.c = -0.5f * kLog2E / var_v;
  s.u = cam.width / (2 * kPi) * atan2(g.point[0], g.point[2]) + 0.5f * cam.width + screen[0];
  s.v = cam.height / kPi * atan2(g.point[1], g.root) + 0.5f * cam.height + screen[1];
  s.log2_opacity = log2(opacity);
  const T room = 2 / kLog2E * (s.log2_opacity - kLog2AlphaMin);  // of the quadratic form
  const T cut = select(room > 0, room, 0) + kCutSlack;
  s.reach = sqrt(cut * var_v), s.half = sqrt(cut * var_u);
  s.tip = cov / var_u * s.half, s.waist = sqrt(cut * (det / var_v));
  s.distance = g.distance;
  s.inverse_depth = 1 / g.distance;
  T d[3];
  view_direction(g, cam, d);
  const MaskOf<T> colored = color_of(p, d, sh_count, s);
  return visibility_of<T>(g, cam, opacity, given, finite(sizes, 3), colored);
}

}  // namespace panolog
