// Multiple Coulomb scattering from the elements of a slab.
//
// One cross-section serves both sides. With q = p theta the momentum transfer, one element adds
//   dN/dq^2 = (c_i/beta^2) / (q^2 + a_i^2)^2,   c_i = K m_e Z^2 n_i on nuclei, K m_e Z n_i on electrons,
// n_i in mol/cm^2 (Bethe, Phys. Rev. 89 (1953) 1256; Moliere's chi_c^2 = c/(p beta)^2, chi_a = a/p). Nuclei
// scatter less beyond their size, electrons take no more than their largest recoil.
#pragma once

#include <cmath>

#include "common/rng.hpp"
#include "matter/track.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// Screening of the nucleus by its electrons: Moliere's, or his squared times 1 + exp(-Z^2/1000), as in the
// Wentzel-VI model of Geant4.
enum class Screening { wentzel, moliere };

// Fills in the scattering tables of all slabs.
void prepare_scattering(Detector& detector, Screening screening);

// The core of the angle's distribution, as a Gaussian: variance of all scatters below a transfer q_F, of
// which 1 - F are cut off on either side; Lynch and Dahl, Nucl. Instrum. Methods B 58 (1991) 6, eq. 7, F =
// 0.98. It is the track's q_F, so that the variances of slabs add up.
inline constexpr double core_fraction = 0.98;

// Plane angle squared. 1/(p beta) is the mean (geometric) of that before and after the slab.
template <class T>
T scattering_variance(const Slab& slab, T path, const KinematicsOf<T>& before, const KinematicsOf<T>& after,
                      const TrackMatterOf<T>& track) {
  const T screening = read<&SlabPoint::log_screening>(slab, before.log_bg).value;
  constexpr double cut_scale = 0.5 / (1 - core_fraction);  // q_F^2 = cut_scale chi_c^2 p^2
  static const double log_cut_scale = std::log(cut_scale);
  const T log_cut = log_cut_scale + track.log_chi_c2 - before.log_beta2();
  T sum = slab.chi_c2 * (log_cut - screening - 1.0);
  // Electrons recoil with 2 m_e W_max at most; where that is less, the core ends earlier for them.
  const T recoil = 2 * electron_mass * before.w_max(), cut = cut_scale * track.chi_c2 * before.per_beta2;
  const auto less = recoil < cut;
  if (any(less)) sum -= select(less, slab.chi_c2_electrons * log(cut / recoil), T(0.0));
  const T per_p_beta2 = before.per_beta * before.per_p * after.per_beta * after.per_p;
  constexpr double per_width = 1 / (1 + core_fraction * core_fraction);
  return larger(sum, slab.chi_c2) * path * per_width * per_p_beta2;
}

// Turns the flight direction by plane angles about the two axes across it, and shifts the point along them.
// Axis 1 is horizontal (in the transverse plane), axis 2 completes a right-handed set with the flight.
struct Kick {
  double angle_1, angle_2, shift_1, shift_2;  // rad, mm
};
void apply_kick(HelixPoint& point, const Kick& kick);

// Scatters of a slab: soft ones as a Gaussian, hard ones (transfer above `slab.hard_from`) one by one.
Kick sample_scattering(const Slab& slab, double path, const Kinematics& before, const Kinematics& after,
                       const Stream& stream, std::uint32_t place);

}  // namespace cgemit
