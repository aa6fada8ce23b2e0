// Errors of the positions of clusters with charge, from the fluctuations of the charge and the numbers of a
// chip (docs/methods/readout.md, Errors).
#pragma once

#include <cstddef>
#include <span>
#include <tuple>

#include "common/columns.hpp"

namespace cgemit {

enum class Estimator { merged = 0, centroid = 1, micro_tpc = 2 };

// Factors of a chip, most of them near 1 where the formula holds as it stands.
struct ChipErrors {
  double ionization;  // on the variance of the mean height of the charge
  double cut;         // on that by charge below the threshold
  double diffusion;   // on the variance by diffusion, holes and gain
  double span;        // on the variance of heights by the gap that a strip sees
  double time;        // on the variance of heights by jitter and noise
  double wide;        // share of what the charge is wider than usual, in the variance
  double line;        // on the variance of a line with a free slope
  // What to add to heights: mm; by the part of the gap that a strip sees; by this and the threshold of all
  // strips over the charge of the cluster.
  double height_by_threshold;
  double noise, jitter;     // fC, ns
  double rise;              // ns, of the pulse
  double level;             // of the leading edge where the time is taken, over the charge; 0: the threshold
  double gain_variance;     // relative, of the charge of an electron of ionization
  double electrons_per_fC;  // of ionization, in one view
  double slope;             // spread of tracks' slopes about the direction from the beam line
  double share_spread;      // of ln(charge of X / charge of V) of one crossing
};

// One view of one layer.
struct PlaneErrors {
  double pitch, gap;  // mm
  double velocity;    // mm/ns
  double diffusion;   // mm^2, variance of one electron's place on the anode
  double cloud;       // mm^2, variance of the charge of one electron on the anode
  double threshold;   // fC
  double wave;        // mm^2, variance of a centroid by its place on the strip: strip_wave

  static constexpr auto columns() {
    return std::tuple(Column("pitch", &PlaneErrors::pitch), Column("gap", &PlaneErrors::gap),
                      Column("velocity", &PlaneErrors::velocity),
                      Column("diffusion", &PlaneErrors::diffusion), Column("cloud", &PlaneErrors::cloud),
                      Column("threshold", &PlaneErrors::threshold));
  }
};

// Variance, mm^2, of the centroid of a Gaussian cloud by its place on a strip: its integrals over strips
// leave (pitch/pi) exp(-2 pi^2 variance/pitch^2) sin(2 pi x/pitch), the first term of a Fourier series.
double strip_wave(double pitch, double variance);

// Mean of the sum of squares of the ionization clusters' shares of the electrons, by layer, path per radius
// and number of electrons.
struct ShareTable {
  std::span<const double> paths, numbers;  // growing
  std::span<const double> values;          // (layers, paths, numbers)

  double at(std::size_t layer, double path, double number) const;
};

// The charge of a cluster: weighted moments of its strips.
struct ChargeMoments {
  double charge = 0;                // fC
  double position = 0, height = 0;  // mm, means
  double xx = 0, xh = 0, hh = 0;    // mm^2
  double squares = 0;               // sum of the squares of the strips' shares
  double strips = 0;
};

// Direction of the charge's places of origin and of the track.
struct Direction {
  double slope;  // across the strips at the anode, by the height; of the places of origin
  double path;   // of the track, per radius
};

// The slope that the strips of a cluster have themselves.
struct OwnSlope {
  double value, weight;  // weight: 1 over its variance
};

struct ChargeErrors {
  ChipErrors chip;
  std::span<const PlaneErrors> planes;  // by view, then layer
  ShareTable shares;
  // By layer: mean of ln(charge) differences of two particles, and their times' (ns).
  std::span<const double> charges_apart, times_apart;
  // By layer: mean ln(number of electrons) of a particle along the radius.
  std::span<const double> log_numbers;

  const PlaneErrors& plane(int view, std::size_t layer) const {
    return planes[static_cast<std::size_t>(view) * planes.size() / 2 + layer];
  }
  // The part of the gap, mm, that a strip sees: sqrt(12) times the spread of the heights of its charge.
  double span(const PlaneErrors& plane, double slope) const;
  // Variance, ns^2, of the time of a strip by noise.
  double edge_variance(const PlaneErrors& plane, const ChargeMoments& charge) const;
  // Variance, mm^2, of the mean height of a cluster.
  double height_variance(int view, std::size_t layer, const ChargeMoments& charge, Direction direction) const;
  // Variances, mm^2, of the positions at mid-gap. `slope_variance`: of the slope that the position uses.
  double of_centroid(int view, std::size_t layer, const ChargeMoments& charge, Direction direction) const;
  double of_charge_line(int view, std::size_t layer, const ChargeMoments& charge, Direction direction,
                        double slope_variance) const;
  double of_free_line(int view, std::size_t layer, const ChargeMoments& charge, Direction direction) const;
  // The part of the variance of a centroid by charge below the threshold.
  double cut_variance(int view, std::size_t layer, const ChargeMoments& charge, Direction direction) const;
  // `span`: see above.
  OwnSlope own_slope(const PlaneErrors& plane, const ChargeMoments& charge, double span) const;
  // Of a cluster with a number of electrons that is as wide as expected. `of_track`: its slope is known.
  double expected(Estimator estimator, bool of_track, int view, std::size_t layer, Direction direction,
                  double electrons) const;

 private:
  double electrons(const ChargeMoments& charge) const;
  double common(const PlaneErrors& plane, std::size_t layer, const ChargeMoments& charge, double path,
                double excess) const;
};

// Practical range, mm, of an electron that sets free a number of electrons, at most `farthest`: beyond, the
// charge is a cluster of its own.
double delta_range(double electrons);

}  // namespace cgemit
