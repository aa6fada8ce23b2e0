// Energy loss by collisions with electrons: moments for the fit, samples for the simulation.
#pragma once

#include <cmath>

#include "common/rng.hpp"
#include "matter/track.hpp"

namespace cgemit {

// -2 ln(I) - delta - 2 C/Z of a slab, and its slope in ln(beta gamma).
struct LogTerm {
  double value, slope;
};
inline LogTerm log_term(const Slab& slab, double log_bg) {
  const GridPlace place(log_bg);
  const double here = slab.table[place.i].log_term, next = slab.table[place.i + 1].log_term;
  return {place.between(here, next), (next - here) / loss_grid_step};
}

// Mean energy loss by collisions with a transfer below `cut` (all of them for cut >= w_max).
// Heavy particles: PDG 2024 eqs. 34.5 and 34.11, with the term of spin 1/2 (Rossi, High Energy Particles,
// 1952, section 2.3); shell correction of Barkas and Berger, so beta gamma > 0.13.
// Electrons and positrons: Berger and Seltzer, NASA SP-3012 (1964), as in ICRU Report 37, eqs. 2.10-2.13.
double restricted_loss(const Slab& slab, double path, const Kinematics& k, double cut);

// The energy loss that the fit subtracts, and its variance.
struct LossMoments {
  double loss;      // GeV
  double variance;  // GeV^2
  double slope;     // d(loss)/d(p), GeV per GeV/c
};

// Landau's distribution has no variance, and rare collisions dominate its mean. The fit describes the core:
// mean and variance of all collisions with a transfer below `core_cut` times the track's xi. Harder ones,
// xi/cut of them per track, happen to one track in ten and are left to the tail. The cut is the track's, so
// the moments of slabs add up. Slow particles (cut above w_max) get Bethe's mean and Vavilov's variance.
// Electrons and positrons: mean and variance of their radiation on top.
inline constexpr double core_cut = 10;

LossMoments core_loss(const Slab& slab, double path, const Kinematics& k, const TrackMatter& track);

// How often a collision transfers an energy, relative to xi/(beta^2 E^2), and the most that this can be.
double spectrum_share(const Kinematics& k, double transfer, double w_max);
inline double spectrum_peak(const Kinematics& k) { return k.projectile == Projectile::electron ? 2.25 : 1.0; }

// Energy lost in collisions in a slab, GeV: those above a cut one by one, with the spectrum of the
// particle's spin (Rossi; Moller; Bhabha) up to w_max; softer ones by mean, variance, skewness and kurtosis.
// The mean is that of `restricted_loss` exactly, and two halves of a slab sum to the whole.
double sample_loss(const Slab& slab, double path, const Kinematics& k, const Stream& stream,
                   std::uint32_t place);

}  // namespace cgemit
