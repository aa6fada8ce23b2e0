// Results of particles simulated side by side, kept until they are written particle by particle.
#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "matter/kinematics.hpp"
#include "motion/helix.hpp"
#include "simulation/transport/daughters.hpp"
#include "simulation/transport/rows.hpp"

namespace cgemit {

template <class T>
HelixPoint lane(const HelixPointOf<T>& p, int i) {
  return {lane(p.x, i),  lane(p.y, i),    lane(p.z, i), lane(p.ux, i),
          lane(p.uy, i), lane(p.tanl, i), lane(p.w, i)};
}

inline const Kinematics& lane(const Kinematics& k, int) { return k; }
template <class T>
Kinematics lane(const KinematicsOf<T>& k, int i) {  // of heavy particles
  return {lane(k.p, i),
          {lane(k.mass, i), std::sqrt(lane(k.charge2, i)),
           lane(k.has_spin, i) > 0 ? Projectile::spin_half : Projectile::spinless}};
}

// Crossings of one drift gap; the mask holds the particles with a recorded crossing.
template <class T>
struct GapRecord {
  const Slab* slab;
  mask_of<T> filled;
  HelixPointOf<T> entry, middle, exit;
  KinematicsOf<T> inside;
  T path, time, deposit;      // mm, ns, GeV
  T bz;                       // T, at the entry
  std::int32_t daughter = 0;  // 0: the particle itself, k: its k-th daughter
  std::int8_t half_turn = 0;  // odd: inward
};

// One cell of each particle in one layer of wires.
template <class T>
struct CellRecord {
  const WireLayer* layer;
  mask_of<T> fired;
  std::array<std::int64_t, lanes_of<T>> wire;
  T doca, x, y, z, time;
  std::int32_t daughter = 0;
  std::int8_t half_turn = 0;
};

// Appends the cells of one lane.
template <class T>
void append_cells(const std::vector<CellRecord<T>>& cells, int i, const ParticleNumber& who,
                  Columns<WireTruthRow>& out) {
  for (const CellRecord<T>& c : cells) {
    if (!lane(c.fired, i)) continue;
    const double doca = lane(c.doca, i);
    out.push_back({.event = who.event,
                   .particle = who.particle,
                   .layer = c.layer->number,
                   .wire = static_cast<std::int32_t>(c.wire[static_cast<std::size_t>(i)]),
                   .doca = doca,
                   .side = static_cast<std::int8_t>(doca > 0 ? 1 : -1),
                   .x = lane(c.x, i),
                   .y = lane(c.y, i),
                   .z = lane(c.z, i),
                   .time = lane(c.time, i),
                   .daughter = c.daughter,
                   .half_turn = c.half_turn});
  }
}

}  // namespace cgemit
