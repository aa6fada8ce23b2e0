// A reference trajectory between two of its points in a field map, so that wires between them need no steps
// of their own.
//
// The rows are the polynomials of third degree along the path with the values and slopes of both ends. With a
// turn f on it, a row is off by f^4/384 of itself: 4e-6 for 66 mm at a radius of 330 mm.
#pragma once

#include "kalman/helix_motion.hpp"
#include "motion/path_span.hpp"

namespace cgemit {

template <class T>
class FieldSpan {
 public:
  using Point = FieldHelixPoint<T>;
  using Row = typename FieldDerivatives<T>::Row;

  // `path`: mm; 0 in lanes without a span.
  FieldSpan(const Point& from, const FieldDerivatives<T>& by_from, const Point& to,
            const FieldDerivatives<T>& by_to, const T& bend, const T& path)
      : track_(from, to, bend, path), here_(track_.start()) {
    const End start(from, by_from, path), end(to, by_to, path);
    across_ = {start.across, start.across_by, end.across, end.across_by};
    z_ = {start.z, start.z_by, end.z, end.z_by};
  }

  // To the closest approach to a wire. Returns the lanes of `who` that have it on the span or little beyond.
  mask_of<T> approach(const WireOf<T>& wire, const mask_of<T>& who) {
    return track_.approach(wire, here_, who);
  }

  Passage<T> passage() const {
    const auto& [length, x, t] = here_;
    const T per = 1.0 / sqrt(t.x * t.x + t.y * t.y), u = track_.share(here_), v = 1.0 - u;
    const T to = u * u * (3.0 - 2.0 * u), by_first = u * v * v, by_last = -u * u * v;
    const auto at = [&](const std::array<Row, 4>& course) {
      const auto& [start, first, end, last] = course;
      Five<T> row;
      for (std::size_t i = 0; i < 5; ++i)
        row.v[i] = start[i] + to * (end[i] - start[i]) + by_first * first[i] + by_last * last[i];
      return row;
    };
    Passage<T> p{};
    p.at = {x.x, x.y, x.z, per * t.x, per * t.y, per * t.z, T(0.0)};
    p.rows.across = at(across_);
    p.rows.along_z = at(z_);
    return p;
  }

 private:
  // With derivatives by the share of the path.
  struct End {
    Row across, across_by, z, z_by;

    End(const Point& p, const FieldDerivatives<T>& by, const T& path) : across(by.across), z(by.z) {
      const T arc = path / sqrt(1.0 + p.tanl * p.tanl);
      for (std::size_t i = 0; i < 5; ++i) {
        across_by[i] = arc * by.psi[i];
        z_by[i] = arc * (by.tanl[i] - p.tanl * p.w * by.across[i]);
      }
    }
  };

  PathSpan<T> track_;
  typename PathSpan<T>::Place here_;  // where the last wire was passed
  std::array<Row, 4> across_, z_;     // at the start and its slope, at the end and its slope
};

}  // namespace cgemit
