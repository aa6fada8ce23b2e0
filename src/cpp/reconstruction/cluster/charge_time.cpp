#include "reconstruction/cluster/charge_time.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "reconstruction/cluster/lost_charge.hpp"
#include "reconstruction/cluster/strip_runs.hpp"
#include "reconstruction/cluster/view_reconstruction.hpp"

namespace cgemit {

namespace {

double mean_charge(std::span<const StripPoint> points) {
  double total = 0;
  for (const StripPoint& point : points) total += point.charge;
  return total / static_cast<double>(points.size());
}

// Variance of a position: one part of all strips, one that falls with the number of electrons.
double weight_of(const StripPoint& point, double mean) { return 1 / (1 + mean / point.charge); }

}  // namespace

double DelayTable::at(int view, std::size_t layer, double spread, double charge) const {
  const std::size_t layers = charges.size() / points / 2,
                    plane = static_cast<std::size_t>(view) * layers + layer;
  const std::span<const double> q = charges.subspan(plane * points, points);
  std::size_t below = 0;
  double share = 0;
  if (charge >= q.back()) {
    below = points - 2;
    share = 1;
  } else if (charge > q.front()) {
    below = static_cast<std::size_t>(std::ranges::upper_bound(q, charge) - q.begin()) - 1;
    share = (charge - q[below]) / (q[below + 1] - q[below]);
  }
  const auto row = [&](std::size_t i) {
    const double* const at = &delays[(plane * spreads.size() + i) * points + below];
    return at[0] + share * (at[1] - at[0]);
  };
  if (spreads.size() < 2) return row(0);
  const double nth =
      std::clamp(spread / (spreads[1] - spreads[0]), 0.0, static_cast<double>(spreads.size() - 1));
  const auto first = std::min(static_cast<std::size_t>(nth), spreads.size() - 2);
  return row(first) + (nth - static_cast<double>(first)) * (row(first + 1) - row(first));
}

Line fit_line(std::span<const StripPoint> points, double stiffness) {
  const double mean = mean_charge(points);
  double s = 0, sw = 0, sx = 0, sww = 0, swx = 0;
  for (const StripPoint& point : points) {
    const double weight = weight_of(point, mean);
    s += weight;
    sw += weight * point.height;
    sx += weight * point.position;
    sww += weight * point.height * point.height;
    swx += weight * point.height * point.position;
  }
  const double determinant = s * (sww + stiffness) - sw * sw;
  if (points.size() < 3 || !(determinant > 1e-9 * s * s)) return {0, 0, false};
  const double slope = (s * swx - sw * sx) / determinant;
  return {(sx - slope * sw) / s, slope, true};
}

namespace {

// Of a straight track from the beam line through a place at z.
double slope_at(const MeasuringLayer& layer, ClusterView view, double z) {
  return view == ClusterView::x ? 0 : -layer.sin_stereo * z / layer.r_mid();
}
double path_at(const MeasuringLayer& layer, double z) {
  const double rise = z / layer.r_mid();
  return std::sqrt(1 + rise * rise);
}

class ChargeTimeClusters {
 public:
  // Errors of clusters beside masked strips say what these have lost.
  static constexpr bool knows_lost_charge = true;

  ChargeTimeClusters(const DigiView& digis, const ChargeTimeModel& model) : digis_(digis), model_(model) {}

  // Whether the strip fired while electrons of the event may have arrived.
  bool keeps(const MeasuringLayer& layer, std::size_t row) const {
    const auto number = static_cast<std::size_t>(digis_.layer[row]);
    const LayerTiming& timing = model_.layers[number];
    const double charge = std::max(digis_.charge[row], least_charge),
                 drift =
                     digis_.time[row] - timing.delay - model_.delays.at(digis_.view[row], number, 0, charge);
    const double longest = (layer.r_gap_out - layer.r_gap_in) / timing.velocity;
    return drift >= -model_.margin && drift <= longest + model_.margin;
  }

  // Lowest strips between two larger maxima.
  void cuts(const MeasuringLayer&, std::span<const std::size_t> rows, std::vector<std::size_t>& cuts) const {
    if (!(model_.valley > 0)) return;
    const auto charge = [&](std::size_t i) { return digis_.charge[rows[i]]; };
    std::size_t peak = 0, lowest = 0;  // since the last cut; the lowest one behind the peak
    for (std::size_t i = 1; i < rows.size(); ++i) {
      if (charge(lowest) < model_.valley * std::min(charge(peak), charge(i))) {
        cuts.push_back(lowest);
        peak = lowest = i;
      } else if (charge(i) > charge(peak)) {
        peak = lowest = i;
      } else if (charge(i) < charge(lowest)) {
        lowest = i;
      }
    }
  }

