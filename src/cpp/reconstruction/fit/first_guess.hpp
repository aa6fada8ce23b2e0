// First values for the sides of wires and for outliers from the first helix, where that helix is good.
#pragma once

#include "common/lanes/math.hpp"
#include "kalman/group.hpp"
#include "matter/kinematics.hpp"

namespace cgemit {

// For a traced group whose tracks start from `helix`; `spread` (mm) is the distance of most hits from it. The
// fit reviews both later. The first values save iterations and keep outliers out of the first one.
template <class T>
void first_guess(Group<T>& group, const PerigeeOf<T>& helix, const SpeciesOf<T>& species, T spread,
                 mask_of<T> who, bool outliers) {
  constexpr double sharp = 0.6;  // mm, two to three times the spread of clean tracks
  who = who & (spread < sharp);
  if (!any(who)) return;
  // Displacement of a track from its first helix by scattering: 13.6 MeV z sqrt(0.02)/(p beta) over half a
  // metre, over sqrt(3).
  const T charge = species.charge, mass = species.mass;
  const T p2 = charge * charge * (1.0 + helix.tanl * helix.tanl) / (helix.kappa * helix.kappa);
  const T wander = 0.56 * charge * sqrt(p2 + mass * mass) / p2;
  // The helix goes through the hits and therefore absorbs most of this displacement.
  const T variance = 2.0 * spread * spread + wander * wander / 16.0;
  T all(0.0), far(0.0);
  for (Slot<T>& slot : group.slots) {
    const mask_of<T> met = who & slot.met;
    T miss = abs(slot.drift - slot.predicted);
    if (slot.view == View::wire) {
      const mask_of<T> open = met & (slot.known_side == 0.0);
      const T weight = hyperbolic_tangent(slot.drift * slot.predicted / (slot.noise + variance));
      slot.weight = select(open, weight, slot.weight);
      miss = select(open, abs(abs(slot.predicted) - slot.drift),
                    abs(slot.known_side * slot.drift - slot.predicted));
    }
    slot.outlier = met & (miss > 3.0 + 3.0 * wander);
    all += select(met, T(1.0), T(0.0));
    far += select(slot.outlier, T(1.0), T(0.0));
  }
  // Outliers of a helix that misses a third of its hits are not used.
  const mask_of<T> believed = mask_of<T>(outliers) & (3.0 * far < all);
  for (Slot<T>& slot : group.slots) slot.outlier = slot.outlier & believed;
}

}  // namespace cgemit
