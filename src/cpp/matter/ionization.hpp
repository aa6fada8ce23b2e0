// Ionization by a charged particle in a drift gap: clusters along its path and delta electrons, including
// those from the cathode in front of the gap and from the foils behind it.
#pragma once

#include <cstdint>
#include <vector>

#include "common/rng.hpp"
#include "detector/detector.hpp"
#include "matter/electrons.hpp"
#include "matter/kinematics.hpp"
#include "motion/helix.hpp"

namespace cgemit {

struct GapCrossing {
  HelixPoint entry, exit;  // at the inner and outer edge of the gap, in the direction of flight
  double bz;               // T
  double length;           // mm, along the track
};

// The origin of a delta electron.
enum class DeltaOrigin : std::int8_t { gas = 0, cathode = 1, behind = 2 };

// Energy deposited in the gap: at a point (an ionization cluster) or on a straight piece of a delta
// electron's path.
struct Deposit {
  double x, y, z;          // mm, its middle
  double dx, dy, dz;       // mm, end minus begin
  double energy;           // keV
  std::int32_t electrons;  // set free
  std::int32_t delta;      // 0 for a cluster of the particle itself, else 1, 2 ...
  DeltaOrigin origin;      // of that delta electron
};

struct GapResult {
  double energy;  // keV, all energy deposited in the gap
  int electrons;  // set free
  int deltas;     // delta electrons that deposited energy in the gap
};

// Delta electrons to be followed, and the tracks and positions of their origin.
struct DeltaBatch : ElectronBatch {
  struct Birth {
    double cosine, sine;  // of the azimuth at which the plane of the electron touches the layer
    DeltaOrigin origin;
  };
  std::vector<Birth> births;

  void clear() {
    ElectronBatch::clear();
    births.clear();
  }
};

// A crossing whose electrons have not been followed yet.
struct Ionized {
  int clusters;             // electrons set free in clusters
  std::size_t first, last;  // its delta electrons in the batch, `last` not included
};

// Random crossing of a gap. With `deltas`, electrons above one keV start on the track, or in the solids, and
// are followed; without, the energy of electrons from the gas, up to 52 keV, stays on the track. Deposits of
// delta electrons are appended to `out`; with `keep_clusters` the ionization clusters are appended before
// them. Nothing else depends on `keep_clusters`. `place` is below 2^16.
GapResult ionize(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 std::vector<Deposit>& out);

// The same in two parts; the electrons of many crossings are followed between them.
Ionized set_free(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 DeltaBatch& electrons, std::vector<Deposit>& out);
GapResult collect(const GapMatter& matter, const GapCrossing& crossing, const Ionized& ionized,
                  const DeltaBatch& electrons, std::vector<Deposit>& out);

}  // namespace cgemit