  ClusterRow make(const MeasuringLayer& layer, StripRun run, std::size_t row) {
    ClusterRow cluster = row_of_run(layer, digis_, run);
    if (!model_.slopes.empty() && row >= model_.slopes.size()) {
      throw std::invalid_argument("slopes: expected one for each cluster");
    }
    const ViewReconstruction plane = plane_of(layer, cluster);
    sheet_.push_back({plane.strips(digis_, run), {}, ends_of(layer, run, cluster), {}});
    sheet_.back().charge = charge_at(plane, sheet_.back().strips, plane.slope_at_anode(0));
    cluster.method = ClusterMethod::positions;
    measure(layer, sheet_.back(), {0, 1, false}, cluster, false);
    if (has_track(row)) {
      const double alone = cluster.view == ClusterView::x ? cluster.x : cluster.v;
      measure(layer, sheet_.back(), {model_.slopes[row], model_.paths[row], true}, cluster, true);
      cluster.shift = (cluster.view == ClusterView::x ? cluster.x : cluster.v) - alone;
    }
    return cluster;
  }

  // Logarithm of the ratio of likelihoods, of one track over two tracks, of clusters of the sheet that cross
  // at z; never below that of a pair of which one has charge of something else.
  double score(const MeasuringLayer& layer, std::span<const ClusterRow> views, std::size_t i, std::size_t k,
               double z) {
    const Arrival x = arrival(layer, views[i], sheet_[i], z), v = arrival(layer, views[k], sheet_[k], z);
    const auto number = static_cast<std::size_t>(views[i].layer);
    const auto ratio = [](double value, double variance, double apart) {
      const double wide = apart * apart + variance;
      return 0.5 * (value * value / wide - value * value / variance + std::log(wide / variance));
    };
    const double spread = model_.errors.chip.share_spread;
    double clean = std::log1p(-touched) + ratio(std::log(x.charge / v.charge),
                                                spread * spread + x.charge_variance + v.charge_variance,
                                                model_.errors.charges_apart[number]);
    if (model_.timed)
      clean += ratio(x.time - v.time, x.time_variance + v.time_variance, model_.errors.times_apart[number]);
    // ln(exp(clean) + touched), for any size of `clean`.
    const double floor = std::log(touched);
    return std::max(clean, floor) + std::log1p(std::exp(-std::abs(clean - floor)));
  }

  // Clusters of no known track have the direction of a straight one from the beam line through the place of
  // their best pair.
  void place(const MeasuringLayer& layer, std::span<ClusterRow> views, std::span<const CrossingPair> pairs,
             std::size_t first) {
    std::vector<const CrossingPair*> best(views.size(), nullptr);
    for (const CrossingPair& pair : pairs) {
      for (const std::size_t i : {pair.x, pair.v}) {
        if (!best[i] || pair.score > best[i]->score) best[i] = &pair;
      }
    }
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (has_track(first + i) || (!best[i] && !sheet_[i].ends.lose())) continue;
      const Known known = best[i] ? towards(layer, views[i], best[i]->z) : Known{0, 1, false};
      measure(layer, sheet_[i], known, views[i], true);
    }
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (best[i] && views[i].view == ClusterView::v) shift_v(layer, sheet_[best[i]->x].lost, views[i]);
    }
    sheet_.clear();
  }

 private:
  // Share of the pairs of one particle of which a cluster has charge of something else, such as a delta
  // electron or another track, or has lost a part: their charges and times differ as those of two particles.
  static constexpr double touched = 0.1;
  // Squares of its error by which the strips' own slope may differ from that of a track from the beam line.
  static constexpr double disagreement = 1;

  // What is known of the direction of a cluster's track.
  struct Known {
    double slope, path;  // dX/dr or dV/dr at the anode; path per radius
    bool of_track;       // or of a straight track from the beam line
  };
  struct Arrival {
    double charge, charge_variance;  // fC; relative
    double time, time_variance;      // ns
  };

  bool has_track(std::size_t row) const {
    return !model_.slopes.empty() && std::isfinite(model_.slopes[row]);
  }
  ViewReconstruction plane_of(const MeasuringLayer& layer, const ClusterRow& cluster) const {
    return {layer, static_cast<std::size_t>(cluster.layer), static_cast<int>(cluster.view), model_};
  }
  static Known towards(const MeasuringLayer& layer, const ClusterRow& cluster, double z) {
    return {slope_at(layer, cluster.view, z), path_at(layer, z), false};
  }

