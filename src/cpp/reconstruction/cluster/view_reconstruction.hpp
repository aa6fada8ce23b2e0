// Positions of the clusters of one view of one layer: heights of strips, Lorentz shift, centroid and line.
#pragma once

#include <algorithm>
#include <cmath>
#include <optional>
#include <span>
#include <vector>

#include "detector/strip_plane.hpp"
#include "reconstruction/cluster/charge_time.hpp"
#include "reconstruction/cluster/strip_runs.hpp"

namespace cgemit {

inline constexpr double least_charge = 1e-3;  // fC

// One view of one layer.
class ViewReconstruction {
 public:
  ViewReconstruction(const CgemLayer& layer, std::size_t number, int view, const ChargeTimeModel& model)
      : layer_(layer),
        number_(number),
        view_(view),
        model_(model),
        timing_(model.layers[number]),
        across_(layer.r_readout * (view == 0 ? 1.0 : layer.cos_stereo)) {}

  // Lorentz shift of electrons from a height above mid-gap to the anode.
  double lorentz(double height) const {
    const double from = std::clamp(layer_.r_mid() + height, layer_.r_gap_in, layer_.r_gap_out);
    return across_ * (timing_.tan_lorentz * std::log(layer_.r_gap_out / from) + timing_.shift);
  }
  // Relative gain at the strip of a digi.
  double gain(const DigiView& digis, std::size_t row) const {
    if (model_.gain.empty()) return 1;
    return model_.gain[static_cast<std::size_t>(gid_of(layer_, digis.sheet[row], view_, digis.strip[row]))];
  }
  // `depth` is added to the heights.
  std::vector<StripPoint> points(const DigiView& digis, StripRun rows, double depth) const {
    const double start = layer_.r_gap_out - layer_.r_mid() + depth;
    std::vector<StripPoint> found;
    found.reserve(rows.size());
    for (std::size_t i = 0; i < rows.size(); ++i) {
      const std::size_t row = rows.rows[i];
      const double strip = digis.strip[row] + 0.5, charge = std::max(rows.charge(digis, i), least_charge);
      const double measured = std::max(digis.charge[row], least_charge);
      const double drift = digis.time[row] - timing_.delay - model_.delays.at(number_, view_, measured);
      found.push_back({view_ == 0 ? x_of_strips(layer_, strip) : v_of_strips(layer_, strip),
                       charge / gain(digis, row), start - drift * timing_.velocity});
    }
    return found;
  }
  // Mean time of the charge, ns, without the delay of the chip; `depth` as for `points`.
  double time(std::span<const StripPoint> points, double depth) const {
    const double start = layer_.r_gap_out - layer_.r_mid() + depth;
    double charge = 0, sum = 0;
    for (const StripPoint& point : points) {
      charge += point.charge;
      sum += point.charge * (start - point.height);
    }
    return timing_.delay + sum / charge / timing_.velocity;
  }
  // Slope of the electrons' places of origin as the anode sees them, for a slope of the track.
  double slope_at_anode(double slope) const { return slope - across_ * timing_.tan_lorentz / layer_.r_mid(); }
  // `height`: mean one of the charge.
  double centroid(std::span<const StripPoint> all, double height) const {
    double charge = 0, sum = 0;
    for (const StripPoint& point : all) {
      charge += point.charge;
      sum += point.charge * (point.position - all.front().position);
    }
    return all.front().position + sum / charge - lorentz(height);
  }
  // Line through the strips inside the gap, each moved back by its own Lorentz shift. With a slope it only
  // needs one strip.
  Line line(std::span<const StripPoint> all, std::optional<double> slope) const {
    const double half = layer_.r_gap_out - layer_.r_mid() + outside;
    std::vector<StripPoint> used;
    used.reserve(all.size());
    for (std::size_t i = 0; i < all.size(); ++i) {
      if (std::abs(all[i].height) > half || induced(all, i)) continue;
      used.push_back(all[i]);
      used.back().position += to_border(all, i) - lorentz(all[i].height);
    }
    if (used.size() < (slope ? 1 : 3)) return {0, 0, false};
    const double origin = used.front().position;
    for (StripPoint& point : used) point.position -= origin;
    Line found = slope ? fit_line_along(used, *slope) : fit_line(used, stiffness());
    found.at_middle += origin;
    return found;
  }

 private:
  // Where on an outermost strip its charge is, from the middle: a cloud that hardly reaches the strip has its
  // charge at the border to the neighbour, one with as much charge as the neighbour in the middle.
  double to_border(std::span<const StripPoint> all, std::size_t i) const {
    if (all.size() < 2 || (i != 0 && i + 1 != all.size())) return 0;
    const double pitch = view_ == 0 ? layer_.pitch_x : layer_.pitch_v;
    const double far = 0.5 * pitch * std::max(0.0, 1 - all[i].charge / all[i == 0 ? 1 : i - 1].charge);
    return i == 0 ? far : -far;
  }
  // Slopes of tracks are of the order of 1: a line through strips at nearly one height has none of its own.
  double stiffness() const {
    const double pitch = view_ == 0 ? layer_.pitch_x : layer_.pitch_v;
    return pitch * pitch / 12 / (usual_slope * usual_slope);
  }
  // Whether a strip at the edge has so little charge that its neighbour may have induced it.
  bool induced(std::span<const StripPoint> all, std::size_t i) const {
    if (all.size() < 4 || (i != 0 && i + 1 != all.size())) return false;
    return all[i].charge < model_.edge * all[i == 0 ? 1 : i - 1].charge;
  }

  static constexpr double usual_slope = 1;
  static constexpr double outside = 0.2;  // mm, by which a strip's height may lie outside the gap
  const CgemLayer& layer_;
  std::size_t number_;
  int view_;
  const ChargeTimeModel& model_;
  const LayerTiming& timing_;
  double across_;
};

}  // namespace cgemit
