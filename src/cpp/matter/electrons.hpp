// Electrons of some hundred eV to some MeV in the sub-layers around a drift gap: elastic scattering on
// nuclei, continuous slowing down, rotation in the field. The layer is treated as a plane: u along r phi, w
// outward, z along the beam and the field; lengths in mm, energies in keV.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "common/lanes/math.hpp"
#include "common/rng.hpp"
#include "detector/gap.hpp"

namespace cgemit {

// An electron below this energy ends where it is; in gas of 1 atm its remaining range is 20 um.
inline constexpr double least_electron = 0.3;  // keV

template <class T>
struct ElectronOf {
  T u, w, z;     // mm
  T du, dw, dz;  // direction, unit vector
  T energy;      // keV
};
using Electron = ElectronOf<double>;

// A straight piece of an electron's path in the gap and the energy deposited on it.
struct Piece {
  std::array<double, 3> from, to;  // u, w, z, mm
  double energy;                   // keV
  std::size_t next;                // of the same electron, 0: none
};

// An electron to be followed, and its result.
struct ElectronTask {
  const GapMatter* matter;
  double bz;  // T
  Stream stream;
  std::uint32_t place;              // RNG counter `place`, unique to this electron
  Electron electron;                // first the start, at the end the end point
  double way = 0;                   // mm, path length
  std::size_t first = 0, last = 0;  // of its pieces, 0: none
};

// A batch of electrons; number 0 of the pieces is unused.
struct ElectronBatch {
  std::vector<ElectronTask> electrons;
  std::vector<Piece> pieces{Piece{}};

  void clear() {
    electrons.clear();
    pieces.resize(1);
  }
  void append(ElectronTask& electron, const Piece& piece) {
    (electron.first == 0 ? electron.first : pieces[electron.last].next) = pieces.size();
    electron.last = pieces.size();
    pieces.push_back(piece);
  }
};

// Practical range, g/cm2, of an electron of this energy in keV; Kobetich and Katz, Phys. Rev. 170 (1968) 391.
template <class T>
T practical_range(const T& energy) {
  return 5.37e-4 * energy * (1.0 - 0.9815 / (1.0 + 3.123e-3 * energy));
}

// Turns the direction by an angle with cosine 1 - 2 mu, at an azimuth about the flight direction.
template <class T>
void deflect(ElectronOf<T>& e, const T& mu, const T& cos_azimuth, const T& sin_azimuth) {
  const T cosine = 1.0 - 2.0 * mu, sine = 2.0 * sqrt(larger(mu * (1.0 - mu), 0.0));
  const T side = sine * cos_azimuth, up = sine * sin_azimuth;
  const T across = sqrt(e.du * e.du + e.dw * e.dw);
  // Unit vectors across the flight: (-dw, du, 0)/across and (-du dz, -dw dz, across^2)/across.
  const T first = side / across, second = up / across * e.dz;
  const T du = cosine * e.du - first * e.dw - second * e.du;
  const T dw = cosine * e.dw + first * e.du - second * e.dw;
  const T dz = cosine * e.dz + up * across;
  // One Newton step towards length 1 removes the rounding errors of thousands of steps.
  const T norm = 1.5 - 0.5 * (du * du + dw * dw + dz * dz);
  const mask_of<T> along_z = across < 1e-6;
  e.du = select(along_z, side, du * norm);
  e.dw = select(along_z, up, dw * norm);
  e.dz = select(along_z, copysign(cosine, cosine * e.dz), dz * norm);
}

// Follows electrons until they have less than `least_electron`, leave the layers, or are too deep in solid
// matter to return to the gap. `electron` then holds their remaining energy. Keeps the pieces in the gap.
void follow(ElectronBatch& batch);

}  // namespace cgemit
