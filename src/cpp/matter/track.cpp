#include "matter/track.hpp"

namespace cgemit {

TrackMatter total_matter(const Detector& detector, double tanl) {
  TrackMatter total{1e-9, 1e-12, 1e-12};  // logarithms of an empty detector exist, too
  for (const Slab& slab : detector.slabs) {
    if (std::abs(tanl) * slab.radius <= slab.half_length) {
      total.x0 += slab.x0;
      total.xi += slab.xi;
      total.chi_c2 += slab.chi_c2;
    } else if (slab.ends) {
      break;
    }
  }
  const double path = std::sqrt(1 + tanl * tanl);
  total.x0 *= path;
  total.xi *= path;
  total.chi_c2 *= path;
  total.log_xi = std::log(total.xi);
  total.log_chi_c2 = std::log(total.chi_c2);
  return total;
}

}  // namespace cgemit
