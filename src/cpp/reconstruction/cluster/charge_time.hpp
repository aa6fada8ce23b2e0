// Clusters of strips with charge and time: centroid of the charge, line fit through the drift gap
// ("micro-TPC"), and the line through the charge with what is known of its slope (docs/methods/readout.md).
#pragma once

#include <cstdint>
#include <span>
#include <tuple>

#include "common/columns.hpp"
#include "readout/cluster_rows.hpp"
#include "readout/strip_maps.hpp"
#include "reconstruction/cluster/charge_errors.hpp"
#include "reconstruction/cluster/digis.hpp"

namespace cgemit {

// What the reconstruction assumes of one layer.
struct LayerTiming {
  double velocity;     // mm/ns, in the drift gap
  double tan_lorentz;  // in the drift gap, positive towards larger phi
  double shift;        // rad, Lorentz shift behind the drift gap
  double delay;  // ns, between the crossing and the arrival of electrons without drift in the induction gap

  static constexpr auto columns() {
    return std::tuple(Column("velocity", &LayerTiming::velocity),
                      Column("tan_lorentz", &LayerTiming::tan_lorentz), Column("shift", &LayerTiming::shift),
                      Column("delay", &LayerTiming::delay));
  }
};

// Delay of the chip by layer, view, time in which the charge of a strip arrives, and measured charge: between
// the mean arrival and the measured time.
struct DelayTable {
  std::span<const double> spreads;  // ns, growing from 0 in equal steps
  std::span<const double> charges;  // fC, growing; (2 layers, points)
  std::span<const double> delays;   // ns; (2 layers, spreads, points); X of all layers, then V
  std::size_t points;

  double at(int view, std::size_t layer, double spread, double charge) const;
};

struct ChargeTimeModel {
  std::span<const LayerTiming> layers;
  DelayTable delays;
  ChargeErrors errors;
  Estimator estimator;
  std::int32_t missing;          // strips that may be missing within a cluster
  StripMask mask;                // strips that count as not there
  std::span<const double> gain;  // relative gain of each strip by gid; empty: 1
  double
      edge;  // outermost strips with less than this share of their neighbour's charge do not enter line fits
  double valley;  // a strip with less than this share of both maxima beside it divides a cluster
  double margin;  // ns; strips whose drift time lies farther outside that of the gap do not count
  bool timed;     // whether strips have times
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

// Rows ordered by event, layer, sheet, then X, V and XV clusters, with positions at mid-gap.
Columns<ClusterRow> find_charge_time_clusters(const Detector& detector, const DigiView& digis,
                                              const ChargeTimeModel& model);

}  // namespace cgemit
