// W charged particles side by side through the detector, one per SIMD lane: the same steps and the same draws
// as `Flight` in `simulate.cpp`, which is the reference. Heavy particles that start on their way out, uniform
// field, foils without holes.
#pragma once

#include <array>
#include <vector>

#include "matter/loss.hpp"
#include "matter/scattering.hpp"
#include "motion/uniform.hpp"
#include "simulate/cells.hpp"
#include "simulate/lane_rows.hpp"

namespace cgemit {

// The hot functions are flattened: numbers should stay in registers.
template <class T>
class LaneFlight {
 public:
  static constexpr int width = lanes_of<T>;
  using Mask = mask_of<T>;
  using Rows = std::array<std::size_t, static_cast<std::size_t>(width)>;

  // `rows`: the particles; lanes outside of `used` stay empty.
  LaneFlight(const Detector& detector, const SimulateSettings& settings, const ParticleColumns& in,
             const Rows& rows, const Mask& used, std::uint64_t seed, std::vector<GapLanes<T>>& gaps,
             std::vector<CellLanes<T>>& cells)
      : detector_(detector),
        settings_(settings),
        stream_(streams(in, rows, seed)),
        charge_(gathered<T>([&](int i) { return double(in.charge[rows[std::size_t(i)]]); })),
        now_(start(in, rows)),
        flying_(used),
        gaps_(gaps),
        cells_(cells) {
    const auto column = [&rows](const auto& values) {
      return gathered<T>([&](int i) { return values[rows[std::size_t(i)]]; });
    };
    const T px = column(in.px), py = column(in.py), pz = column(in.pz),
            per_pt = 1.0 / sqrt(px * px + py * py);
    point_ = {column(in.x),
              column(in.y),
              column(in.z),
              px * per_pt,
              py * per_pt,
              pz * per_pt,
              curvature(detector.bz, charge_ * per_pt)};
    stretch_ = sqrt(1.0 + point_.tanl * point_.tanl);
    if (settings.fluctuations != Fluctuations::full) track_ = total_matter(detector, point_.tanl);
  }

  void run() {
    const T start = point_.radius();
    for (const Place& place : detector_.places) {
      const Mask passes = flying_ & (start < place.radius);
      if (!any(passes)) continue;
      const auto index = static_cast<std::size_t>(place.index);
      if (!place.is_slab) {
        const Mask passed = pass_cells(index, passes);
        flying_ = flying_ & !(passes & !passed & curled_);
      } else if (const Mask ahead = passes & !curled_; any(ahead)) {
        const Slab& slab = detector_.slabs[index];
        if (slab.gap >= 0) {
          cross_gap(slab, ahead);
        } else {
          cross(slab, reach(slab.radius, ahead));
        }
      }
    }
  }

  TransportStatus status(int i) const {
    if (lane(stopped_, i)) return TransportStatus::stopped;
    if (lane(ended_, i)) return TransportStatus::end;
    return lane(curled_, i) ? TransportStatus::curled : TransportStatus::outside;
  }
  Stream stream(int i) const { return lane(stream_, i); }

 private:
  static StreamOf<T> streams(const ParticleColumns& in, const Rows& rows, std::uint64_t seed) {
    const auto one = [&](std::size_t row) {
      return Stream(seed, static_cast<std::uint64_t>(in.event[row]),
                    static_cast<std::uint32_t>(in.particle[row]));
    };
    return [&]<std::size_t... i>(std::index_sequence<i...>) {
      return StreamOf<T>({one(rows[i])...});
    }(std::make_index_sequence<std::size_t{width}>());
  }

  static KinematicsOf<T> start(const ParticleColumns& in, const Rows& rows) {
    const auto momentum = [&](int i) {
      const std::size_t row = rows[std::size_t(i)];
      return std::sqrt(in.px[row] * in.px[row] + in.py[row] * in.py[row] + in.pz[row] * in.pz[row]);
    };
    KinematicsOf<T> k(gathered<T>(momentum),
                      gathered<T>([&](int i) { return in.mass[rows[std::size_t(i)]]; }),
                      Projectile::spinless);
    for (int i = 0; i < width; ++i) {
      const std::size_t row = rows[std::size_t(i)];
      const bool spin = projectile_of(in.mass[row], in.charge[row]) == Projectile::spin_half;
      set_lane(k.has_spin, i, spin ? 1 : 0);
    }
    return k;
  }

