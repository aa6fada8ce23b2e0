// A charged particle at one momentum.
#pragma once

#include <cmath>

#include "common/units.hpp"

namespace cgemit {

// What decides on the spectrum of a particle's collisions with electrons.
enum class Projectile { spinless, spin_half, electron, positron };

// Of the particles that live long enough to be tracked, pions and kaons have no spin.
inline Projectile projectile_of(double mass, double charge) {
  if (mass < 2 * electron_mass) return charge < 0 ? Projectile::electron : Projectile::positron;
  const bool spinless = std::abs(mass - 139.57 * MeV) < MeV || std::abs(mass - 493.68 * MeV) < MeV;
  return spinless ? Projectile::spinless : Projectile::spin_half;
}

// Momenta in GeV/c, energies in GeV.
struct Kinematics {
  double p, energy, mass;
  double per_mass, per_beta2, beta2, gamma;
  double log_bg, log_gamma;  // ln(beta gamma), ln(gamma)
  Projectile projectile;

  Kinematics(double momentum, double mass_, Projectile projectile_)
      : p(momentum), mass(mass_), per_mass(1 / mass_), projectile(projectile_) {
    follow_from_p();
    log_bg = std::log(p * per_mass);
    log_gamma = std::log(gamma);
  }
  // The same particle at another momentum. Small changes, as in a thin slab, need no logarithm.
  Kinematics at(double momentum) const {
    Kinematics k = *this;
    k.p = momentum;
    k.follow_from_p();
    k.log_bg += log_ratio(momentum, p);
    k.log_gamma += log_ratio(k.energy, energy);
    return k;
  }
  Kinematics after_loss(double loss) const {
    const double left = energy - loss;
    return at(std::sqrt((left - mass) * (left + mass)));
  }
  bool is_light() const { return projectile >= Projectile::electron; }
  double kinetic() const { return energy - mass; }
  double log_beta2() const { return 2 * (log_bg - log_gamma); }
  // Largest energy that one collision can give to an electron at rest; PDG 2024 eq. 34.4. Of two electrons
  // the slower one counts as struck, a positron can lose everything.
  double w_max() const {
    if (projectile == Projectile::electron) return 0.5 * kinetic();
    if (projectile == Projectile::positron) return kinetic();
    const double ratio = electron_mass * per_mass, bg = p * per_mass;
    return 2 * electron_mass * bg * bg / (1 + 2 * gamma * ratio + ratio * ratio);
  }

 private:
  void follow_from_p() {
    energy = std::sqrt(p * p + mass * mass);
    const double per_beta = energy / p;
    per_beta2 = per_beta * per_beta;
    beta2 = 1 / per_beta2;
    gamma = energy * per_mass;
  }
  // ln(a/b), by its series where the next term is below 1e-9.
  static double log_ratio(double a, double b) {
    const double d = (a - b) / b;
    return std::abs(d) < 0.02 ? d * (1 - d * (1.0 / 2 - d * (1.0 / 3 - d / 4))) : std::log(a / b);
  }
};

}  // namespace cgemit
