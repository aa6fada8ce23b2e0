#include "reconstruction/find/trace_back.hpp"

#include <cmath>

#include "kalman/slab_crossing.hpp"

namespace cgemit {

Perigee trace_back(const Detector& detector, const Perigee& helix, double radius, const Species& species) {
  const double per_kappa = curvature(detector.bz, 1.0), sec_lambda = std::sqrt(1 + helix.tanl * helix.tanl);
  HelixPoint at = closest_point(helix, per_kappa);
  double arc = 0;
  if (!step_to_cylinder(at, radius, arc)) return helix;
  Kinematics now(species.charge * sec_lambda / std::abs(helix.kappa), species);
  const TrackMatter track = track_matter(detector, at.tanl, now);
  for (std::size_t i = detector.slabs.size(); i-- > 0;) {
    const Slab& slab = detector.slabs[i];
    if (slab.radius >= at.radius()) continue;
    if (!step_to_cylinder(at, slab.radius, arc)) break;  // the closest approach lies between two slabs
    if (slab.ends.miss(at.z)) continue;
    const Kinematics before =
        cross_inward(slab, path_factor(slab, sec_lambda, std::abs(at.outward())), now, track).before;
    at.w *= now.p / before.p;
    now = before;
  }
  const PivotApproach line = approach_pivot(at, 0, 0);
  return {line.d, wrap_angle(std::atan2(at.uy, at.ux) + line.turn), at.w / per_kappa,
          at.z + at.tanl * line.arc, at.tanl};
}

}  // namespace cgemit
