// Circle through points in the transverse plane, from their moments, without iteration.
#pragma once

#include <cmath>
#include <optional>

#include "common/lanes/pack.hpp"

namespace cgemit {

// A circle or a straight line, flown through in direction u at its closest approach to the beam line.
struct Circle {
  double w, d, ux, uy;  // curvature (1/mm), signed distance (mm) and direction as in `Perigee`

  double x() const { return d * uy; }
  double y() const { return -d * ux; }

  // Distance near the circle, positive to the left of the flight: (R^2 - distance^2 from the centre)/(2 R).
  template <class T>
  T algebraic(const T& px, const T& py) const {
    return (1 - w * d) * (py * ux - px * uy) + d * (1 - 0.5 * w * d) - 0.5 * w * (px * px + py * py);
  }

  template <class T>
  struct Vector {
    T x, y;
  };
  // Gradient of `algebraic`.
  template <class T>
  Vector<T> gradient(const T& px, const T& py) const {
    const double n = 1 - w * d;
    return {-n * uy - w * px, n * ux - w * py};
  }
  // Unit vector of the gradient near the circle, from one Newton step starting at 1; it points to the left of
  // the flight.
  template <class T>
  Vector<T> leftward(const T& px, const T& py) const {
    const Vector<T> g = gradient(px, py);
    const T scale = 1.5 - 0.5 * (g.x * g.x + g.y * g.y);
    return {g.x * scale, g.y * scale};
  }
  // Distance to the left of the flight for a point near the circle, mm; the sign is right everywhere.
  template <class T>
  T left(const T& px, const T& py) const {
    const T g = algebraic(px, py);
    return g / (1.0 - 0.5 * w * g);
  }
};

// Weighted moments of points.
template <class T>
class Moments {
 public:
  void add(const T& x, const T& y, const T& weight) {
    const T z = x * x + y * y, wx = weight * x, wy = weight * y, wz = weight * z;
    n_ += weight;
    x_ += wx;
    y_ += wy;
    z_ += wz;
    xx_ += wx * x;
    xy_ += wx * y;
    yy_ += wy * y;
    xz_ += wx * z;
    yz_ += wy * z;
    zz_ += wz * z;
  }

  // At least three points. Least squares of k r^2 - (y ux - x uy) - e over k, e and the direction (V.
  // Karimaki, NIM A 305 (1991) 187). This is the distance to the circle for points whose distance is much
  // smaller than its radius. The flight goes away from the beam line.
  std::optional<Circle> circle() const {
    const double per = 1 / sum(n_), x = sum(x_) * per, y = sum(y_) * per, z = sum(z_) * per;
    const double xx = sum(xx_) * per - x * x, xy = sum(xy_) * per - x * y, yy = sum(yy_) * per - y * y;
    const double xz = sum(xz_) * per - x * z, yz = sum(yz_) * per - y * z, zz = sum(zz_) * per - z * z;
    const double sine = 2 * (zz * xy - xz * yz), cosine = zz * (xx - yy) - xz * xz + yz * yz;
    const double size = std::sqrt(sine * sine + cosine * cosine);
    if (!(size > 0) || !(zz > 1e-12 * z * z)) return std::nullopt;
    // Half of the angle. Of the two directions along the line, the one away from the beam line is taken.
    const double larger = std::sqrt(0.5 + 0.5 * std::abs(cosine) / size),
                 smaller = 0.5 * sine / (size * larger);
    double ux = cosine > 0 ? larger : smaller, uy = cosine > 0 ? smaller : larger;
    if (ux * x + uy * y < 0) {
      ux = -ux;
      uy = -uy;
    }
    const double k = (yz * ux - xz * uy) / zz;
    const double e = k * z - (y * ux - x * uy);
    const double root = std::sqrt(1 + 4 * k * e);
    if (!(root > 0) || !std::isfinite(root)) return std::nullopt;
    return Circle{2 * k / root, 2 * e / (1 + root), ux, uy};
  }

 private:
  T n_ = 0.0, x_ = 0.0, y_ = 0.0, z_ = 0.0, xx_ = 0.0, xy_ = 0.0, yy_ = 0.0, xz_ = 0.0, yz_ = 0.0, zz_ = 0.0;
};

}  // namespace cgemit
