// Slabs and particles as Python names them: an index; momentum, mass and charge.
#pragma once

#include "detector/detector.hpp"
#include "matter/loss.hpp"

namespace cgemit::bindings {

inline const Slab& slab_of(const Detector& detector, int index) {
  return detector.slabs.at(static_cast<std::size_t>(index));
}

inline Kinematics particle(double p, double mass, double charge) {
  return Kinematics(p, species_of(mass, charge, charge));
}

}  // namespace cgemit::bindings
