// Decays in flight: species that decay, their modes, and the momenta of the daughters.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "common/lanes/vec3.hpp"
#include "common/rng.hpp"

namespace cgemit {

// Distribution of the daughters' momenta in the rest frame of the parent.
enum class DecaySpectrum {
  phase_space,   // two or three daughters
  semileptonic,  // pion, lepton, neutrino: V-A with a constant form factor
  michel         // the charged lepton comes first
};

struct DecayProduct {
  std::int32_t pdg;
  std::int32_t charge;  // e
  double mass;          // GeV
};

struct DecayMode {
  double fraction;  // of all decays
  DecaySpectrum spectrum;
  std::vector<DecayProduct> products;
};

struct UnstableSpecies {
  std::int32_t pdg;
  double mass;      // GeV
  double lifetime;  // ns, proper
  std::vector<DecayMode> modes;
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

// A particle at the point of its decay.
struct DecayPoint {
  Vec3<double> position;  // mm
  double time;            // ns, since the start of the particle
  Vec3<double> momentum;  // GeV/c
  double mass;            // GeV
};

// `place` of the random numbers of Purpose::decay.
enum class DecayDraw : std::uint32_t { lifetime = 0, products = 1, streams = 2 };

struct DecayProducts {
  std::size_t mode;  // index of the mode
  const std::vector<DecayProduct>* products;
  std::vector<Vec3<double>> momenta;  // GeV/c in the laboratory, one per product
};

// Draws the mode and the momenta. The decay is isotropic in the rest frame: polarisation is not followed.
DecayProducts decay(const UnstableSpecies& species, const DecayPoint& at, const Stream& stream);

}  // namespace cgemit
