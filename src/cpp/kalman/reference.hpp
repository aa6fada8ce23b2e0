// The reference helix from the origin outward: measurement rows and noise vectors in the coordinates of the
// origin.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "detector/detector.hpp"
#include "kalman/filter.hpp"

namespace cgemit {

enum class View : std::uint8_t { x = 0, v = 1, wire = 2 };

// One scalar measurement. Ordered from the beam line outward within a track.
struct Hit {
  View view;
  std::int32_t layer;    // index into the detector's cgem or wires
  std::int32_t element;  // sheet or wire
  std::int32_t size;     // strips in the cluster; 0: no strips
  double value;          // mm: X or V on the sheet, or drift distance
  double sigma;          // mm
};

// Where the reference meets a hit.
struct Crossing {
  double predicted;  // mm, in the hit's own coordinate; wires: signed distance
  double extent;     // mm, projection of the path in the drift gap on X or V; 0 for wires
};

// Flight parameters at the origin: psi is the flight azimuth, phi0 + pi/2.
struct Perigee {
  double d, psi, kappa, z0, tanl;
};

struct Reference {
  std::vector<Element> elements;    // outward; rows carry h and hit, residual and variance are the caller's
  std::vector<Crossing> crossings;  // one per hit
  std::size_t reached;              // hits that the reference meets; the rest lies beyond its turning point
  bool stopped;                     // it ran out of momentum
};

// Follows the helix through the material as far as the last hit. Scattering and loss are the moments of
// `matter/`.
void trace(const Detector& detector, const Perigee& start, double mass, std::span<const Hit> hits,
           Reference& out);

}  // namespace cgemit