  // What is beside a cluster: the edge of the sheet, strips that give no signal, or silent ones; strips that
  // give none may be within it, too.
  struct Ends {
    bool edge_below = false, edge_above = false, masked_below = false, masked_above = false;
    bool silent_below = false, silent_above = false, holes = false;

    bool lose() const { return edge_below || edge_above || masked_below || masked_above || holes; }
  };
  // The strips of a cluster, and their charge as of a track along the radius.
  struct Fired {
    std::vector<FiredStrip> strips;
    ChargeMoments charge;
    Ends ends;
    FoundPosition lost;  // of an X cluster at the edge of the sheet: what its charge there is beside
  };

  Ends ends_of(const MeasuringLayer& layer, StripRun run, const ClusterRow& cluster) const {
    const int view = static_cast<int>(cluster.view), strips = view == 0 ? layer.strips_x : layer.strips_v;
    const int gid = gid_of(layer, cluster.sheet, view, 0);
    const bool has_mask = !model_.mask.is_empty();
    Ends ends;
    if (!run.shares_first) {
      ends.edge_below = cluster.first == 0;
      ends.masked_below = has_mask && cluster.first > 0 && model_.mask(gid + cluster.first - 1);
      ends.silent_below = !ends.edge_below && !ends.masked_below;
    }
    if (!run.shares_last) {
      ends.edge_above = cluster.last == strips - 1;
      ends.masked_above = has_mask && !ends.edge_above && model_.mask(gid + cluster.last + 1);
      ends.silent_above = !ends.edge_above && !ends.masked_above;
    }
    ends.holes = has_mask && model_.mask.count(gid + cluster.first, gid + cluster.last) > 0;
    return ends;
  }

  ChargeMoments charge_at(const ViewReconstruction& plane, std::span<const FiredStrip> strips, double slope) {
    plane.points(strips, slope, points_);
    return moments_of(points_);
  }

  // Charge and mean time of a cluster whose track comes from the beam line through z.
  Arrival arrival(const MeasuringLayer& layer, const ClusterRow& cluster, const Fired& fired, double z) {
    const ViewReconstruction plane = plane_of(layer, cluster);
    const double along = slope_at(layer, cluster.view, z), slope = plane.slope_at_anode(along);
    const ChargeMoments charge = along == 0 ? fired.charge : charge_at(plane, fired.strips, slope);
    const ChargeErrors& errors = model_.errors;
    const int view = static_cast<int>(cluster.view);
    const auto number = static_cast<std::size_t>(cluster.layer);
    const PlaneErrors& at = errors.plane(view, number);
    const double lost = at.threshold / charge.charge, noise = errors.chip.noise / charge.charge;
    return {charge.charge, charge.strips * noise * noise + lost * lost / 6, plane.time(fired.strips, charge),
            errors.height_variance(view, number, charge, {slope, std::hypot(1.0, z / layer.r_mid())}) /
                (at.velocity * at.velocity)};
  }

  // Corrects position and variance of a cluster for charge that was lost beside its strips. `slope`: of the
  // charge; `shift`: of the position, from the anode to mid-gap; `on_line`: see MeasuredCharge.
  void restore(std::size_t number, Fired& fired, const ChargeMoments& charge, Direction direction,
               bool on_line, double shift, ClusterView view, double& value, double& variance) {
    const bool is_x = view == ClusterView::x;
    const ChargeErrors& errors = model_.errors;
    const PlaneErrors& at = errors.plane(is_x ? 0 : 1, number);
    const double infinite = std::numeric_limits<double>::infinity();
    const Ends& ends = fired.ends;
    middles_.clear();
    for (const FiredStrip& strip : fired.strips) middles_.push_back(strip.position);
    const SeenStrips strips{.middles = middles_,
                            .pitch = at.pitch,
                            .silent_below = ends.silent_below,
                            .silent_above = ends.silent_above,
                            .edge_below = ends.edge_below ? middles_.front() - 0.5 * at.pitch : -infinite,
                            .edge_above = ends.edge_above ? middles_.back() + 0.5 * at.pitch : infinite};
    const ChargeProfile profile{direction.slope, at.gap, std::sqrt(at.cloud + at.diffusion),
                                errors.chip.gain_variance > 0};
    const double number_of = charge.charge * errors.chip.electrons_per_fC;
    // The strips that are seen say what charge that does not fluctuate has lost below the threshold.
    const double known =
        profile.fluctuates ? 0 : errors.cut_variance(is_x ? 0 : 1, number, charge, direction);
    const double uneven = errors.chip.ionization * errors.shares.at(number, direction.path, number_of);
    const FoundPosition found = position_of_seen(
        strips, profile,
        {.position = value + shift,
         .variance = variance - known,
         .on_line = on_line,
         .charge = charge.charge,
         .threshold = at.threshold,
         .noise = errors.chip.noise,
         .uneven = uneven,
         .log_charge = errors.log_numbers[number] + std::log(direction.path / errors.chip.electrons_per_fC),
         .charge_spread = errors.charges_apart[number] / std::sqrt(2.0)});
    const double moved = found.position - shift - value;
    value += moved;
    variance = found.variance + square(moved) * uneven;
    if (is_x && (ends.edge_below || ends.edge_above)) fired.lost = found;
  }