  // Those that get there.
  Mask reach(double radius, const Mask& ahead) {
    const Mask arrived = step_to_cylinder(point_, radius, arc_, true, ahead);
    curled_ = curled_ | (ahead & !arrived);
    time_ += select(arrived, flight_time(arc_), T(0.0));
    return arrived;
  }

  T flight_time(const T& arc) const { return arc * stretch_ * now_.per_beta * (1 / speed_of_light); }

  // Scatters and slows down at the slab's centroid, where the points are.
  [[gnu::flatten]] void cross(const Slab& slab, const Mask& arrived) {
    const Mask within = arrived & (abs(point_.z) <= slab.half_length);
    deposit_ = T(0.0);  // stays 0 beyond the ends
    if (slab.ends) {
      ended_ = ended_ | (arrived & !within);
      flying_ = flying_ & !ended_;
    }
    if (!any(within)) return;
    // The others see next to nothing, which costs nothing.
    const T path = select(within, path_factor(slab, stretch_, abs(point_.outward())), T(1e-6));
    const T loss = lose(slab, path);
    const Mask stops = within & (now_.kinetic() - loss < least_kinetic);
    stopped_ = stopped_ | stops;
    flying_ = flying_ & !stops;
    const Mask acts = within & !stops;
    deposit_ = select(within, deposit_, T(0.0));
    const KinematicsOf<T> after = now_.after_loss(select(acts, loss, T(0.0)));
    HelixPointOf<T> there = point_;
    if (settings_.fluctuations == Fluctuations::full) {
      apply_kick(there, sample_scattering(slab, path, now_, after, stream_, slab.place));
    } else if (settings_.fluctuations == Fluctuations::gaussian) {
      scatter(slab, path, after, there);
    }
    now_ = select(acts, after, now_);
    const T stretch = sqrt(1.0 + there.tanl * there.tanl);
    there.w = curvature(detector_.bz, charge_ * stretch * now_.per_p);
    point_ = select<T>(acts, there, point_);
    stretch_ = select(acts, stretch, stretch_);
  }

  T lose(const Slab& slab, const T& path) {
    if (settings_.fluctuations == Fluctuations::full) {
      return deposit_ = sample_loss(slab, path, now_, stream_, slab.place);
    }
    const LossMomentsOf<T> core = core_loss(slab, path, now_, track_);
    deposit_ = core.loss;
    if (settings_.fluctuations == Fluctuations::off) return core.loss;
    DrawsOf<T> draws(stream_, Purpose::energy_loss, slab.place);
    return core.loss + sqrt(core.variance) * normal_quantile(draws.next());
  }

  // As the fit assumes.
  void scatter(const Slab& slab, const T& path, const KinematicsOf<T>& after, HelixPointOf<T>& there) const {
    const T sigma = sqrt(scattering_variance(slab, path, now_, after, track_));
    DrawsOf<T> draws(stream_, Purpose::scattering, slab.place);
    KickOf<T> kick;
    kick.angle_1 = sigma * normal_quantile(draws.next());
    kick.angle_2 = sigma * normal_quantile(draws.next());
    if (slab.shifts) {
      kick.shift_1 = sigma * slab.spread * path * normal_quantile(draws.next());
      kick.shift_2 = sigma * slab.spread * path * normal_quantile(draws.next());
    }
    apply_kick(there, kick);
  }

