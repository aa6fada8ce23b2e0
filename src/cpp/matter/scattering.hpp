// Multiple Coulomb scattering from the elements of a slab.
//
// The fit and the simulation use the same cross-section. With q = p theta the momentum transfer, one element
// adds
//   dN/dq^2 = (c_i/beta^2) / (q^2 + a_i^2)^2,   c_i = K m_e Z^2 n_i on nuclei, K m_e Z n_i on electrons,
// n_i in mol/cm^2 (Bethe, Phys. Rev. 89 (1953) 1256; Moliere's chi_c^2 = c/(p beta)^2, chi_a = a/p). The
// nuclear size reduces scattering at large transfers, and electrons take at most their largest recoil.
#pragma once

#include <array>
#include <cmath>
#include <span>

#include "matter/draws.hpp"
#include "matter/track.hpp"
#include "motion/helix.hpp"

namespace cgemit {

// Screening of the nucleus by its electrons: Moliere's screening angle, or its square times 1 +
// exp(-Z^2/1000), as in the Wentzel-VI model of Geant4.
enum class Screening { wentzel, moliere };

// Fills in the scattering tables of all slabs. `drawn`: also those for the simulation, which draws scatters;
// without, its variances of soft scatters are NaN.
void prepare_scattering(Detector& detector, Screening screening, bool drawn);

// Gaussian core of the angular distribution: variance of all scatters below a transfer q_F, with a fraction 1
// - F cut off on either side; Lynch and Dahl, Nucl. Instrum. Methods B 58 (1991) 6, eq. 7, F = 0.98.
//
// Scattering moves a parameter k by the sum of the plane angles of all slabs with weights w_ik. This sum is
// distributed as the angle of one slab with chi_c^2 = sum_j w_jk^2 chi_c,j^2, whose scatters below q_F are
// those of slab i below q_F/|w_ik|. So the matter that acts with slab i is
//   X_ik = chi_c,i^2 V_k/V_ik,
// with the variance V_k of the parameter by scattering and the part V_ik of slab i. Where all weights are
// equal, X_ik is all matter, however it is cut.
//
// Hits add the variance H_k to the parameter. Its core then holds scatters up to larger angles, as that of a
// sum with the variance V_k + H_k: X_ik is larger by 1 + H_k/V_k, which grows with (p beta)^2.
inline constexpr double core_fraction = 0.98;

// Fills in `Slab::acting` from the mean of ln X_ik over the parameters, each with the slab's part in its
// whole variance as weight; at most the matter before the last surface that measures. `Slab::by_hits` follows
// from the same mean of ln(1 + H_k/V_k). `parts`: V_ik for all slabs, `variances`: of the parameters,
// `hits`: H_k, all of a particle of this momentum.
void share_scattering(Detector& detector, std::span<const std::array<double, 5>> parts,
                      const std::array<double, 5>& variances, const std::array<double, 5>& hits,
                      const Kinematics& start);

// Variance of the plane angle. 1/(p beta) is the geometric mean of the values before and after the slab.
template <class T>
T scattering_variance(const Slab& slab, T path, const KinematicsOf<T>& before, const KinematicsOf<T>& after,
                      const TrackMatterOf<T>& track) {
  const T screening = read<&SlabPoint::log_screening>(slab, before.log_bg_of_unit_charge()).value;
  constexpr double cut_scale = 0.5 / (1 - core_fraction);  // q_F^2 = cut_scale chi_c^2 p^2
  const T acting = larger(smaller(slab.acting * track.path, track.chi_c2), slab.chi_c2 * track.path);
  const T cut = cut_scale * acting * (before.charge2_per_beta2 + slab.by_hits * (before.p * before.p));
  T sum = slab.chi_c2 * (log(cut) - screening - 1.0);
  // Electrons recoil with at most 2 m_e W_max; where this is below the cut, it limits their part of the core.
  const T recoil = 2 * electron_mass * before.w_max();
  const mask_of<T> less = recoil < cut;
  if (any(less)) sum -= select(less, slab.chi_c2_electrons * log(cut / recoil), T(0.0));
  const T per_p_beta2 = before.per_beta * before.per_p * after.per_beta * after.per_p * before.charge2;
  constexpr double per_width = 1 / (1 + core_fraction * core_fraction);
  return larger(sum, slab.chi_c2) * path * per_width * per_p_beta2;
}

// Turns the flight direction by plane angles about the two axes across it, and shifts the point along them.
// Axis 1 is horizontal (in the transverse plane); axis 2 completes a right-handed set with the flight.
template <class T>
struct KickOf {
  T angle_1{0.0}, angle_2{0.0}, shift_1{0.0}, shift_2{0.0};  // rad, mm
};
using Kick = KickOf<double>;

template <class T>
void apply_kick(HelixPointOf<T>& point, const KickOf<T>& kick) {
  const T cos_dip = 1.0 / sqrt(1.0 + point.tanl * point.tanl), sin_dip = point.tanl * cos_dip;
  const T ux = point.ux, uy = point.uy;
  // Axis 1 = (-uy, ux, 0), axis 2 = (-ux sin, -uy sin, cos).
  if (any((kick.shift_1 != 0.0) | (kick.shift_2 != 0.0))) {
    point.x += -uy * kick.shift_1 - ux * sin_dip * kick.shift_2;
    point.y += ux * kick.shift_1 - uy * sin_dip * kick.shift_2;
    point.z += cos_dip * kick.shift_2;
  }
  const T q = kick.angle_1 * kick.angle_1 + kick.angle_2 * kick.angle_2;
  // Below an angle of 0.02 the next terms are under 1e-12.
  T along = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0));
  T across = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0));
  const mask_of<T> large = q >= 4e-4;
  if (any(large)) {
    const T angle = sqrt(q);
    const SineCosine<T> s = sine_cosine(angle);
    along = select(large, s.cosine, along);
    across = select(large, s.sine / angle, across);
  }
  const T in_plane = along * cos_dip - across * kick.angle_2 * sin_dip;
  const T side = across * kick.angle_1;
  const T up = along * sin_dip + across * kick.angle_2 * cos_dip;
  const T dx = ux * in_plane - uy * side, dy = uy * in_plane + ux * side;
  const T per_transverse = 1.0 / sqrt(dx * dx + dy * dy);
  point.ux = dx * per_transverse;
  point.uy = dy * per_transverse;
  point.tanl = up * per_transverse;
}

