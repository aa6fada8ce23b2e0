// Positions of the clusters of one view of one layer: heights of strips, Lorentz shift, centroid and line.
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <vector>

#include "detector/strip_plane.hpp"
#include "reconstruction/cluster/charge_time.hpp"
#include "reconstruction/cluster/strip_runs.hpp"

namespace cgemit {

inline constexpr double least_charge = 1e-3;  // fC

// A strip of a cluster.
struct FiredStrip {
  double position;  // mm, X or V at the anode
  double charge,
      measured;  // fC: at a gain of 1 and its share of a divided strip; as the chip has measured it
  double drift;  // ns, after the arrival of electrons without drift; with the delay of the chip
};

inline ChargeMoments moments_of(std::span<const StripPoint> points) {
  ChargeMoments found;
  const double origin = points.front().position;
  for (const StripPoint& point : points) {
    found.charge += point.charge;
    found.position += point.charge * (point.position - origin);
    found.height += point.charge * point.height;
  }
  found.position /= found.charge;
  found.height /= found.charge;
  for (const StripPoint& point : points) {
    const double share = point.charge / found.charge, x = point.position - origin - found.position,
                 h = point.height - found.height;
    found.xx += share * x * x;
    found.xh += share * x * h;
    found.hh += share * h * h;
    found.squares += share * share;
  }
  found.position += origin;
  found.strips = static_cast<double>(points.size());
  return found;
}

// One view of one layer.
class ViewReconstruction {
 public:
  ViewReconstruction(const MeasuringLayer& layer, std::size_t number, int view, const ChargeTimeModel& model)
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
  std::vector<FiredStrip> strips(const DigiView& digis, StripRun rows) const {
    std::vector<FiredStrip> found;
    found.reserve(rows.size());
    for (std::size_t i = 0; i < rows.size(); ++i) {
      const std::size_t row = rows.rows[i];
      const double strip = digis.strip[row] + 0.5, charge = std::max(rows.charge(digis, i), least_charge);
      found.push_back({view_ == 0 ? x_of_strips(layer_, strip) : v_of_strips(layer_, strip),
                       charge / gain(digis, row), std::max(digis.charge[row], least_charge),
                       digis.time[row] - timing_.delay});
    }
    return found;
  }
  // Heights are those of the mean arrival of a strip's charge, which comes from all of the gap that the strip
  // sees. `slope`: of the places of origin at the anode.
  void points(std::span<const FiredStrip> strips, double slope, std::vector<StripPoint>& found) const {
    const PlaneErrors& plane = model_.errors.plane(view_, number_);
    const double seen = model_.timed ? model_.errors.span(plane, slope) : 0;
    double charge = 0;
    for (const FiredStrip& strip : strips) charge += strip.charge;
    const double lost = plane.threshold * static_cast<double>(strips.size()) / charge;
    const double start = half_gap() + seen * model_.errors.chip.height_by_threshold * lost;
    found.clear();
    for (const FiredStrip& strip : strips) {
      const double delay = model_.delays.at(view_, number_, seen / timing_.velocity, strip.measured);
      const double height = model_.timed ? start - (strip.drift - delay) * timing_.velocity : 0;
      found.push_back({strip.position, strip.charge, height});
    }
  }
  // Mean time of the charge, ns, without the delay of the chip.
  double time(std::span<const FiredStrip> strips, const ChargeMoments& charge) const {
    if (model_.timed) return timing_.delay + (half_gap() - charge.height) / timing_.velocity;
    double sum = 0;
    for (const FiredStrip& strip : strips) sum += strip.charge * strip.drift;
    return timing_.delay + sum / charge.charge;
  }
  // Slope of the electrons' places of origin as the anode sees them, for a slope of the track.
  double slope_at_anode(double slope) const { return slope - across_ * timing_.tan_lorentz / layer_.r_mid(); }
  // Line through the strips inside the gap, each moved back by its own Lorentz shift.
  Line line(std::span<const StripPoint> all) const {
    std::vector<StripPoint> used;
    used.reserve(all.size());
    for (std::size_t i = 0; i < all.size(); ++i) {
      if (std::abs(all[i].height) > half_gap() + outside || induced(all, i)) continue;
      used.push_back(all[i]);
      used.back().position += to_border(all, i) - lorentz(all[i].height);
    }
    if (used.size() < 3) return {0, 0, false};
    const double origin = used.front().position;
    for (StripPoint& point : used) point.position -= origin;
    Line found = fit_line(used, stiffness());
    found.at_middle += origin;
    return found;
  }

 private:
  double half_gap() const { return layer_.r_gap_out - layer_.r_mid(); }
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
  const MeasuringLayer& layer_;
  std::size_t number_;
  int view_;
  const ChargeTimeModel& model_;
  const LayerTiming& timing_;
  double across_;
};

}  // namespace cgemit
