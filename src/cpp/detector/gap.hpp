// Matter around a drift gap, for ionization and electrons of some keV. Made by `cgemit.detector.gas`.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <tuple>
#include <vector>

#include "common/columns.hpp"

namespace cgemit {

// Grid of electron energies: sixteen equal steps between successive powers of two in keV.
inline constexpr int electron_steps = 16;
inline constexpr double electron_grid_first = 0.25;              // keV
inline constexpr int electron_points = 19 * electron_steps + 1;  // to 131 MeV

// Larger ionizations are treated as delta electrons.
inline constexpr std::size_t largest_cluster = 40;

// Properties of a material for electrons of one energy. Scatters with mu = (1 - cos(angle))/2 above `cut` are
// drawn one by one, with the spectrum 1/(mu + screening)^2; softer scatters are combined.
struct ElectronPoint {
  double stopping;  // keV/mm
  double path;      // mm, mean free path of the hard scatters
  double cut;
  double screening;
  double soft;          // 1/mm, mean of mu by soft scatters
  double per_momentum;  // 1/(GeV/c)

  static constexpr auto columns() {
    return std::tuple(Column("stopping", &ElectronPoint::stopping), Column("path", &ElectronPoint::path),
                      Column("cut", &ElectronPoint::cut), Column("screening", &ElectronPoint::screening),
                      Column("soft", &ElectronPoint::soft),
                      Column("per_momentum", &ElectronPoint::per_momentum));
  }
};

// A sub-layer at a drift gap. Positions w here and below are in mm, outward from the inner edge of the gap.
struct ElectronLayer {
  double w_in, w_out;  // mm
  double density;      // g/cm2 per mm
  double depth;        // g/cm2 between its near face and the gap
  std::array<ElectronPoint, electron_points> at;

  static constexpr auto columns() {
    return std::tuple(Column("w_in", &ElectronLayer::w_in), Column("w_out", &ElectronLayer::w_out),
                      Column("density", &ElectronLayer::density), Column("depth", &ElectronLayer::depth),
                      Column("", &ElectronLayer::at));
  }
};

// Matter at one depth in front of the gap or behind it, from which electrons may reach the gap.
struct DeltaSlice {
  double w_in, w_out;   // mm
  double least_energy;  // keV; electrons of lower energy do not reach the gap
  double rate;          // xi/least_energy at normal incidence, summed over the slices up to this one

  static constexpr auto columns() {
    return std::tuple(Column("w_in", &DeltaSlice::w_in), Column("w_out", &DeltaSlice::w_out),
                      Column("least_energy", &DeltaSlice::least_energy), Column("rate", &DeltaSlice::rate));
  }
};

// A drift gap, the cathode in front of it, foils and anode behind it. A sensor without gas has no layers: its
// energy loss is that of its matter, and no electrons are followed.
struct GapMatter {
  std::vector<ElectronLayer> layers;  // from inside
  std::size_t gap;                    // index of the gap among the layers
  double z_min, z_max;                // mm; electrons are not followed beyond
  std::vector<DeltaSlice> slices;
  double xi;                     // keV/mm of the gas; Landau's xi is xi/beta^2
  double w_value;                // keV per electron
  std::vector<double> clusters;  // ionizations per mm, on the grid of ln(beta gamma)
  // Cumulative numbers, out of 2^32 ionizations: those with up to 1, 2, 3 ... electrons, then those up to
  // each border but the first of the ranges over which the number of electrons n falls as 1/n^2.
  std::vector<std::uint32_t> sizes;
  std::vector<double> tail;  // borders of these ranges, electrons

  bool ionizes() const { return !layers.empty(); }
  double width() const { return layers[gap].w_out; }  // mm
};

}  // namespace cgemit
