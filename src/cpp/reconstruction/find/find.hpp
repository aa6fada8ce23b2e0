// Track finding: seeds from CGEM clusters and from the drift chamber, followed outward by a combinatorial
// Kalman filter. Reads measurements only.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "common/interrupt.hpp"
#include "kalman/group.hpp"
#include "matter/kinematics.hpp"
#include "reconstruction/find/pair_scores.hpp"

namespace cgemit {

// Default values are in `cgemit.reconstruction.find.ckf.FindSettings`.
struct FindSettings {
  bool segments, chamber;  // the sources of seeds
  double mass;             // GeV
  double charge;           // e, unsigned
  double efficiency;       // of a layer or cell that a track crosses
  double gate;             // standard deviations
  int branches;            // kept at a time
  int passes;              // of the filter over a track, each about the track that the last one found
  int holes_in_row;        // a branch ends beyond so many
  double max_d, max_z;     // mm, from the beam line and from the origin, at the closest approach
  double min_pt;           // GeV/c
  int least_axial;         // layers of a seed of the chamber
  double min_score;        // of a track, logarithm of a likelihood ratio
  int max_seeds;           // per event and source
  bool annealing;          // of wire hits near several tracks
  double least_width, delta_strips;  // cluster errors, as in the fit
  double momentum;  // GeV/c, with which all tracks scatter and lose energy; 0: that of their curvature
};

// The particle that the finder assumes for a track with this kappa.
inline Species species_of(const FindSettings& settings, double kappa) {
  return species_of(settings.mass, settings.charge, kappa);
}

// Hits `offsets[i]` to `offsets[i + 1]` belong to event i.
struct FindInput {
  std::span<const std::int64_t> offsets;
  std::span<const Hit> hits;
  PairScores pairs = {};
  Interrupted interrupted = never_interrupted;
};

// Limits that a search has reached, each a bit. Names are those of `cgemit.reconstruction.find.ckf`.
enum SearchLimit : std::uint8_t {
  limit_segments = 1,   // combinations or seeds of CGEM segments
  limit_circles = 2,    // circles in the chamber that were followed
  limit_boxes = 4,      // divided boxes
  limit_local = 8,      // segments in the chamber
  limit_heights = 16,   // heights of one circle
  limit_layers = 32,    // layers that a circle needs, where so many cells fire
  limit_failures = 64,  // circles in a row that led to no track beyond doubt
};

// Hits `offsets[i]` to `offsets[i + 1]` of track i, as numbers of the input's hits, from the beam line
// outward. The tracks of an event follow each other, the best one first.
struct FindOutput {
  std::vector<std::int64_t> event, offsets, hits;
  std::vector<double> score, chi2;
  std::vector<std::int64_t> holes;
  // Of each event: seeds that were followed, and the limits that cut the search off (`SearchLimit`).
  std::vector<std::int64_t> seeds;
  std::vector<std::uint8_t> limits;

  static constexpr auto columns() {
    return std::tuple(Column("event", &FindOutput::event), Column("offsets", &FindOutput::offsets),
                      Column("hits", &FindOutput::hits), Column("score", &FindOutput::score),
                      Column("chi2", &FindOutput::chi2), Column("holes", &FindOutput::holes),
                      Column("seeds", &FindOutput::seeds), Column("limits", &FindOutput::limits));
  }
};

// Pairs of layers that one track may cross, the inner one first, with so many layers between them at most. Of
// those between, layers about z = 0 count, and others if all lines through the pair cross them.
using LayerPair = std::array<std::size_t, 2>;
inline constexpr int between_two = 1;  // layers between those of a segment of two
std::vector<LayerPair> layer_pairs(const Detector& detector, int most_between);

// Layers that a circle from the beam line needs, where no cells fire by chance: of axial wires and with X.
// Where layers of the detector measure one coordinate, of which no segments are made, all that a track
// crosses may be few.
int circle_layers(const Detector& detector, int least_axial);
// Layers of one stereo sign that a circle of this view needs, of so many of them.
int view_layers(int layers, int least_axial);

FindOutput find_tracks(const Detector& detector, const FindInput& input, const FindSettings& settings);

}  // namespace cgemit
