#include "matter/moments.hpp"

namespace cgemit {

TrackMatter total_matter(const Detector& detector, double tanl) {
  double x0 = 0, xi = 0;
  for (const Slab& slab : detector.slabs) {
    if (std::abs(tanl) * slab.radius <= slab.half_length) {
      x0 += slab.x0;
      xi += slab.xi;
    } else if (slab.ends) {
      break;
    }
  }
  const double path = std::sqrt(1 + tanl * tanl);
  return {std::max(x0, 1e-9) * path, std::max(xi, 1e-12) * path};
}

LossMoments core_loss(const Slab& slab, double path, const Kinematics& k, const TrackMatter& track) {
  const double xi = slab.xi * path * k.per_beta2, wanted = core_cut * track.xi * k.per_beta2;
  const double w_max = k.w_max(), cut = std::min(wanted, w_max);
  static const double log_constant = std::log(2 * electron_mass * core_cut);
  const LogTerm term = log_term(slab, k.log_bg);
  // ln(2 m_e (beta gamma)^2 cut), where the cut holds 1/beta^2.
  const double log_cut = wanted < w_max ? log_constant + track.log_xi + 2 * k.log_gamma
                                        : std::log(2 * electron_mass * w_max) + 2 * k.log_bg;
  const double spin = k.beta2 * cut / w_max;
  const double bracket = log_cut - k.beta2 - spin + term.value;
  if (!(bracket > 0)) return {0, 0, 0};
  // Per ln(p), with 1/gamma^2 = 1 - beta^2: 1/beta^2 falls by 2/gamma^2, (beta gamma)^2 grows by 2, beta^2 by
  // 2 beta^2/gamma^2, the cut follows 1/beta^2 or w_max.
  const double per_gamma2 = 1 - k.beta2, ratio = electron_mass * k.per_mass;
  const double grow_w_max = 2 - 2 * ratio * k.gamma * k.beta2 / (1 + 2 * k.gamma * ratio + ratio * ratio);
  const double grow_bracket = wanted < w_max ? 2 - 2 * per_gamma2 * (1 + k.beta2) + spin * grow_w_max
                                             : 2 + grow_w_max - 4 * k.beta2 * per_gamma2;
  const double per_log_p = -2 * per_gamma2 * bracket + grow_bracket + term.slope;
  return {xi * bracket, xi * cut * (1 - 0.5 * spin), xi * per_log_p / k.p};
}

}  // namespace cgemit
