// A reference trajectory between two of its points in a field map, so that wires between them need no steps
// of their own.
//
// Along the path the position is the polynomial of fifth degree with the position, direction and curvature of
// both ends, and the rows are those of third degree with the values and slopes of both ends. With a length h
// and a turn f on it, the position is off by h f^5/46 080 and a row by f^4/384 of itself: 5e-10 mm and 4e-6
// for 66 mm at a radius of 330 mm.
#pragma once

#include "kalman/helix_motion.hpp"
#include "motion/field_motion.hpp"
#include "motion/wire.hpp"

namespace cgemit {

template <class T>
class FieldSpan {
 public:
  using Point = FieldHelixPoint<T>;
  using Row = typename FieldDerivatives<T>::Row;

  // `path`: mm; 0 in lanes without a span.
  FieldSpan(const Point& from, const FieldDerivatives<T>& by_from, const Point& to,
            const FieldDerivatives<T>& by_to, const T& bend, const T& path)
      : path_(path), per_path_(1.0 / select(path != 0.0, path, T(1.0))) {
    const End start(from, by_from, bend, path), end(to, by_to, bend, path);
    const Vec3<T> x = end.x - start.x - start.t - 0.5 * start.a, t = end.t - start.t - start.a,
                  a = end.a - start.a;
    terms_ = {start.x,
              start.t,
              0.5 * start.a,
              10.0 * x - 4.0 * t + 0.5 * a,
              -15.0 * x + 7.0 * t - a,
              6.0 * x - 3.0 * t + 0.5 * a};
    across_ = {start.across, start.across_by, end.across, end.across_by};
    z_ = {start.z, start.z_by, end.z, end.z_by};
    x_ = from_point(from);
    t_ = per_path_ * start.t;
  }

  // To the closest approach to a wire. Returns the lanes of `who` that have it on the span or little beyond.
  mask_of<T> approach(const WireOf<T>& wire, const mask_of<T>& who) {
    const Vec3<T> origin{wire.x, wire.y, T(0.0)}, along{wire.ex, wire.ey, wire.ez};
    // Straight on from the wire before.
    T length = length_;
    {
      const Vec3<T> off = x_ - origin;
      const T te = dot(t_, along);
      length = length - (dot(off, t_) - dot(off, along) * te) / (1.0 - te * te);
    }
    mask_of<T> moving = who;
    Vec3<T> x = x_, t = t_;
    for (int iteration = 0; iteration < most_wire_steps && any(moving); ++iteration) {
      const T u = length * per_path_;
      const auto& [c0, c1, c2, c3, c4, c5] = terms_;
      const Vec3<T> there = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))));
      const Vec3<T> flight =
          per_path_ * (c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + (5.0 * u) * c5))));
      const Vec3<T> turn =
          (per_path_ * per_path_) * (2.0 * c2 + u * (6.0 * c3 + u * (12.0 * c4 + (20.0 * u) * c5)));
      const Vec3<T> off = there - origin;
      const T te = dot(flight, along), oe = dot(off, along);
      const T slope = 1.0 - te * te + dot(off, turn) - oe * dot(turn, along);
      const T step = select(moving, (oe * te - dot(off, flight)) / slope, T(0.0));
      length += step;
      x = select<T>(moving, there + step * (flight + (0.5 * step) * turn), x);
      t = select<T>(moving, flight + step * turn, t);
      moving = moving & !(abs(step) < brief);
    }
    const T beyond = 0.25 * path_;
    const mask_of<T> found = who & !moving & (length > -beyond) & (length < path_ + beyond);
    length_ = select(found, length, length_);
    x_ = select<T>(found, x, x_);
    t_ = select<T>(found, t, t_);
    return found;
  }

  Passage<T> passage() const {
    const T per = 1.0 / sqrt(t_.x * t_.x + t_.y * t_.y), u = length_ * per_path_, v = 1.0 - u;
    const T to = u * u * (3.0 - 2.0 * u), by_first = u * v * v, by_last = -u * u * v;
    const auto at = [&](const std::array<Row, 4>& course) {
      const auto& [start, first, end, last] = course;
      Five<T> row;
      for (std::size_t i = 0; i < 5; ++i)
        row.v[i] = start[i] + to * (end[i] - start[i]) + by_first * first[i] + by_last * last[i];
      return row;
    };
    Passage<T> p{};
    p.at = {x_.x, x_.y, x_.z, per * t_.x, per * t_.y, per * t_.z, T(0.0)};
    p.rows.across = at(across_);
    p.rows.along_z = at(z_);
    return p;
  }

 private:
  // Longer steps along the track are made again: their third order counts.
  static constexpr double brief = 0.3;  // mm

  // With derivatives by the share of the path.
  struct End {
    Vec3<T> x, t, a;
    Row across, across_by, z, z_by;

    End(const Point& p, const FieldDerivatives<T>& by, const T& bend, const T& path)
        : x(from_point(p)), across(by.across), z(by.z) {
      const T arc = path / sqrt(1.0 + p.tanl * p.tanl);
      t = {arc * p.ux, arc * p.uy, arc * p.tanl};
      a = (path * bend) * cross(t, p.field.b);
      for (std::size_t i = 0; i < 5; ++i) {
        across_by[i] = arc * by.psi[i];
        z_by[i] = arc * (by.tanl[i] - p.tanl * p.w * by.across[i]);
      }
    }
  };
  static Vec3<T> from_point(const HelixPointOf<T>& p) { return {p.x, p.y, p.z}; }

  T path_, per_path_;
  std::array<Vec3<T>, 6> terms_;   // of the position, by powers of the share of the path
  std::array<Row, 4> across_, z_;  // at the start and its slope, at the end and its slope
  Vec3<T> x_, t_;                  // where the last wire was passed
  T length_{0.0};
};

}  // namespace cgemit
