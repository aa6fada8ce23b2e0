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

// What matter and field tell apart of a particle.
template <class T>
struct SpeciesOf {
  T mass;    // GeV
  T charge;  // e, unsigned
  Projectile projectile;
};
using Species = SpeciesOf<double>;

// `sign`: any number with the sign of the charge.
inline Species species_of(double mass, double charge, double sign) {
  return {mass, std::abs(charge), projectile_of(mass, sign)};
}

// Momenta in GeV/c, energies in GeV. A particle of charge z scatters, loses energy and ionizes like one of
// unit charge whose 1/beta^2 is z^2/beta^2: in the Born approximation, and as long as no electrons are bound
// to it.
template <class T>
struct KinematicsOf {
  T p, energy, mass;
  T charge2;  // e^2, square of the charge
  T per_p, per_energy, per_mass, per_beta, beta2, gamma;
  T charge2_per_beta2;
  T log_bg;    // ln(beta gamma)
  T has_spin;  // 1 for spin 1/2, else 0; it affects the collision spectrum of heavy particles
  Projectile projectile;

  KinematicsOf(const T& momentum, const SpeciesOf<T>& of)
      : p(momentum),
        energy(sqrt(momentum * momentum + of.mass * of.mass)),
        mass(of.mass),
        charge2(of.charge * of.charge),
        per_mass(1.0 / of.mass),
        has_spin(of.projectile == Projectile::spin_half ? 1.0 : 0.0),
        projectile(of.projectile) {
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
  // Takes a in the lanes of `m` and b in the others, states of the same particles.
  friend KinematicsOf select(mask_of<T> m, KinematicsOf a, const KinematicsOf& b) {
    for (T KinematicsOf::* x :
         {&KinematicsOf::p, &KinematicsOf::energy, &KinematicsOf::per_p, &KinematicsOf::per_energy,
          &KinematicsOf::per_beta, &KinematicsOf::beta2, &KinematicsOf::gamma,
          &KinematicsOf::charge2_per_beta2, &KinematicsOf::log_bg})
      a.*x = select(m, a.*x, b.*x);
    return a;
  }
  bool is_light() const { return projectile >= Projectile::electron; }
  T beta() const { return p * per_energy; }
  T kinetic() const { return energy - mass; }
  // ln(beta gamma) of a particle of unit charge with the same z^2/beta^2. Screening depends on this alone.
  T log_bg_of_unit_charge() const {
    const mask_of<T> multiply = charge2 != 1.0;
    return any(multiply) ? select(multiply, -0.5 * log(larger(charge2_per_beta2 - 1.0, 1e-11)), log_bg)
                         : log_bg;
  }
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
    charge2_per_beta2 = per_beta * per_beta * charge2;
    beta2 = beta() * beta();
    gamma = energy * per_mass;
  }
};
using Kinematics = KinematicsOf<double>;

}  // namespace cgemit
