// What a charged particle leaves in a drift gap: ionization clusters along its way and delta electrons, those
// from the cathode in front of the gap and from the foils behind it included.
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
  HelixPoint entry, exit;  // at the inner and outer edge of the gap
  double bz;               // T
  double length;           // mm, along the track
};

// Where a delta electron was born.
enum class DeltaOrigin : std::int8_t { gas = 0, cathode = 1, behind = 2 };

// Energy left in the gap: at a point (an ionization cluster) or on a straight piece of a delta electron's
// way.
struct Deposit {
  double x, y, z;          // mm, its middle
  double dx, dy, dz;       // mm, from begin to end
  double energy;           // keV
  std::int32_t electrons;  // set free
  std::int32_t delta;      // 0 for a cluster of the particle itself, else 1, 2 ...
  DeltaOrigin origin;      // of that delta electron
};

struct GapResult {
  double energy;  // keV, everything left in the gap
  int electrons;  // set free
  int deltas;     // delta electrons that left something in the gap
};

// Delta electrons to be followed, and where on which track they were born.
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

// A crossing whose electrons are yet to be followed.
struct Ionized {
  int clusters;             // electrons set free in clusters
  std::size_t first, last;  // its delta electrons in the batch, `last` not included
};

// Random passage through a gap. `deltas`: electrons of more than a keV are born on the track, or in the
// solids, and followed; else what is born in the gas stays on the track up to 52 keV. Deposits of delta
// electrons are appended to `out`, with `keep_clusters` also the ionization clusters before them; nothing
// else depends on that. `place` is below 2^16.
GapResult ionize(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 std::vector<Deposit>& out);

// The same in two parts, between which the electrons of many crossings are followed.
Ionized set_free(const GapMatter& matter, const GapCrossing& crossing, const Kinematics& k,
                 const Stream& stream, std::uint32_t place, bool deltas, bool keep_clusters,
                 DeltaBatch& electrons, std::vector<Deposit>& out);
GapResult collect(const GapMatter& matter, const GapCrossing& crossing, const Ionized& ionized,
                  const DeltaBatch& electrons, std::vector<Deposit>& out);

}  // namespace cgemit
