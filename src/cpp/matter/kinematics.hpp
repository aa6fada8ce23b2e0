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
  double per_p, per_mass, per_beta, per_beta2, beta2, gamma;
  double log_bg, log_gamma;  // ln(beta gamma), ln(gamma)
  Projectile projectile;

  Kinematics(double momentum, double mass_, Projectile projectile_)
      : p(momentum),
        energy(std::sqrt(momentum * momentum + mass_ * mass_)),
        mass(mass_),
        per_mass(1 / mass_),
        projectile(projectile_) {
    follow();
    log_bg = std::log(p * per_mass);
    log_gamma = std::log(gamma);
  }
  // The same particle with less energy. Small changes, as in a thin slab, need no logarithm.
  Kinematics after_loss(double loss) const {
    Kinematics k = *this;
    k.energy = energy - loss;
    k.p = std::sqrt((k.energy - mass) * (k.energy + mass));
    k.follow();
    k.log_bg += log_ratio(k.p, p, per_p);
    k.log_gamma += log_ratio(k.energy, energy, per_p / per_beta);
    return k;
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
  void follow() {
    per_p = 1 / p;
    per_beta = energy * per_p;
    per_beta2 = per_beta * per_beta;
    beta2 = 1 / per_beta2;
    gamma = energy * per_mass;
  }
  // ln(a/b), by its series where the next term is below 1e-9.
  static double log_ratio(double a, double b, double per_b) {
    const double d = (a - b) * per_b;
    return std::abs(d) < 0.02 ? d * (1 - d * (1.0 / 2 - d * (1.0 / 3 - d / 4))) : std::log(a / b);
  }
};

}  // namespace cgemit
