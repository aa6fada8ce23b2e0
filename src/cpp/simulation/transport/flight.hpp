// Transport of charged particles: from the vertex outward through matter, drift gaps and drift cells.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "common/compiler.hpp"
#include "motion/cells.hpp"
#include "motion/reach.hpp"
#include "simulation/transport/records.hpp"
#include "simulation/transport/slab_draws.hpp"
#include "simulation/transport/start.hpp"

namespace cgemit {

// One particle, or W of them side by side, one per SIMD lane. Masks ensure that a lane gets the same result
// as its particle alone. `Motion`: motion in the field. Electrons and positrons are simulated one by one. The
// hot functions are flattened, so that numbers stay in registers.
template <class T, class Motion>
class Flight {
 public:
  static constexpr int width = lanes_of<T>;
  using Mask = mask_of<T>;
  using Point = typename Motion::Point;
  using Rows = std::array<std::size_t, static_cast<std::size_t>(width)>;

  // `rows`: the particles; lanes outside `used` are empty.
  Flight(const Detector& detector, const SimulateSettings& settings, const ParticleColumns& in,
         std::uint64_t seed, const Rows& rows, const Mask& used, std::vector<GapRecord<T>>& gaps,
         std::vector<CellRecord<T>>& cells)
      : detector_(detector),
        settings_(settings),
        start_{in, rows, seed},
        motion_(detector),
        stream_(start_.streams(0)),
        charge_(start_.column([&](std::size_t row) { return double(in.charge[row]); })),
        now_(start_.kinematics()),
        decay_time_(start_.decay_time(settings.decays, now_.gamma)),
        cell_finder_(detector, motion_),
        flying_(used),
        gaps_(gaps),
        cells_(cells) {
    const auto of = [this](std::span<const double> values) {
      return start_.column([values](std::size_t row) { return values[row]; });
    };
    const T pt = start_.column([&](std::size_t row) { return std::hypot(in.px[row], in.py[row]); });
    helix() = {of(in.x), of(in.y), of(in.z), of(in.px) / pt, of(in.py) / pt, of(in.pz) / pt, T(0.0)};
    motion_.look(point_);
    if (settings.fluctuations != Fluctuations::full) track_ = track_matter(detector, point_.tanl, now_);
    motion_.bend(point_, charge_ / pt, used);
    follow_dip(Mask(true));
    const T radius = point_.radius();
    ahead_ = gathered<T>([&](int i) { return first_ahead(lane(radius, i)); });
  }

  void run() {
    fly_in();
    fly_out();
  }

  TransportStatus status(int i) const {
    if (lane(decayed_, i)) return TransportStatus::decayed;
    if (lane(stopped_, i)) return TransportStatus::stopped;
    if (lane(ended_, i)) return TransportStatus::end;
    if (lane(left_, i)) return TransportStatus::left_field;
    return lane(curled_, i) ? TransportStatus::curled : TransportStatus::outside;
  }

  // The particle at its decay: one that has decayed, alone.
  DecayPoint decay_point() {
    static_assert(width == 1);
    Point at = point_;
    motion_.along(at, (decay_time_ - time_) * speed_of_light / (sec_lambda_ * now_.per_beta));
    const double transverse = now_.p / std::sqrt(1 + at.tanl * at.tanl);
    return {.position = {at.x, at.y, at.z},
            .time = decay_time_,
            .momentum = {transverse * at.ux, transverse * at.uy, transverse * at.tanl},
            .mass = now_.mass};
  }

 protected:
  // Outward, until the particles leave or turn back.
  void fly_out() {
    for (std::size_t i = 0; i < detector_.surfaces.size() && any(flying_); ++i) {
      const Surface& surface = detector_.surfaces[i];
      const Mask passes = flying_ & (ahead_ <= static_cast<double>(i));
      if (!any(passes)) continue;
      const auto index = static_cast<std::size_t>(surface.index);
      if (!surface.is_slab) {
        if constexpr (!Motion::keeps_dip) motion_.look_ahead(point_, next_stop(i), passes & !curled_);
        pass_cells(index, passes);
      } else if (const Mask meets = passes & !curled_; any(meets)) {
        const Slab& slab = detector_.slabs[index];
        slab.gap >= 0 ? cross_gap(slab, meets) : cross(slab, reach(slab.radius, meets));
      }
    }
    if constexpr (!Motion::keeps_dip) motion_.forget_ahead();
    decay_before_apex();
  }

  HelixPointOf<T>& helix() { return point_; }

  // Radius of the next slab or, beyond the last one, of the last wires.
  double next_stop(std::size_t i) const {
    while (!detector_.surfaces[i].is_slab && i + 1 < detector_.surfaces.size()) ++i;
    return detector_.surfaces[i].radius;
  }

  // Index of the first surface beyond a radius.
  double first_ahead(double radius) const {
    const auto& surfaces = detector_.surfaces;
    return static_cast<double>(std::ranges::upper_bound(surfaces, radius, {}, &Surface::radius) -
                               surfaces.begin());
  }

