// One reference helix with its hits, for inspection of rows and noise vectors.
#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "kalman/trajectory.hpp"

namespace cgemit {

// The crossing of the reference with a hit.
struct Crossing {
  double predicted;  // mm, in the hit's own coordinate; wires: signed distance
  double extent;     // mm, projection of the path in the drift gap on X or V; 0 for wires
};

// Ordered from the origin outward.
struct Reference {
  std::vector<Vector5> rows, noise;
  std::vector<double> noise_units;  // one per noise vector: the kinks in units of it
  std::vector<Crossing> crossings;  // one per row
  std::size_t reached;              // hits that the reference meets; the others lie beyond its turning point
  bool stopped;                     // it ran out of momentum
};

// Follows the helix through the material up to the last hit. `kinks`: angles for every slab, or none.
Reference trace(const Detector& detector, const Perigee& start, double mass, std::span<const Hit> hits,
                std::span<const double> kinks);

}  // namespace cgemit
