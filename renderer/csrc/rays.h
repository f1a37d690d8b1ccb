// Exact projection: a Gaussian's response along the ray of each pixel, instead of an affine splat on the panorama.
// A ray r of unit length meets a Gaussian of covariance Σ' and mean m = D·r₀ most closely, in units of its standard
// deviations, at the distance d with d² = P / (l² + κ·P), where
//   P = wᵀS⁻¹w, w the ray's part across r₀ and S the part of Σ'/D² across r₀;
//   l = r₀·r - sᵀS⁻¹w, s the covariance of Σ'/D² between across and along r₀;
//   κ = the variance of Σ'/D² along r₀ where the part across it is known, its Schur complement.
// Σ' = Σ + (D·δ)²I: the low-pass filter is an angle δ, the same in all directions (0.3 px² at the horizon).
// S⁻¹ is factored as in Splat, so P = x² + y² with x, y and l linear in r: no term cancels another.
// Reference: 3DGEER (Huang et al. 2025) derives the response along rays; the form is ours.
#pragma once
#include "footprint.h"
#include "gradients.h"

namespace panolog {

// x² + y² = P·log2(e)/2, so that log2 alpha = log2_opacity - (x² + y²) / (l² + kappa·(x² + y²)). One cache line.
template <class T>
struct alignas(64) RaySplatOf {
  T x[3], y[3], l[3];  // rows: x = x[0]·r₀ + x[1]·r₁ + x[2]·r₂, of a ray in the camera's coordinates
  T kappa, log2_opacity;
  T color[3];
  T inverse_depth, spare;
};
using RaySplat = RaySplatOf<float>;

// Sums over pixels of a = dL/dpower / (l² + kappa·P)² times what the name says, with P = x² + y²; and of the colours.
template <class T>
struct RayGradientOf {
  T power;               // dL/dpower alone
  T xx, xy, yy, xl, yl;  // times l²
  T lx, ly;              // times P: a·l·P·x, a·l·P·y
  T pp;                  // a·P²
  T color[3];
  T inverse_depth;
};
using RayGradient = RayGradientOf<float>;
constexpr int kRayGradientFloats = 13;

constexpr float kRayScale = 0.849321800f;  // √(log2(e) / 2)

PANOLOG_HD float low_pass_angle(const Camera& cam) {  // δ², radians²
  return kLowPass * (kPi / cam.height) * (kPi / cam.height);
}

// A Gaussian in the frame of its own direction.
template <class T>
struct RayGeometry {
  T frame[3][3];  // rows: along the azimuth, along the elevation, r₀; in the camera's coordinates
  T n[3][3];      // rows of frame·W·R·S / D
  T m[2][3];      // the first two of them in the factor's basis: S⁻¹ = FᵀF, m = F·n
  T A, C, k;      // P = A·(u - k·v)² + C·v²
  T root_a, root_c;
  T X, Y;  // l = r₀·r - X·√A·(u - k·v) - Y·√C·v
  T kappa, det, s11, s12, s22;
};

template <class T>
PANOLOG_HD void ray_geometry_of(const Geometry<T>& g, const Camera& cam, RayGeometry<T>& q) {
  const T rho = sqrt(g.point[0] * g.point[0] + g.point[2] * g.point[2]) / g.distance, sine = g.point[1] / g.distance;
  q.frame[0][0] = g.uz, q.frame[0][1] = 0, q.frame[0][2] = -g.ux;
  q.frame[1][0] = -sine * g.ux, q.frame[1][1] = rho, q.frame[1][2] = -sine * g.uz;
  for (int i = 0; i < 3; ++i) q.frame[2][i] = g.point[i] / g.distance;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      q.n[i][j] = (q.frame[i][0] * g.camera[j] + q.frame[i][1] * g.camera[3 + j] + q.frame[i][2] * g.camera[6 + j]) *
                  (g.size[j] / g.distance);
  const T filter = low_pass_angle(cam);
  const T n11 = dot3(q.n[0], q.n[0]), n22 = dot3(q.n[1], q.n[1]), n33 = dot3(q.n[2], q.n[2]);
  T c12[3], c13[3], c23[3], across[3];
  cross(q.n[0], q.n[1], c12), cross(q.n[0], q.n[2], c13), cross(q.n[1], q.n[2], c23);
  q.s11 = n11 + filter, q.s22 = n22 + filter, q.s12 = dot3(q.n[0], q.n[1]);
  q.det = dot3(c12, c12) + filter * (n11 + n22) + filter * filter;
  q.A = q.s22 / q.det, q.C = 1 / q.s22, q.k = q.s12 * q.C;
  q.root_a = sqrt(q.A), q.root_c = sqrt(q.C);
  cross(q.n[1], c12, across);
  for (int j = 0; j < 3; ++j) {
    q.m[0][j] = q.root_a * (across[j] + filter * q.n[0][j]) * q.C;  // n₁ - k·n₂, which would cancel for a needle
    q.m[1][j] = q.root_c * q.n[1][j];
  }
  q.X = dot3(q.m[0], q.n[2]), q.Y = dot3(q.m[1], q.n[2]);
  const T volume = dot3(c12, q.n[2]);
  const T minors = dot3(c12, c12) + dot3(c13, c13) + dot3(c23, c23);
  q.kappa = (volume * volume + filter * (minors + filter * (n11 + n22 + n33 + filter))) / q.det;
}

PANOLOG_HD float magnitude(float x) { return fabsf(x); }

template <class T>
PANOLOG_HD T largest(T a, T b) {
  return select(a > b, a, b);
}

// s.reach and s.half from the factor: the footprint open·P ≤ room·l² (P without kRayScale) holds |w| ≤ radius·l, and l
// is at most t·gain there. So it lies in a box of tangents around r₀: |u| ≤ t·across and |v| ≤ t·along.
template <class T>
PANOLOG_HD void bound_ray(const RayGeometry<T>& q, T room, const T tangent[3], const Camera& cam, SplatOf<T>& s) {
  room = room / (kRayScale * kRayScale);
  const T open = 1 - q.kappa * room, mean = 0.5f * (q.s11 + q.s22), half = 0.5f * (q.s11 - q.s22);
  const T most = room / largest<T>(open, 1e-6f);
  const T rest = 1 - sqrt((mean + sqrt(half * half + q.s12 * q.s12)) * most * dot3(tangent, tangent));
  const MaskOf<T> wide = (open < 1e-6f) | (rest < 1e-3f);  // may cover half of the sphere
  const T gain = 1 / largest<T>(rest, 1e-3f), across = gain * sqrt(q.s11 * most), along = gain * sqrt(q.s22 * most);
  const T sine = q.frame[2][1], cosine = q.frame[1][1];
  const T level = cosine - along * magnitude(sine);  // the least horizontal part: not above 0 beyond a pole
  const MaskOf<T> around = wide | (level < 1e-3f);
  s.half = select(around, 2 * cam.width, cam.width / (2 * kPi) * atan2(across, largest<T>(level, 1e-3f)) + 0.01f);
  // Elevations: parallels bend toward the horizon, so the side toward it is farther away where |u| is large.
  const T down = sine + along * cosine, up = sine - along * cosine;
  const T flat_down = cosine - along * sine, flat_up = cosine + along * sine;
  const T lowest = atan2(down, sqrt(flat_down * flat_down + select(down < 0, across * across, 0)));
  const T highest = atan2(up, sqrt(flat_up * flat_up + select(up < 0, 0, across * across)));
  const T middle = atan2(sine, cosine);
  const T below = select(around & (sine > 0), 0.5f * kPi, lowest) - middle;  // over a pole, all rows up to it
  const T above = middle - select(around & (sine < 0), -0.5f * kPi, highest);
  const T reach = select(wide, 4, largest<T>(below, above));
  s.reach = cam.height / kPi * reach + 0.01f;
}

// The splat of a Gaussian; of `s` its place, colour and bounds: its tiles lie in s.reach rows of pixels and s.half
// columns around s.u, s.v; both are undefined unless it is visible.
template <class T>
PANOLOG_HD Visibility<T> project_ray(const Parameters<T>& p, const Camera& cam, int sh_count, SplatOf<T>& s,
                                     RaySplatOf<T>& ray) {
  Geometry<T> g;
  RayGeometry<T> q;
  geometry_of(p, cam, g);
  ray_geometry_of(g, cam, q);
  const MaskOf<T> given = usable(p, sh_count, g);
  const T opacity = 1 / (1 + exp(-p.opacity));
  s.a = 0, s.slope = 0, s.c = 0, s.tip = 0;
  s.u = cam.width / (2 * kPi) * atan2(g.point[0], g.point[2]) + 0.5f * cam.width;
  s.v =
      cam.height / kPi * atan2(g.point[1], sqrt(g.point[0] * g.point[0] + g.point[2] * g.point[2])) + 0.5f * cam.height;
  ray.log2_opacity = s.log2_opacity = log2(opacity);
  T tangent[3];
  for (int i = 0; i < 3; ++i) {
    const T e = q.root_a * (q.frame[0][i] - q.k * q.frame[1][i]), y = q.root_c * q.frame[1][i];
    tangent[i] = q.X * e + q.Y * y;
    ray.x[i] = kRayScale * e, ray.y[i] = kRayScale * y, ray.l[i] = q.frame[2][i] - tangent[i];
  }
  ray.kappa = q.kappa / (kRayScale * kRayScale);
  bound_ray(q, largest<T>(s.log2_opacity - kLog2AlphaMin, 0) + kCutSlack, tangent, cam, s);
  s.waist = s.half;
  s.distance = g.distance;
  s.inverse_depth = 1 / g.distance, ray.inverse_depth = s.inverse_depth, ray.spare = 0;
  T d[3];
  view_direction(g, cam, d);
  const T sizes[3] = {q.det + q.kappa, g.norm, dot3(ray.x, ray.x) + dot3(ray.y, ray.y) + dot3(ray.l, ray.l)};
  const MaskOf<T> colored = color_of(p, d, sh_count, s);
  for (int ch = 0; ch < 3; ++ch) ray.color[ch] = s.color[ch];
  return visibility_of<T>(g, cam, opacity, given, finite(sizes, 3), colored);
}

// A rectangle of pixel centres as directions: middle + a·across + b·down with |a|, |b| ≤ 1, within `slack` of length.
template <class T>
struct PatchOf {
  T middle[3], across[3], down[3];
  float slack;
};

// From the sines and cosines of its middle, and half its size: radians of azimuth and of elevation.
template <class T>
PANOLOG_HD PatchOf<T> patch_at(T sin_u, T cos_u, T sin_v, T cos_v, float half_u, float half_v) {
  const float bend = half_u + half_v;  // the second derivatives of the direction are at most 1
  return {{cos_v * sin_u, sin_v, cos_v * cos_u},
          {half_u * cos_v * cos_u, 0, -half_u * cos_v * sin_u},
          {-half_v * sin_v * sin_u, half_v * cos_v, -half_v * sin_v * cos_u},
          0.5f * bend * bend};
}

// Half the size of a square of pixels, between the centres of its outer ones, in radians.
PANOLOG_HD float half_azimuth(int side, int width) { return 0.5f * (side - 1) * (2 * kPi / width); }
PANOLOG_HD float half_elevation(int side, int height) { return 0.5f * (side - 1) * (kPi / height); }

// The footprint of a splat is open·(x² + y²) ≤ room·l² with l > 0; how fast x, y and l change at most.
template <class T>
struct RayBoundsOf {
  T x, y, l, open, room;
};
using RayBounds = RayBoundsOf<float>;

template <class T>
PANOLOG_HD T steepness(const T row[3]) {
  return magnitude(row[0]) + magnitude(row[1]) + magnitude(row[2]);
}

template <class T>
PANOLOG_HD T room_of(T log2_opacity) {
  return largest<T>(log2_opacity - kLog2AlphaMin, 0) + kCutSlack;
}

template <class T = float, class S>
PANOLOG_HD RayBoundsOf<T> bounds_of(const S& s) {
  const T room = room_of<T>(s.log2_opacity);
  return {steepness(s.x), steepness(s.y), steepness(s.l), 1 - s.kappa * room, room};
}

// Whether a splat, of which only the rows are used, may meet a patch: never false where it does.
template <class S, class B, class T>
PANOLOG_HD MaskOf<T> may_meet(const S& s, const RayBoundsOf<B>& b, const PatchOf<T>& p) {
  const auto spread = [&](const B row[3]) { return magnitude(dot3(row, p.across)) + magnitude(dot3(row, p.down)); };
  const T x = largest<T>(magnitude(dot3(s.x, p.middle)) - spread(s.x) - b.x * p.slack, 0);
  const T y = largest<T>(magnitude(dot3(s.y, p.middle)) - spread(s.y) - b.y * p.slack, 0);
  const T l = dot3(s.l, p.middle) + spread(s.l) + b.l * p.slack;
  return (l > 0) & (b.room * l * l >= b.open * (x * x + y * y));
}

// From the sums over pixels to the gradients of one Gaussian's parameters. With -d²/2 the power and a as in
// RayGradient, a pixel has dL/dP = -a·l²/2, dL/dl = a·l·P and dL/dκ = a·P²/2; Euler's theorem for functions of degree 0
// makes the sums of l·dL/dl superfluous. `screen` receives dL/d(u, v) as if the footprint moved by pixels and kept its
// shape.
template <class T>
PANOLOG_HD void project_backward(const Parameters<T>& p, const Camera& cam, int sh_count, const SplatOf<T>& s,
                                 const RayGradientOf<T>& in, const ParameterGradients<T>& out) {
  Geometry<T> g;
  RayGeometry<T> q;
  geometry_of(p, cam, g);
  ray_geometry_of(g, cam, q);
  const float* R = cam.rotation;
  const float scale = kRayScale, square = scale * scale;
  const T xx = in.xx / square, xy = in.xy / square, yy = in.yy / square;  // in units without kRayScale
  const T xl = in.xl / scale, yl = in.yl / scale;
  const T lx = in.lx / (scale * square), ly = in.ly / (scale * square), pp = in.pp / (square * square);
  const T opacity = 1 / (1 + exp(-p.opacity));
  *out.opacity = in.power * (1 - opacity);

  // The direction: as r₀ turns by θ toward the azimuth or the elevation, w loses θ·t and t = r₀·r gains θ·w. First the
  // sums of dL/dx and dL/dy, with l a function of them, times x, y and t.
  const T gxx = -xx - q.X * lx, gxy = -xy - q.X * ly, gyx = -xy - q.Y * lx, gyy = -yy - q.Y * ly;
  const T gxt = -xl - q.X * (xx + yy) + q.X * gxx + q.Y * gxy;
  const T gyt = -yl - q.Y * (xx + yy) + q.X * gyx + q.Y * gyy;
  T turn[2];
  turn[0] = -q.root_a * gxt + lx / q.root_a + q.k * ly / q.root_c;
  turn[1] = q.k * q.root_a * gxt - q.root_c * gyt + ly / q.root_c;
  const T level = q.frame[1][1];
  out.screen[0] = turn[0] * level * (2 * kPi / cam.width), out.screen[1] = turn[1] * (kPi / cam.height);

  // The shape: gradients of the rows n, from dS⁻¹ = -S⁻¹·dS·S⁻¹ in the factor's basis. `left` is what the third row has
  // across the first two, `both` what l moves in them.
  T dn[3][3];
  for (int j = 0; j < 3; ++j) {
    const T m0 = q.m[0][j], m1 = q.m[1][j];
    const T left = q.n[2][j] - q.X * m0 - q.Y * m1, both = lx * m0 + ly * m1;
    const T q0 = xx * m0 + xy * m1 + q.X * both - (lx + pp * q.X) * left;
    const T q1 = xy * m0 + yy * m1 + q.Y * both - (ly + pp * q.Y) * left;
    dn[0][j] = q.root_a * q0, dn[1][j] = q.root_c * q1 - q.k * dn[0][j];
    dn[2][j] = pp * left - both;
  }
  turn[0] += dot3(dn[2], q.n[0]) - dot3(dn[0], q.n[2]);
  turn[1] += dot3(dn[2], q.n[1]) - dot3(dn[1], q.n[2]);
  const T nearer = dot3(dn[0], q.n[0]) + dot3(dn[1], q.n[1]) + dot3(dn[2], q.n[2]);  // -D·dL/dD

  T dM[9], dR[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      dM[3 * i + j] =
          (q.frame[0][i] * dn[0][j] + q.frame[1][i] * dn[1][j] + q.frame[2][i] * dn[2][j]) * (g.size[j] / g.distance);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) dR[3 * i + j] = R[i] * dM[j] + R[3 + i] * dM[3 + j] + R[6 + i] * dM[6 + j];
  for (int j = 0; j < 3; ++j)
    out.scale[j] = dR[j] * g.world[j] + dR[3 + j] * g.world[3 + j] + dR[6 + j] * g.world[6 + j];
  quaternion_backward(g, dR, out.quat);

  T point[3], d[3], direction[3];
  for (int i = 0; i < 3; ++i)
    point[i] =
        (turn[0] * q.frame[0][i] + turn[1] * q.frame[1][i] - (nearer + in.inverse_depth / g.distance) * q.frame[2][i]) /
        g.distance;
  view_direction(g, cam, d);
  SplatGradientOf<T> colors;
  for (int ch = 0; ch < 3; ++ch) colors.color[ch] = in.color[ch];
  color_backward(p, s, colors, d, sh_count, out, direction);
  const T along = dot3(direction, d);
  for (int i = 0; i < 3; ++i)
    out.mean[i] =
        R[i] * point[0] + R[3 + i] * point[1] + R[6 + i] * point[2] + (direction[i] - along * d[i]) / g.distance;
  if (out.motion) motion_of(g, cam, point, out.mean, dM, out.motion);
}

}  // namespace panolog
