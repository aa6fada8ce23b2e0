// Clusters of strips with charge and time: centroid of the charge, line fit through the drift gap
// ("micro-TPC"), and their weighted mean (docs/methods/readout.md).
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "detector/cluster_rows.hpp"
#include "detector/strip_maps.hpp"
#include "reconstruction/cluster/digis.hpp"

namespace cgemit {

enum class Estimator { merged = 0, centroid = 1, micro_tpc = 2 };

// What the reconstruction assumes of one layer.
struct LayerTiming {
  double velocity;     // mm/ns, in the drift gap
  double tan_lorentz;  // in the drift gap, positive towards larger phi
  double shift;        // rad, Lorentz shift behind the drift gap
  double delay;  // ns, between the crossing and the arrival of electrons without drift in the induction gap
};

// Delay of the chip against the measured charge of a strip, by layer and view: rows of `points` entries each.
struct DelayTable {
  std::span<const double> charge, delay;  // fC, growing; ns
  std::size_t points;

  double at(std::size_t layer, int view, double strip_charge) const;
};

// Errors by estimator, view, layer, charge and number of strips; and what to add to the heights that times
// give. The charge of a cluster counts by the number of `edges` that it reaches. Larger clusters have the
// error of the largest size.
struct Calibration {
  std::span<const double> errors;  // mm; (3, 2, layers, charges, sizes)
  std::span<const double> shares;  // of the centroid in the merged position; (2, layers, charges, sizes)
  std::span<const double> depth;   // mm, outward, added to heights; (2, layers, charges)
  std::span<const double> height;  // mm, mean height of the charge of a centroid; (2, layers, charges)
  std::span<const double> edges;   // fC, growing; (2, layers, charges - 1)
  std::size_t layers, charges, sizes;

  // Row of a cluster in `depth` and `height`.
  std::size_t row(int view, std::size_t layer, double charge) const;
  // Entry in `errors`.
  std::size_t entry(Estimator which, std::size_t row, std::int32_t size) const;
  double error(Estimator which, std::size_t row, std::int32_t size) const;
  double share(std::size_t row, std::int32_t size) const;
};

// Likelihood of a pair of X and V clusters, by layer: mean and width of ln(charge of X / charge of V) and of
// the difference of their times (ns), and the widths of both for clusters of different tracks.
struct PairTable {
  static constexpr std::size_t entries = 6;
  // Share of the pairs of one particle of which a cluster has charge of something else, such as a delta
  // electron or another track, or has lost a part: their charges and times differ as those of two particles.
  static constexpr double touched = 0.1;
  std::span<const double> values;  // (layers, entries)

  // Logarithm of the ratio of likelihoods, of one track over two tracks; never below that of a pair of which
  // a cluster is touched.
  double score(const ClusterRow& x, const ClusterRow& v) const;
};

// Errors of positions of which the track's angle is known, by estimator, view, layer, |slope| of the
// electrons' places of origin at the anode, and number of strips.
struct SlopeErrors {
  std::span<const double> values;  // mm; (3, 2, layers, ranges, sizes)
  std::span<const double> shares;  // of the centroid in the merged position; (2, layers, ranges, sizes)
  std::span<const double> edges;   // (ranges - 1), growing
  std::size_t layers, sizes;       // larger clusters have the error of the largest size

  // Entry in `shares`, and in `values` for one estimator.
  std::size_t row(int view, std::size_t layer, double slope, std::int32_t size) const;
  double error(Estimator which, std::size_t row) const;
};

// Factors on the errors: by charge and number of strips of positions that use the track's angle, and by the
// distance of centroid and line; the first one is for clusters without a line, which have the centroid. They
// are far apart where a delta electron or the fluctuation of the charge has moved one of them.
struct ErrorFactors {
  std::span<const double> along;  // as `Calibration::errors`
  std::span<const double> edges;  // mm, growing; (without, with the track's angle; 2, layers, ranges - 2)
  std::span<const double> apart;  // (without, with the track's angle; 3, 2, layers, ranges)
  std::size_t planes, ranges;     // planes: 2 layers

  // `plane`: view * layers + layer; `distance`: 0 without a line.
  double of_distance(bool with_angle, Estimator which, std::size_t plane, double distance) const;
};

// What is known of the direction of a cluster's track: from the track itself, or from the place where X and V
// cross, for a straight track from the beam line.
struct Direction {
  double slope;  // of the electrons' places of origin at the anode
  double path;   // path per radius
};

// What the direction does to a position. The time of a strip is that of its first electrons, and its heights
// are wrong by an amount that depends on how many it has and from how much of the gap they come.
struct DirectionTable {
  std::span<const double> slopes, paths;  // growing, from 0 and from 1
  // Both by what knows the direction (place, track), estimator, view and layer, then at all `slopes` and
  // `paths`: the height (mm) that times the slope is too much in the position, linear between them, and
  // factors on the error, equal from each one to the next. Both are for the slope and for the path, and join.
  std::span<const double> depths, factors;
  std::size_t planes;  // 2 layers

  // First entry of a cluster; `plane`: view * layers + layer.
  std::size_t row(bool of_track, Estimator which, std::size_t plane) const;
  double shift(std::size_t row, Direction direction) const;
  double factor(std::size_t row, Direction direction) const;
};

struct ChargeTimeModel {
  std::span<const LayerTiming> layers;
  DelayTable delays;
  Calibration calibration;
  Estimator estimator;
  std::int32_t missing;          // strips that may be missing within a cluster
  StripMask mask;                // strips that count as not there
  std::span<const double> gain;  // relative gain of each strip by gid; empty: 1
  double
      edge;  // outermost strips with less than this share of their neighbour's charge do not enter line fits
  double valley;  // a strip with less than this share of both maxima beside it divides a cluster
  double margin;  // ns; strips whose drift time lies farther outside that of the gap do not count
  PairTable pairs;
  SlopeErrors slope_errors;
  ErrorFactors factors;
  DirectionTable directions;
  // By row of the result: dX/dr or dV/dr of the track at the anode, and its path per radius; NaN: unknown.
  // Empty: none is known.
  std::span<const double> slopes, paths;
};

// Position of a strip and where in the gap its charge comes from.
struct StripPoint {
  double position;  // mm, X or V at the anode, without correction
  double charge;    // fC
  double height;    // mm, outward from mid-gap; of the start of its electrons
};

// Line x = a + b w through points at heights w: least squares in x with weights 1/(1 + mean
// charge/charge), and with `stiffness` (mm^2) times the square of the slope. Finite at any incidence. `good`
// is false for fewer than three points, or if all are at one height and nothing is stiff.
struct Line {
  double at_middle, slope;
  bool good;
};
Line fit_line(std::span<const StripPoint> points, double stiffness);

// The same with a given slope: good for any number of points.
Line fit_line_along(std::span<const StripPoint> points, double slope);

// Rows ordered by event, layer, sheet, then X, V and XV clusters, with positions at mid-gap.
ClusterColumns find_charge_time_clusters(const Detector& detector, const DigiView& digis,
                                         const ChargeTimeModel& model);

}  // namespace cgemit
