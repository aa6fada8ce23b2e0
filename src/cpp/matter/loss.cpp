#include "matter/loss.hpp"

#include <algorithm>

#include "matter/radiation.hpp"
#include "motion/helix.hpp"

namespace cgemit {

void prepare_loss(Detector& detector, CoreLoss choice, bool radiation, double momentum_error) {
  constexpr double everything = 1e30, half_maximum = 4.018 / 2.3548;
  static const double most_probable = std::exp(0.2);
  const auto core = [](double sigmas) { return LossCut{sigmas * sigmas, sigmas * sigmas}; };
  LossCuts& cuts = detector.loss;
  switch (choice) {
    case CoreLoss::truncated:
      cuts = {core(core_sigmas), core(light_core_sigmas), 1};
      break;
    case CoreLoss::mean:
      cuts = {{everything, 0}, {everything, 0}, 1};
      break;
    case CoreLoss::most_probable:
      cuts = {{most_probable, 0}, {most_probable, 0}, half_maximum * half_maximum / most_probable};
      break;
  }
  cuts.radiation = radiation ? 1 : 0;
  detector.errors = MomentumErrors(momentum_error);
}

double momentum_error(const MomentumErrors& errors, double p, double charge, double beta, double tanl) {
  constexpr double most = 0.1;  // larger errors hold all losses that heavy particles have
  const std::size_t n_tanl = errors.tanl.size();
  if (n_tanl == 0) return errors.constant;
  const std::size_t n = errors.hits.size() / n_tanl;
  const double pt = p / (charge * std::sqrt(1 + tanl * tanl));
  const double slope = errors.tanl.front() < 0 ? tanl : std::abs(tanl);
  if (!(pt > 0)) return errors.constant;  // a lane without a track
  const double at =
      std::clamp((std::log(pt) - errors.log_first) / errors.step, 0.0, static_cast<double>(n - 1));
  const auto i = std::min(static_cast<std::size_t>(at), n - 2);
  const auto next = std::ranges::upper_bound(errors.tanl, slope);
  const auto j =
      std::clamp<std::size_t>(static_cast<std::size_t>(next - errors.tanl.begin()), 1, n_tanl - 1) - 1;
  const double u = at - static_cast<double>(i);
  const double v = std::clamp((slope - errors.tanl[j]) / (errors.tanl[j + 1] - errors.tanl[j]), 0.0, 1.0);
  const auto between = [&](const std::vector<double>& column) {
    const double* here = column.data() + j * n + i;
    return (1 - v) * (here[0] + u * (here[1] - here[0])) + v * (here[n] + u * (here[n + 1] - here[n]));
  };
  return std::min(std::hypot(between(errors.hits) * pt, between(errors.scattered) / beta), most);
}

void set_unseen(Slab& slab, double share) {
  // The cut of a slab is at most this many times the track's: losses that are unseen to so little count for
  // nothing. About the last hit and behind, losses are cut as for a state there.
  constexpr double most_scaled = 10, least = 0.01;
  slab.unseen = share;
  slab.per_unseen = share > least ? std::min(1 / share, most_scaled) : 1;
  slab.log_per_unseen = std::log(slab.per_unseen);
}

void share_loss(Detector& detector, std::span<const double> variances, const Kinematics& start, double tanl) {
  const TrackMatter track = track_matter(detector, tanl, start);
  const double sec = std::sqrt(1 + tanl * tanl), kappa = sec / start.p;
  const double w = curvature(detector.bz, kappa);
  // Slabs on one side of z = 0 may not be crossed: their like is the next slab that is.
  const auto is_crossed = [&](std::size_t i) {
    const Ends& ends = detector.slabs[i].ends;
    return (ends.low < 0 && ends.high > 0) || variances[i] > 0;
  };
  Kinematics k = start;
  for (std::size_t i = 0; i < variances.size(); ++i) {
    Slab& slab = detector.slabs[i];
    if (!is_crossed(i)) continue;
    const double slant = std::min(0.5 * std::abs(w) * slab.radius, 0.99);
    const LossMoments moments = core_loss(slab, sec / std::sqrt(1 - slant * slant), k, track);
    if (!(moments.variance > 0) || slab.unseen == 0) continue;
    const double noise = kappa * std::sqrt(moments.variance) * k.energy * k.per_p * k.per_p;
    set_unseen(slab, std::min(std::sqrt(variances[i]) / noise, 1.0));
    k = k.after_loss(moments.loss);
  }
  for (std::size_t i = 0; i < variances.size(); ++i) {
    Slab& slab = detector.slabs[i];
    if (is_crossed(i)) continue;
    double apart = HUGE_VAL, share = slab.unseen;
    for (std::size_t n = 0; n < variances.size(); ++n) {
      const Slab& other = detector.slabs[n];
      const double off = std::abs(other.radius - slab.radius);
      if (off >= apart || !is_crossed(n) || other.filler != slab.filler) continue;
      apart = off;
      share = other.unseen;
    }
    set_unseen(slab, share);
  }
}

double light_spectrum_share(const Kinematics& k, double transfer) {
  const double e = transfer / k.kinetic();
  if (k.projectile == Projectile::electron) {  // Moller; ICRU Report 37, eq. 2.5
    const double other = e / (1 - e), tau = (k.gamma - 1) / k.gamma;
    return 1 + other * other + tau * tau * e * e - (2 * k.gamma - 1) / (k.gamma * k.gamma) * other;
  }
  const double y = 1 / (k.gamma + 1), u = 1 - 2 * y;  // Bhabha; ICRU Report 37, eq. 2.7
  return 1 - k.beta2 * e * (2 - y * y - e * (u * (3 + y * y) - e * u * u * (1 + u - e * u)));
}

double light_restricted_loss(const Slab& slab, double path, const Kinematics& k, double cut) {
  const double bracket = light_bracket(slab, k, std::min(cut, k.w_max()));
  return std::max(slab.xi * path * k.charge2_per_beta2 * bracket, 0.0);
}

}  // namespace cgemit
