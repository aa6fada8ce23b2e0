// Electrons of some hundred eV to some MeV in the sub-layers around a drift gap: elastic scattering on
// nuclei, continuous slowing down, rotation in the field. The layer is taken as a plane: u along r phi, w
// outward, z along the beam and the field; lengths in mm, energies in keV.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "common/rng.hpp"
#include "detector/gap.hpp"

namespace cgemit {

// Below this energy an electron ends where it is; in gas of 1 atm it would go 20 um further.
inline constexpr double least_electron = 0.3;  // keV

struct Electron {
  double u, w, z;     // mm
  double du, dw, dz;  // direction, unit vector
  double energy;      // keV
};

// A straight piece of the way in the gap and the energy left on it.
struct Piece {
  std::array<double, 3> from, to;  // u, w, z, mm
  double energy;                   // keV
};

// Practical range, g/cm2, of an electron of so many keV; Kobetich and Katz, Phys. Rev. 170 (1968) 391.
inline double practical_range(double energy) {
  return 5.37e-4 * energy * (1 - 0.9815 / (1 + 3.123e-3 * energy));
}

// Turns the direction by an angle with cosine 1 - 2 mu, at an azimuth about the flight.
void deflect(Electron& electron, double mu, double cos_azimuth, double sin_azimuth);

// Follows an electron until it has less than `least_electron`, leaves the layers, or is too deep in solid
// matter to come back to the gap; its remaining energy is then what `electron` says. Appends the pieces in
// the gap. Returns the length of its way, mm. `place` is one electron's own.
double transport(const GapMatter& matter, Electron& electron, double bz, const Stream& stream,
                 std::uint32_t place, std::vector<Piece>& pieces);

}  // namespace cgemit