  // A drift gap: entry, middle and exit of one helix, then the gas acts in the middle.
  void cross_gap(const Slab& slab, const Mask& ahead) {
    const CgemLayer& layer = detector_.cgem[static_cast<std::size_t>(slab.gap)];
    HelixPointOf<T> entry = point_;
    T arc(0.0), rest(0.0);
    const Mask met = step_to_cylinder(entry, layer.r_gap_in, arc);
    const Mask enters = met & (arc >= 0.0);
    const Mask arrived = reach(slab.radius, ahead);
    HelixPointOf<T> exit = point_;
    const Mask leaves = step_to_cylinder(exit, layer.r_gap_out, rest);
    const T path = (arc_ - arc + rest) * stretch_;
    gaps_.push_back({&slab, Mask(false), entry, point_, exit, now_, path, time_, T(0.0)});
    cross(slab, arrived);
    gaps_.back().deposit = deposit_;
    gaps_.back().filled = arrived & enters & leaves & (deposit_ > 0.0);
  }

  // Those that do not turn back below the layer's cells.
  [[gnu::flatten]] Mask pass_cells(std::size_t index, const Mask& asked) {
    const WireLayer& layer = detector_.wires[index];
    HelixPointOf<T> middle = point_;
    T arc(0.0), first(0.0), last(0.0);
    const Mask reached = step_to_cylinder(middle, wire_radius(layer, point_.z), arc, true, asked);
    const CellBorders<T> borders(detector_.wires, index, middle.z);
    Mask found = reached & at_once_.find(layer, borders, middle, asked, first, last);
    const Mask slowly = asked & !found;
    for (int i = 0; any(slowly) && i < width; ++i) {
      if (lane(slowly, i)) set_lane(found, i, find_slowly(index, i, middle, arc, first, last));
    }
    for (Mask left = found; any(left); left = left & (first <= last)) {
      record_cell(layer, left, first, middle, arc);
      first += T(1.0);
    }
    return found;
  }

  bool find_slowly(std::size_t index, int i, HelixPointOf<T>& middle, T& arc, T& first, T& last) const {
    CellRange range{};
    UniformMotion motion(detector_);
    if (!CellFinder(detector_, motion).find(index, lane(point_, i), range)) return false;
    set_lane(first, i, range.first);
    set_lane(last, i, range.last);
    set_lane(arc, i, range.arc);
    set_lane(middle.x, i, range.at_wires.x);
    set_lane(middle.y, i, range.at_wires.y);
    set_lane(middle.z, i, range.at_wires.z);
    set_lane(middle.ux, i, range.at_wires.ux);
    set_lane(middle.uy, i, range.at_wires.uy);
    return true;
  }

  void record_cell(const WireLayer& layer, const Mask& asked, const T& number, const HelixPointOf<T>& middle,
                   const T& arc) {
    const T cells(layer.cells), there = select(asked, number, T(0.0));
    T cell = there - cells * nearest(there / cells);
    cell = select(cell < 0.0, cell + cells, cell);
    const auto wire = std::bit_cast<std::array<std::int64_t, static_cast<std::size_t>(width)>>(whole(cell));
    const auto placed = [&](double Wire::* value) {
      return gathered<T>([&](int i) { return layer.placed[std::size_t(wire[std::size_t(i)])].*value; });
    };
    const WireOf<T> wires{placed(&Wire::x), placed(&Wire::y), placed(&Wire::ex), placed(&Wire::ey),
                          placed(&Wire::ez)};
    HelixPointOf<T> closest = middle;
    ApproachOf<T> approach;
    const Mask settled = approach_wire(closest, wires, approach, asked);
    const T time = time_ + flight_time(approach.arc + arc);
    // Neither behind the vertex nor beyond the ends of the wires.
    const Mask fired = settled & (time >= 0.0) & (abs(approach.z_wire) <= layer.half_length);
    if (!any(fired)) return;
    cells_.push_back({&layer, fired, wire, approach.doca, closest.x, closest.y, closest.z, time});
  }

  const Detector& detector_;
  const SimulateSettings& settings_;
  StreamOf<T> stream_;
  T charge_, time_{0.0}, arc_{0.0}, deposit_{0.0};
  HelixPointOf<T> point_;
  T stretch_;  // path per transverse arc
  KinematicsOf<T> now_;
  TrackMatterOf<T> track_;
  CellsAtOnce<T> at_once_;
  Mask flying_, curled_{false}, stopped_{false}, ended_{false};
  std::vector<GapLanes<T>>& gaps_;
  std::vector<CellLanes<T>>& cells_;
};

}  // namespace cgemit