  // Particles that start inward first cross the matter there. A slab crossed on the inward and again on the
  // outward path acts twice, with new random numbers.
  void fly_in() {
    Mask inward = flying_ & (ahead_ > 0.0) & (point_.outward() < 0.0);
    if (!any(inward)) return;
    stream_ = start_.streams(inward_leg);
    for (std::size_t i = detector_.surfaces.size(); i-- > 0 && any(inward);) {
      const Mask next = inward & (ahead_ == static_cast<double>(i + 1));
      if (!any(next)) continue;
      const Surface& surface = detector_.surfaces[i];
      const Mask arrived = motion_.to_cylinder(point_, surface.radius, arc_, false, next);
      stop_at_edge(next & motion_.left());
      arrive(arrived);
      ahead_ = select(arrived, T(static_cast<double>(i)), ahead_);
      if (surface.is_slab) cross(detector_.slabs[static_cast<std::size_t>(surface.index)], arrived & flying_);
      inward = inward & flying_ & (arrived | !next) & (point_.outward() < 0.0);
    }
    stream_ = start_.streams(0);
  }

  // Returns the lanes that reach the radius.
  Mask reach(double radius, const Mask& who) {
    const Mask arrived = motion_.to_slab(point_, radius, arc_, who);
    const Mask left = who & motion_.left();
    stop_at_edge(left);
    curled_ = curled_ | (who & !arrived & !left);
    arrive(arrived);
    return arrived & flying_;
  }

  // The lanes are beyond their decay. The flight is then repeated by `Batch`, one particle at a time.
  void decay(const Mask& who) {
    decayed_ = decayed_ | who;
    flying_ = flying_ & !who;
  }

  // Particles that turn back are followed to their outermost point.
  void decay_before_apex() {
    const Mask turned = curled_ & !decayed_ & !stopped_ & !ended_ & !left_ & (decay_time_ < HUGE_VAL);
    if (!any(turned)) return;
    Point apex = point_;
    T arc(0.0);
    motion_.to_apex(apex, arc, turned);
    decay(turned & (time_ + flight_time(arc) >= decay_time_));
  }

  void stop_at_edge(const Mask& left) {
    left_ = left_ | left;
    flying_ = flying_ & !left;
  }

  T flight_time(const T& arc) const { return arc * sec_lambda_ * now_.per_beta * (1 / speed_of_light); }

  void arrive(const Mask& arrived) {
    time_ += select(arrived, flight_time(arc_), T(0.0));
    flown_ += select(arrived, arc_, T(0.0));
    decay(arrived & (time_ >= decay_time_));
    if constexpr (!Motion::keeps_dip) follow_dip(arrived);
  }

  void follow_dip(const Mask& who) {
    sec_lambda_ = select(who, sqrt(1.0 + point_.tanl * point_.tanl), sec_lambda_);
  }

  // Scattering and energy loss at the slab's centroid, where the points are.
  CGEMIT_FLATTEN void cross(const Slab& slab, const Mask& arrived) {
    Mask within = arrived & slab.ends.hold(point_.z);
    within_ = within;
    deposit_ = T(0.0);  // stays 0 beyond the ends
    if (const Mask missed = arrived & !within; any(missed)) miss(slab, missed);
    if (slab.filler == Filler::chamber_gas) within = within & reach_.chamber;
    if (!any(within)) return;
    const T whole =
        path_factor(slab, sec_lambda_, abs(point_.outward())) * foil_fraction(slab, point_, stream_, within);
    within = within & (whole != 0.0);
    if (!any(within)) return;
    // The other lanes get a path with nearly no collisions, however slow they are, so that no lane needs a
    // branch.
    const T idle = 1e-6 * now_.beta2, path = select(within, whole, idle);
    const LossDraw<T> drawn = lose(slab, path);
    deposit_ = select(within, drawn.deposit, T(0.0));
    const Mask stops = within & (now_.kinetic() - drawn.loss < stopped_below(now_.mass));
    stopped_ = stopped_ | stops;
    flying_ = flying_ & !stops;
    const Mask acts = within & !stops;
    if (!any(acts)) return;
    const KinematicsOf<T> after = now_.after_loss(select(acts, drawn.loss, T(0.0)));
    HelixPointOf<T> there = point_;
    scatter(slab, select(acts, path, idle), after, there);
    // The rest of the proper time stays the same.
    decay_time_ = select(acts, time_ + (decay_time_ - time_) * (after.gamma / now_.gamma), decay_time_);
    now_ = select(acts, after, now_);
    helix() = select(acts, there, helix());
    follow_dip(acts);
    motion_.bend(point_, charge_ * sec_lambda_ * now_.per_p, acts);
  }