  // Charge of avalanches that lies beyond the edge of the sheet moves V with X.
  void shift_v(const MeasuringLayer& layer, const FoundPosition& lost, ClusterRow& cluster) const {
    if (!model_.timed || lost.variance == 0) return;
    cluster.v -= layer.cos_stereo * lost.beside;
    cluster.err_v = std::hypot(cluster.err_v, layer.cos_stereo * std::sqrt(lost.beside_variance));
  }

  // Sets position, error and time. `restores`: whether lost charge counts, which takes time; pairs are found
  // without.
  void measure(const MeasuringLayer& layer, Fired& fired, Known known, ClusterRow& cluster, bool restores) {
    const ViewReconstruction plane = plane_of(layer, cluster);
    const int view = static_cast<int>(cluster.view);
    const auto number = static_cast<std::size_t>(cluster.layer);
    Direction direction{plane.slope_at_anode(known.slope), known.path};
    const ChargeMoments charge =
        known.slope == 0 ? fired.charge : charge_at(plane, fired.strips, direction.slope);
    cluster.time = plane.time(fired.strips, charge);
    double value = 0, variance = 0;
    bool on_line = true;
    Line line{0, 0, false};
    if (model_.estimator == Estimator::micro_tpc && !known.of_track) {
      plane.points(fired.strips, direction.slope, points_);
      line = plane.line(points_);
    }
    if (line.good) {
      value = line.at_middle;
      variance = model_.errors.of_free_line(view, number, charge, direction);
    } else if (model_.estimator == Estimator::merged || known.of_track) {
      double slope_variance = 0;
      if (!known.of_track) {
        // The strips' own slope and the one from the beam line, of which the track may not come.
        const PlaneErrors& at = model_.errors.plane(view, number);
        const OwnSlope own = model_.errors.own_slope(at, charge, model_.errors.span(at, direction.slope));
        const double apart = own.value - direction.slope, spread = model_.errors.chip.slope;
        const double unlikely = own.weight > 0 ? std::max(apart * apart - disagreement / own.weight, 0.0) : 0;
        slope_variance = 1 / (own.weight + 1 / (spread * spread + unlikely));
        const double more = slope_variance * own.weight * apart;
        known.slope += more;
        direction.slope += more;
      }
      value = charge.position - plane.lorentz(charge.height) - known.slope * charge.height;
      variance = model_.errors.of_charge_line(view, number, charge, direction, slope_variance);
    } else {
      value = charge.position - plane.lorentz(0);
      variance = model_.errors.of_centroid(view, number, charge, direction);
      on_line = false;
    }
    if (restores && fired.ends.lose()) {
      restore(number, fired, charge, direction, on_line, plane.lorentz(0), cluster.view, value, variance);
    }
    if (cluster.view == ClusterView::x) {
      cluster.x = value;
      cluster.err_x = std::sqrt(variance);
      set_azimuth(layer, cluster);
    } else {
      cluster.v = value;
      cluster.err_v = std::sqrt(variance);
    }
  }

  std::vector<Fired> sheet_;        // of the clusters of the sheet
  std::vector<StripPoint> points_;  // of one cluster
  std::vector<double> middles_;     // mm, of its strips
  const DigiView& digis_;
  const ChargeTimeModel& model_;
};

}  // namespace

Columns<ClusterRow> find_charge_time_clusters(const Detector& detector, const DigiView& digis,
                                              const ChargeTimeModel& model) {
  return clusters_of_runs(detector, digis, {model.missing, model.mask}, ChargeTimeClusters(digis, model));
}

}  // namespace cgemit
