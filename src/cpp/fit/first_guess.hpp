// Sides of wires and outliers as the first helix shows them, where it is known to be good.
#pragma once

#include "kalman/group.hpp"

namespace cgemit {

template <class T>
T hyperbolic_tangent(T x) {
  const T a = smaller(abs(x), 20.0);  // 1 to rounding beyond
  return copysign(1.0 - 2.0 / (1.0 + exp(2.0 * a)), x);
}

// For a traced group whose tracks start from `helix`, which most hits miss by `spread` (mm). Both guesses are
// looked at again in the fit: it is spared the iterations in which a first helix finds out, and outliers do
// not pull it.
template <class T>
void first_guess(Group<T>& group, const PerigeeOf<T>& helix, T mass, T spread, mask_of<T> who,
                 bool outliers) {
  constexpr double sharp = 0.6;  // mm, two to three times what clean tracks have
  who = who & (spread < sharp);
  if (!any(who)) return;
  // How far scattering takes a track off its first helix: 13.6 MeV sqrt(0.02)/(p beta) over half a metre,
  // over sqrt(3).
  const T p2 = (1.0 + helix.tanl * helix.tanl) / (helix.kappa * helix.kappa);
  const T wander = 0.56 * sqrt(p2 + mass * mass) / p2;
  // The helix follows most of that: it goes through the hits.
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
  // A helix that misses a third of its hits is not to be trusted with that.
  const mask_of<T> believed = mask_of<T>(outliers) & (3.0 * far < all);
  for (Slot<T>& slot : group.slots) slot.outlier = slot.outlier & believed;
}

}  // namespace cgemit