// Adds n hard scatters of a particle of this momentum to the kick. `depth`: mm, standard deviation of their
// depth in the slab. `recoil`: (GeV/c)^2, the largest transfer to electrons.
void add_hard_scatters(const Slab& slab, int n, double p, double charge2_per_beta2, double recoil,
                       double depth, Draws& draws, Kick& kick);

// Scatters in a slab: soft ones as a Gaussian, hard ones (transfer above `slab.hard_from`) one by one.
template <class T>
KickOf<T> sample_scattering(const Slab& slab, const T& path, const KinematicsOf<T>& before,
                            const KinematicsOf<T>& after, const StreamOf<T>& stream, std::uint32_t place) {
  T soft = read<&SlabPoint::soft>(slab, before.log_bg_of_unit_charge()).value;
  const T recoil = 2 * electron_mass * before.w_max();
  const mask_of<T> less = recoil < slab.hard_from;
  if (any(less)) soft -= select(less, 0.5 * slab.chi_c2_electrons * log(slab.hard_from / recoil), T(0.0));
  const T per_p_beta2 = before.per_beta * before.per_p * after.per_beta * after.per_p * before.charge2;
  const T sigma = sqrt(larger(soft, 0.0) * path * per_p_beta2);
  DrawsOf<T> draws(stream, Purpose::scattering, place);
  KickOf<T> kick;
  kick.angle_1 = sigma * normal_quantile(draws.next());
  kick.angle_2 = sigma * normal_quantile(draws.next());
  const T n(poisson(draws.next(), slab.hard_rate * path * before.charge2_per_beta2));
  T depth(0.0);
  if (slab.shifts) {
    depth = slab.spread * path;
    kick.shift_1 = sigma * depth * normal_quantile(draws.next());
    kick.shift_2 = sigma * depth * normal_quantile(draws.next());
  }
  each_lane(n > 0.0, [&](int i) {
    Draws rest(lane(stream, i), draws, i);
    Kick one{lane(kick.angle_1, i), lane(kick.angle_2, i), lane(kick.shift_1, i), lane(kick.shift_2, i)};
    add_hard_scatters(slab, static_cast<int>(lane(n, i)), lane(before.p, i),
                      lane(before.charge2_per_beta2, i), lane(recoil, i), lane(depth, i), rest, one);
    set_lane(kick.angle_1, i, one.angle_1);
    set_lane(kick.angle_2, i, one.angle_2);
    set_lane(kick.shift_1, i, one.shift_1);
    set_lane(kick.shift_2, i, one.shift_2);
  });
  return kick;
}

}  // namespace cgemit
