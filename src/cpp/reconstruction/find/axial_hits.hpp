// The hits of an event that measure across the beam: axial wires and X clusters that no track has taken; and
// the fit of a circle to those near it. Or, in a chamber without axial wires, the wires of one stereo sign:
// drawn where they are at z = 0, those of a helix lie on a circle (`motion/views.hpp`).
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "motion/views.hpp"
#include "reconstruction/find/event_hits.hpp"
#include "reconstruction/find/find.hpp"

namespace cgemit {

// A circle with the covariance of (d, psi, w).
struct FoundCircle {
  double d, psi, w;
  std::array<double, 6> covariance;  // upper triangle
  std::vector<std::int32_t> hits;
};

// Where the fit of a circle begins.
struct CircleStart {
  double d, psi, w;
  double half_psi, half_w;  // largest errors of psi and w: half of the box that was searched
  double sigma_d;           // mm, distance from the beam line that the fit expects
};

struct AxialPoint {
  double x, y, drift, per;  // per: 2/(r^2 - l^2)
  std::uint64_t layer;      // one bit
  std::int32_t id;
  bool left_out;  // it led to a circle already
};

class AxialHits {
 public:
  // `sign`: 0 for axial wires and X clusters, 1 or -1 for stereo wires with a twist of this sign.
  AxialHits(const Detector& detector, const FindSettings& settings, int sign = 0);

  void load(const EventHits& hits);

  std::vector<AxialPoint>& points() { return points_; }
  // Whether hits take part in further circles, by their numbers.
  void leave_out(std::span<const std::int32_t> ids, bool left_out = true);
  // Layers that a circle needs: more where many cells fire by chance. A slow particle turns back after a few,
  // with several cells in each.
  int least(double w) const { return std::abs(w) > slow_w_ ? least_slow_ : least_; }
  // Whether so many cells fire by chance that a circle needs more layers than there are. Where there are too
  // few even without chance, as in chambers without axial wires, nothing is left out.
  bool are_too_many() const { return too_many_; }
  // 1/mm, of the smallest transverse momentum.
  double largest_w() const { return largest_w_; }
  double max_d() const { return max_d_; }  // mm, of a circle from the beam line
  // Of a view of one stereo sign.
  bool is_view() const { return sign_ != 0; }
  bool has(const WireLayer& layer) const { return stereo_sign(layer) == sign_; }
  std::uint64_t bit(std::size_t wire_layer) const { return bits_[wire_layer]; }

  // Fits a circle to the hits near a first one; the hits of the circle are left out afterwards. `more`:
  // layers beyond the least number. None: too few layers, or a circle outside of the limits of the settings.
  std::optional<FoundCircle> fit(const CircleStart& start, int more);

 private:
  void add(double x, double y, double drift, std::uint64_t layer, std::int32_t id);

  const Detector& detector_;
  const FindSettings& settings_;
  int sign_;
  double largest_w_;
  double beside_ = 0;  // mm, how far wires of a view may lie beside their circle
  double max_d_;
  std::vector<std::uint64_t> bits_;  // of each layer of wires
  std::vector<AxialPoint> points_;
  int of_circle_;  // layers that a circle needs, where no cells fire by chance
  double slow_w_;
  int least_ = 0, least_slow_ = 0, layers_ = 0;
  bool too_many_ = false;
};

}  // namespace cgemit
