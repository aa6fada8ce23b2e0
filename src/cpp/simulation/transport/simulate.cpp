#include "simulation/transport/simulate.hpp"

#include "common/lanes/number.hpp"
#include "simulation/transport/batch.hpp"

namespace cgemit {

void simulate(const Detector& detector, const ParticleColumns& particles, const SimulateSettings& settings,
              std::uint64_t seed, Simulated& out) {
  simulate_lanes<Number>(detector, particles, settings, seed, out);
}

}  // namespace cgemit
