// Where a part really is: shifted and turned against the place that the description gives it.
#pragma once

#include <array>

#include "detector/detector.hpp"

namespace cgemit {

template <class T>
std::array<T, 3> turned(const Placement& part, const T& x, const T& y, const T& z) {
  const std::array<double, 9>& m = part.turn;
  return {m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z};
}

// A wire that has moved with its chamber, again by its point at z = 0.
inline Wire moved(const Placement& chamber, const Wire& wire) {
  const std::array<double, 9>& m = chamber.turn;  // from the beam's axes to the chamber's
  const auto back = [&](double x, double y, double z, int k) {
    const auto i = static_cast<std::size_t>(k);
    return m[i] * x + m[i + 3] * y + m[i + 6] * z;
  };
  const double ex = back(wire.ex, wire.ey, wire.ez, 0), ey = back(wire.ex, wire.ey, wire.ez, 1),
               ez = back(wire.ex, wire.ey, wire.ez, 2);
  const double x = back(wire.x, wire.y, 0, 0) + chamber.shift[0],
               y = back(wire.x, wire.y, 0, 1) + chamber.shift[1],
               z = back(wire.x, wire.y, 0, 2) + chamber.shift[2];
  return {x - z * ex / ez, y - z * ey / ez, ex, ey, ez};
}

}  // namespace cgemit
