// Sense wires: straight lines between the end plates, and the cells around them.
#pragma once

#include <array>
#include <cmath>

#include "common/angles.hpp"
#include "common/compiler.hpp"
#include "common/lanes/math.hpp"
#include "common/units.hpp"
#include "detector/detector.hpp"

namespace cgemit {

// The straight line between the two ends of a wire, each where it is displaced to.
inline Wire place_wire(const WireLayer& layer, int number) {
  const double nominal = layer.phi_east + number * (2 * pi / layer.cells);
  const double east = nominal + layer.east.rotation, west = nominal - layer.twist + layer.west.rotation;
  double ex = layer.r_end * (std::cos(east) - std::cos(west)) + (layer.east.x - layer.west.x),
         ey = layer.r_end * (std::sin(east) - std::sin(west)) + (layer.east.y - layer.west.y);
  const double ez = 2 * layer.half_length;
  double x = 0.5 * layer.r_end * (std::cos(east) + std::cos(west)) + 0.5 * (layer.east.x + layer.west.x),
         y = 0.5 * layer.r_end * (std::sin(east) + std::sin(west)) + 0.5 * (layer.east.y + layer.west.y);
  if (!layer.shifts.empty()) {
    const WireShift& own = layer.shifts[static_cast<std::size_t>(number)];
    const auto across = [](const WireEndShift& shift, double azimuth) {
      const double c = std::cos(azimuth), s = std::sin(azimuth);
      return std::array{shift.r * c - shift.phi * s, shift.r * s + shift.phi * c};
    };
    const auto at_east = across(own.east, east), at_west = across(own.west, west);
    ex += at_east[0] - at_west[0];
    ey += at_east[1] - at_west[1];
    x += 0.5 * (at_east[0] + at_west[0]);
    y += 0.5 * (at_east[1] + at_west[1]);
  }
  const double length = std::sqrt(ex * ex + ey * ey + ez * ez);
  return {x - layer.middle * (ex / ez), y - layer.middle * (ey / ez), ex / length, ey / length, ez / length};
}

// Wires are spread over the memory.
inline void prefetch(const Wire& wire) {
  prefetch(static_cast<const void*>(&wire.x));
  prefetch(static_cast<const void*>(&wire.ez));  // may be in the next cache line
}

// Distance of the layer's wires from the beam line at z; smallest in the middle of a stereo layer.
template <class T>
T wire_radius(const WireLayer& layer, const T& z) {
  if (layer.flare == 0) return T(layer.r_end);
  const T along = z - layer.middle;
  return sqrt(layer.waist + layer.flare * along * along);
}

// Error of a drift distance that is not negative, mm.
template <class T>
T drift_error(const WireLayer& layer, const T& distance) {
  T error = layer.sigma + layer.sigma_slope * distance;
  for (const ErrorRamp& ramp : layer.ramps) error += ramp.change * larger(distance - ramp.from, T(0.0));
  return error;
}

// Azimuth of a wire at z, minus that in its middle.
template <class T>
T wire_azimuth(const WireLayer& layer, const T& z) {
  if (layer.twist_per_z == 0) return T(0.0);
  const T t = (z - layer.middle) * layer.twist_per_z;
  return t * atan_over(t);
}

// Azimuth of a point in units of cells, 0 at wire 0. The nearest whole number is the cell of the point.
template <class T>
T cell_coordinate(const WireLayer& layer, const T& phi, const T& z) {
  const T wire_0 = layer.phi_east - 0.5 * layer.twist + wire_azimuth(layer, z);
  return (phi - wire_0) * layer.per_radian;
}

}  // namespace cgemit
