// Where a track ends.
//
// Parts are cylinders of finite length, each with its own. A track beyond an end of a part misses this part
// only. Where it misses the gas of the drift chamber on its way out along the beam, it has left the chamber
// and meets no more of its wires and gas, unless this is a short inner chamber inside of a longer one. It
// then goes on to the parts outside, and ends at the first part that it misses with no other part ahead.
#pragma once

#include <cmath>
#include <cstddef>

#include "detector/detector.hpp"
#include "motion/helix.hpp"

namespace cgemit {

template <class T>
struct Reach {
  mask_of<T> chamber{true};  // lanes that have not left the drift chamber
  mask_of<T> parts{true};    // lanes with parts ahead

  // The lanes `who` are at the radius of a slab and beyond an end of it. `back`: parts inside of the slab are
  // ahead, too, of tracks that move inward or may turn back.
  void miss(const Detector& detector, const Slab& slab, const HelixPointOf<T>& at, mask_of<T> who,
            bool back) {
    const T along = select(at.tanl < 0.0, -at.z, at.z);
    if (slab.filler == Filler::chamber_gas && !slab.reopens)
      chamber = chamber & !(who & (along > slab.ends.ahead(at.tanl)));
    who = who & !chamber;
    if (!any(who)) return;
    // The transverse path between two radii is at least their difference, and the track moves by tanl along
    // the beam meanwhile. In a field map tanl changes on the way, by less than there is room left for.
    const double least = detector.field.is_uniform() ? 1.0 : 0.8;
    mask_of<T> more(false);
    for (std::size_t i = back ? 0 : slab.parts_inside; i < detector.parts.size(); ++i) {
      const double apart = std::abs(detector.parts[i].radius - slab.radius);
      more = more | (along + (least * apart) * abs(at.tanl) <= detector.parts[i].ends.ahead(at.tanl));
    }
    parts = parts & ((!who) | more);
  }
};

}  // namespace cgemit
