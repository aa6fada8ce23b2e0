// A charged particle at one momentum.
#pragma once

#include <cmath>

#include "common/lanes/math.hpp"
#include "common/units.hpp"

namespace cgemit {

// Type of a particle, which determines the spectrum of its collisions with electrons.
enum class Projectile { spinless, spin_half, electron, positron };

// Of the particles that live long enough to be tracked, pions and kaons have spin 0.
inline Projectile projectile_of(double mass, double charge) {
  if (mass < 2 * electron_mass) return charge < 0 ? Projectile::electron : Projectile::positron;
  const bool spinless = std::abs(mass - 139.57 * MeV) < MeV || std::abs(mass - 493.68 * MeV) < MeV;
  return spinless ? Projectile::spinless : Projectile::spin_half;
}

// ln(a/b), by its series if the next term is below 1e-9.
template <class T>
T log_ratio(const T& a, const T& b, const T& per_b) {
  const T d = (a - b) * per_b;
  return choose(
      abs(d) < 0.02, [&d] { return d * (1.0 - d * (1.0 / 2 - d * (1.0 / 3 - d / 4.0))); },
      [&] { return log(a / b); });
}

// Momenta in GeV/c, energies in GeV.
template <class T>
struct KinematicsOf {
  T p, energy, mass;
  T per_p, per_energy, per_mass, per_beta, per_beta2, beta2, gamma;
  T log_bg;    // ln(beta gamma)
  T has_spin;  // 1 for spin 1/2, else 0; it affects the collision spectrum of heavy particles
  Projectile projectile;

  KinematicsOf(T momentum, T mass_, Projectile projectile_)
      : p(momentum),
        energy(sqrt(momentum * momentum + mass_ * mass_)),
        mass(mass_),
        per_mass(1.0 / mass_),
        has_spin(projectile_ == Projectile::spin_half ? 1.0 : 0.0),
        projectile(projectile_) {
    follow();
    log_bg = log(p * per_mass);
  }
  // The same particle with less energy. Small changes, as in a thin slab, need no logarithm.
  KinematicsOf after_loss(T loss) const {
    KinematicsOf k = *this;
    k.energy = energy - loss;
    k.p = sqrt((k.energy - mass) * (k.energy + mass));
    k.follow();
    k.log_bg += log_ratio(k.p, p, per_p);
    return k;
  }
  // Takes a in the lanes of `m` and b in the others.
  friend KinematicsOf select(mask_of<T> m, KinematicsOf a, const KinematicsOf& b) {
    for (T KinematicsOf::* x : {&KinematicsOf::p, &KinematicsOf::energy, &KinematicsOf::per_p,
                                &KinematicsOf::per_energy, &KinematicsOf::per_beta, &KinematicsOf::per_beta2,
                                &KinematicsOf::beta2, &KinematicsOf::gamma, &KinematicsOf::log_bg})
      a.*x = select(m, a.*x, b.*x);
    return a;
  }
  bool is_light() const { return projectile >= Projectile::electron; }
  T beta() const { return p * per_energy; }
  T kinetic() const { return energy - mass; }
  // Largest energy transfer of one collision to an electron at rest; PDG 2024 eq. 34.4. Of two electrons the
  // slower one counts as struck; a positron can lose all its energy.
  T w_max() const {
    if (projectile == Projectile::electron) return 0.5 * kinetic();
    if (projectile == Projectile::positron) return kinetic();
    const T ratio = electron_mass * per_mass, bg = p * per_mass;
    return 2 * electron_mass * bg * bg / (1.0 + 2.0 * gamma * ratio + ratio * ratio);
  }

 private:
  void follow() {
    const T per_both = 1.0 / (p * energy);
    per_p = energy * per_both;
    per_energy = p * per_both;
    per_beta = energy * per_p;
    per_beta2 = per_beta * per_beta;
    beta2 = beta() * beta();
    gamma = energy * per_mass;
  }
};
using Kinematics = KinematicsOf<double>;

}  // namespace cgemit
