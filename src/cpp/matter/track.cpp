#include "matter/track.hpp"

namespace cgemit {

TrackMatter total_matter(const Detector& detector, double tanl) {
  TrackMatter total;
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
  // Logarithms of an empty detector exist, too.
  total.log_xi = std::log(std::max(total.xi, 1e-15));
  total.log_chi_c2 = std::log(std::max(total.chi_c2, 1e-15));
  return total;
}

}  // namespace cgemit
