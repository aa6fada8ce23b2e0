// Decays in flight: the momenta of the daughters.
#pragma once

#include <cstdint>
#include <vector>

#include "common/lanes/vec3.hpp"
#include "common/rng.hpp"
#include "matter/decay_table.hpp"

namespace cgemit {

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
