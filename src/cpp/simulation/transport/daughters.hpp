// The charged daughters of decays.
#pragma once

#include <cstdint>
#include <vector>

#include "common/status.hpp"
#include "simulation/transport/decays.hpp"

namespace cgemit {

struct ParticleNumber {
  std::int64_t event;
  std::int32_t particle;
};

// A charged particle that a decay produces.
struct Daughter {
  ParticleNumber of;       // the particle of the table that it descends from
  std::int32_t parent;     // 0: that particle, k: its k-th daughter
  std::int32_t pdg, mode;  // mode: index of the parent's decay mode
  std::int8_t charge;      // e
  double mass;             // GeV
  DecayPoint at;           // of the parent
  Vec3<double> momentum;   // GeV/c, its own
  double time;             // ns, since the start of the first particle
  std::int64_t stream;     // stands for the event in the counters of its random numbers; below 0
  TransportStatus status;
};

// Appends the charged products of the decay of a particle. `parent`: 0 for the particle of the table, k for
// its k-th daughter. `start`: time at which the parent started, in ns.
void add_daughters(const UnstableSpecies& species, const DecayPoint& at, const Stream& stream,
                   const ParticleNumber& of, std::int32_t parent, double start, std::vector<Daughter>& out);

}  // namespace cgemit
