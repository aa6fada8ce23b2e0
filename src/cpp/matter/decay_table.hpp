// Species that decay in flight, and their modes.
#pragma once

#include <cmath>
#include <cstdint>
#include <tuple>
#include <vector>

#include "common/columns.hpp"

namespace cgemit {

// Distribution of the daughters' momenta in the rest frame of the parent.
enum class DecaySpectrum : std::int32_t {
  phase_space,   // two or three daughters
  semileptonic,  // pion, lepton, neutrino: V-A with a constant form factor
  michel         // the charged lepton comes first
};

struct DecayProduct {
  std::int32_t pdg;
  std::int32_t charge;  // e
  double mass;          // GeV

  static constexpr auto columns() {
    return std::tuple(Column("pdg", &DecayProduct::pdg), Column("charge", &DecayProduct::charge),
                      Column("mass", &DecayProduct::mass));
  }
};

struct DecayMode {
  double fraction;  // of all decays
  DecaySpectrum spectrum;
  std::vector<DecayProduct> products;

  static constexpr auto columns() {
    return std::tuple(Column("fraction", &DecayMode::fraction), Column("spectrum", &DecayMode::spectrum));
  }
};

struct UnstableSpecies {
  std::int32_t pdg;
  double mass;      // GeV
  double lifetime;  // ns, proper
  std::vector<DecayMode> modes;

  static constexpr auto columns() {
    return std::tuple(Column("pdg", &UnstableSpecies::pdg), Column("mass", &UnstableSpecies::mass),
                      Column("lifetime", &UnstableSpecies::lifetime));
  }
};

// Throws std::invalid_argument for modes that have no daughters' momenta: the sum of the masses, the number
// of products or the fractions are impossible.
void check(const UnstableSpecies& species);

struct DecayTable {
  std::vector<UnstableSpecies> species;

  const UnstableSpecies* find(std::int32_t pdg) const {
    for (const UnstableSpecies& one : species)
      if (one.pdg == pdg) return &one;
    return nullptr;
  }
  // Proper lifetime in ns; infinite for particles that do not decay.
  double lifetime(std::int32_t pdg) const {
    const UnstableSpecies* one = find(pdg);
    return one == nullptr ? HUGE_VAL : one->lifetime;
  }
};

}  // namespace cgemit