  // Ends the flight of lanes that are beyond an end of a slab and have no part ahead.
  CGEMIT_NOINLINE void miss(const Slab& slab, const Mask& who) {
    const bool back = settings_.half_turns > 1 || any(who & (point_.outward() < 0.0));
    reach_.miss(detector_, slab, point_, who, back);
    ended_ = ended_ | (who & !reach_.parts);
    flying_ = flying_ & !ended_;
  }

  LossDraw<T> lose(const Slab& slab, const T& path) const {
    if (settings_.fluctuations == Fluctuations::full) return draw_loss(slab, path, now_, stream_, slab.place);
    return draw_core_loss(core_loss(slab, path, now_, track_),
                          settings_.fluctuations == Fluctuations::gaussian, stream_, slab.place);
  }

  void scatter(const Slab& slab, const T& path, const KinematicsOf<T>& after, HelixPointOf<T>& there) const {
    if (settings_.fluctuations == Fluctuations::full) {
      apply_kick(there, sample_scattering(slab, path, now_, after, stream_, slab.place));
    } else if (settings_.fluctuations == Fluctuations::gaussian) {
      const T sigma = sqrt(scattering_variance(slab, path, now_, after, track_));
      apply_kick(there, draw_core_kick(slab, path, sigma, stream_, slab.place));
    }
  }

  // A drift gap or a sensor: entry, middle and exit lie on one track; then the matter acts at the middle. The
  // crossing counts whatever it deposits: the efficiency of the layer and its readout decide about the hit.
  void cross_gap(const Slab& slab, const Mask& who) {
    const MeasuringLayer& layer = detector_.layers[static_cast<std::size_t>(slab.gap)];
    Point entry = point_;
    T arc(0.0), rest(0.0);
    const Mask met = motion_.to_cylinder(entry, layer.r_gap_in, arc, true, who);
    // The entry is not before the start. It lies behind where another part ends at about the same radius.
    const Mask enters = met & (flown_ + arc >= 0.0);
    const Mask arrived = reach(slab.radius, who);
    if (!any(arrived)) return;
    Point exit = point_;
    const Mask leaves = motion_.to_cylinder(exit, layer.r_gap_out, rest, true, arrived);
    const T path = (arc_ - arc + rest) * sec_lambda_;
    gaps_.push_back({&slab, Mask(false), entry, point_, exit, now_, path, time_, T(0.0), motion_.bz(entry)});
    cross(slab, arrived);
    gaps_.back().deposit = deposit_;
    gaps_.back().filled = arrived & enters & leaves & within_;
  }

  // A track that turns back below a slab may still pass the next wires, until it turns back below those.
  // Returns the lanes that reach the layer.
  CGEMIT_FLATTEN Mask pass_cells(std::size_t index, const Mask& who) {
    CellRange<T, Point> range;
    const Mask inside = who & reach_.chamber, found = cell_finder_.find(index, point_, inside, range);
    stop_at_edge(cell_finder_.left());
    flying_ = flying_ & !(inside & !found & curled_);
    for (Mask left = found; any(left); left = left & (range.first <= range.last)) {
      record_cell(detector_.wires[index], left, range);
      range.first += T(1.0);
    }
    return found;
  }

  void record_cell(const WireLayer& layer, const Mask& who, const CellRange<T, Point>& range) {
    const CellNumbers<T> cell = cell_numbers(layer, select(who, range.first, T(0.0)));
    Point closest = range.at_wires;
    ApproachOf<T> approach;
    const Mask settled = motion_.approach_near(closest, cell_wires<T>(layer, cell), approach, who);
    const T time = time_ + flight_time(approach.arc + range.arc);
    // Cells fire neither behind the vertex, nor beyond the ends of the wires, nor after the decay.
    const Mask meets = settled & (time >= 0.0) & layer.ends.hold(approach.z_wire);
    const Mask late = meets & (time >= decay_time_), fired = meets & !late;
    decay(late);
    if (!any(fired)) return;
    cells_.push_back({&layer, fired, cell, approach.doca, closest.x, closest.y, closest.z, time});
  }

  const Detector& detector_;
  const SimulateSettings& settings_;
  StartOf<T> start_;
  Motion motion_;
  StreamOf<T> stream_;
  T charge_, time_{0.0}, arc_{0.0}, deposit_{0.0};
  T flown_{0.0};  // mm, sum of the arcs
  Point point_;
  T sec_lambda_{1.0};  // path per transverse arc; below 0 back in time
  T ahead_;            // index of the first surface ahead
  KinematicsOf<T> now_;
  T decay_time_;  // ns, of the decay if the particle loses no more energy
  TrackMatterOf<T> track_;
  CellFinder<T, Motion> cell_finder_;
  Mask flying_, stopped_{false}, ended_{false}, left_{false}, decayed_{false};
  Reach<T> reach_;
  Mask within_{false};  // lanes between the ends of the slab that was crossed last
  Mask curled_{false};  // past the outermost point: no cylinder lies ahead
  std::vector<GapRecord<T>>& gaps_;
  std::vector<CellRecord<T>>& cells_;
};

}  // namespace cgemit
