// Positions of clusters that lost charge beside their strips: beyond the edge of a sheet, or on strips that
// give no signal (docs/methods/readout.md, Lost charge).
#pragma once

#include <span>

namespace cgemit {

// The strips of a cluster that are used, and what is beside them.
struct SeenStrips {
  std::span<const double> middles;  // mm, growing
  double pitch;
  // Whether the strip before the first one, or after the last one, could have fired and did not.
  bool silent_below, silent_above;
  double edge_below, edge_above;  // mm, of the sheet; infinite where the cluster does not reach it
};

// The charge of a cluster across its strips: a line of this slope through the gap, smeared by a Gaussian.
struct ChargeProfile {
  double slope, gap, sigma;  // across the strips by the height; mm
  bool fluctuates;           // whether strips may be silent since the charge is uneven along the line
};

// What was measured of the charge.
struct MeasuredCharge {
  double position;          // mm, at the anode, of electrons from mid-gap
  double variance;          // mm^2, without lost charge
  bool on_line;             // whether the position follows from the heights of the strips, or is a centroid
  double charge;            // fC
  double threshold, noise;  // fC, of a strip
  double uneven;            // variance of a share s of the charge, over s (1 - s)
  double log_charge, charge_spread;  // expected ln(charge), and its standard deviation
};

// Mean and variance of the position, given what is seen, and of the distance that the charge on the sheet has
// from its line, across the strips.
struct FoundPosition {
  double position, variance;               // mm, mm^2
  double beside = 0, beside_variance = 0;  // mm, mm^2
};

FoundPosition position_of_seen(const SeenStrips& strips, const ChargeProfile& profile,
                               const MeasuredCharge& measured);

}  // namespace cgemit
