#include "matter/sampling.hpp"

#include <algorithm>

namespace cgemit {

namespace {

// Collisions drawn one by one, expected per slab: more where more is lost, so that a track has some tens in
// all.
double hard_collisions(double xi) { return std::clamp(xi / keV, 0.2, 3.0); }

// The uniform numbers of one purpose at one place, one after the other.
class Draws {
 public:
  Draws(const Stream& stream, Purpose purpose, std::uint32_t place)
      : stream_(stream), purpose_(purpose), place_(place) {}
  double next() {
    if (used_ == 4) {
      words_ = stream_.block(purpose_, place_, block_++);
      used_ = 0;
    }
    return open_unit(words_[used_++]);
  }

 private:
  const Stream& stream_;
  Purpose purpose_;
  std::uint32_t place_, block_ = 0;
  std::size_t used_ = 4;
  Block words_{};
};

}  // namespace

double sample_loss(const Slab& slab, double path, const Kinematics& k, const Stream& stream,
                   std::uint32_t place) {
  const double xi = slab.xi * path * k.per_beta2;
  if (!(xi > 0)) return 0;
  const double w_max = k.w_max();
  // The number of collisions above the cut is xi (1/cut - 1/w_max) before the spin factor.
  const double expected = hard_collisions(xi);
  const double cut = xi / (expected + xi / w_max);
  const double soft_mean = restricted_loss(slab, path, k, cut);
  const double soft_variance = xi * cut * (1 - 0.5 * k.beta2 * cut / w_max);
  Draws draws(stream, Purpose::energy_loss, place);
  double loss = soft_mean + std::sqrt(soft_variance) * normal_quantile(draws.next());
  // Poisson by arrivals: product of uniforms against exp(-expected).
  const double limit = std::exp(-expected);
  for (double product = draws.next(); product > limit; product *= draws.next()) {
    const double transfer = 1 / (1 / cut - draws.next() * (1 / cut - 1 / w_max));
    if (draws.next() > k.beta2 * transfer / w_max) loss += transfer;  // spin 0: Rossi, PDG 2024 eq. 34.8
  }
  return std::max(loss, 0.0);
}

void apply_kick(HelixPoint& point, const Kick& kick) {
  const double cos_dip = 1 / std::sqrt(1 + point.tanl * point.tanl), sin_dip = point.tanl * cos_dip;
  const double ux = point.ux, uy = point.uy;
  // Axis 1 = (-uy, ux, 0), axis 2 = (-ux sin, -uy sin, cos).
  point.x += -uy * kick.shift_1 - ux * sin_dip * kick.shift_2;
  point.y += ux * kick.shift_1 - uy * sin_dip * kick.shift_2;
  point.z += cos_dip * kick.shift_2;
  const double angle = std::sqrt(kick.angle_1 * kick.angle_1 + kick.angle_2 * kick.angle_2);
  // Below 0.02 the next terms are under 1e-12.
  const double q = angle * angle;
  const bool small = angle < 0.02;
  const double along = small ? 1 - q / 2 * (1 - q / 12 * (1 - q / 30)) : std::cos(angle);
  const double across = small ? 1 - q / 6 * (1 - q / 20 * (1 - q / 42)) : std::sin(angle) / angle;
  const double in_plane = along * cos_dip - across * kick.angle_2 * sin_dip;
  const double side = across * kick.angle_1;
  const double up = along * sin_dip + across * kick.angle_2 * cos_dip;
  const double dx = ux * in_plane - uy * side, dy = uy * in_plane + ux * side;
  const double transverse = std::sqrt(dx * dx + dy * dy);
  point.ux = dx / transverse;
  point.uy = dy / transverse;
  point.tanl = up / transverse;
}

}  // namespace cgemit
