// Units, constants and squares.
//
// Native units of the core: mm, ns, GeV, GeV/c, T, rad, elementary charge; strip charge in fC.
// Energy deposits in tables are keV. Numbers of another unit enter as `5 * um`.
#pragma once

namespace cgemit {

inline constexpr double um = 1e-3;
inline constexpr double MeV = 1e-3;
inline constexpr double keV = 1e-6;

constexpr double square(double x) { return x * x; }

inline constexpr double pi = 3.14159265358979323846;

inline constexpr double speed_of_light = 299.792458;  // mm/ns, exact

// R[mm] = radius_per_kappa / (B[T] kappa[(GeV/c)^-1]): 10^6 over the speed of light in mm/ns.
inline constexpr double radius_per_kappa = 3335.6409519815204;

// PDG 2024, Physical constants.
inline constexpr double electron_mass = 0.51099895000 * MeV;
inline constexpr double fine_structure = 1 / 137.035999084;
inline constexpr double hbar_c = 0.1973269804;            // GeV fm
inline constexpr double bethe_constant = 0.307075 * MeV;  // cm^2/mol, 4 pi N_A r_e^2 m_e c^2
inline constexpr double elementary_charge_fC = 1.602176634e-4;

}  // namespace cgemit
