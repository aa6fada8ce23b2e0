// Half turns of particles that turn back in the field: inward through the same matter, gaps and cells, past
// the closest approach to the beam line, and out again.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "simulation/transport/flight.hpp"

namespace cgemit {

// One particle alone. A half turn leads from the perigee to the apex, or back; number 0 is the first outward
// one, odd ones lead inward, and -1 is the inward path of a particle that starts inward. Matter acts in each
// with random numbers of its own, so that half turn 0 does not depend on how many follow.
template <class Motion>
class LoopingFlight : public Flight<double, Motion> {
  using Base = Flight<double, Motion>;
  using Point = typename Motion::Point;

 public:
  LoopingFlight(const Detector& detector, const SimulateSettings& settings, const ParticleColumns& in,
                std::uint64_t seed, const typename Base::Rows& rows, std::vector<GapRecord<double>>& gaps,
                std::vector<CellRecord<double>>& cells)
      : Base(detector, settings, in, seed, rows, true, gaps, cells),
        old_cells_(cells.size()),
        new_cells_(cells.size()),
        new_gaps_(gaps.size()) {}

  void run() {
    if (settings_.half_turns > 1 && ahead_ > 0 && point_.outward() < 0) {
      come_in(-1);
    } else {
      this->fly_in();
    }
    if (flying_) go_out(0);
    for (int turn = 1; turn < settings_.half_turns && curled_ && !has_ended(); ++turn)
      turn % 2 == 0 ? go_out(turn) : come_in(turn);
  }

 private:
  static constexpr int most_steps = 20;         // of the search for the perigee, in a field map
  static constexpr double exact = 1e-9;         // mm
  static constexpr double one_approach = 1e-3;  // ns, crossings of a cell in less time are one crossing

  using Base::ahead_, Base::arc_, Base::cells_, Base::curled_, Base::decayed_, Base::deposit_;
  using Base::detector_, Base::ended_, Base::flying_, Base::gaps_, Base::left_, Base::motion_, Base::now_;
  using Base::point_, Base::sec_lambda_, Base::settings_, Base::stopped_, Base::stream_, Base::time_,
      Base::within_;

  bool has_ended() const { return decayed_ || stopped_ || ended_ || left_; }

  void begin(int turn) {
    const auto& start = this->start_;
    stream_ = stream_of_half_turn(start.in, start.rows[0], start.seed, turn);
    flying_ = true;
    curled_ = false;
    begun_ = time_;
  }

  void go_out(int turn) {
    begin(turn);
    this->fly_out();
    mark(turn);
  }

  // To the perigee.
  void come_in(int turn) {
    begin(turn);
    const double since = time_;
    std::size_t top = detector_.surfaces.size();  // cells below are still to be found
    if (turn > 0) {
      motion_.to_apex(point_, arc_, true);
      arrive_or_leave(true);
    } else {
      top = static_cast<std::size_t>(ahead_);
    }
    descend(since, top);
    if (flying_ && point_.outward() < 0) to_perigee(top);
    curled_ = true;
    mark(turn);
  }

  // Through the slabs below, as far as the particle moves inward. `top`: surface above which all is done.
  void descend(double since, std::size_t& top) {
    ahead_ = this->first_ahead(point_.radius());
    for (auto i = static_cast<std::size_t>(ahead_); i-- > 0 && flying_;) {
      const Surface& surface = detector_.surfaces[i];
      if (!surface.is_slab) continue;
      const Slab& slab = detector_.slabs[static_cast<std::size_t>(surface.index)];
      if (!arrive_or_leave(motion_.to_cylinder(point_, slab.radius, arc_, false, true))) return;
      fire_cells(i + 1, top);
      top = i;
      if (!flying_) return;
      slab.gap >= 0 ? cross_gap(slab, since) : this->cross(slab, true);
      ahead_ = static_cast<double>(i + 1);
      if (point_.outward() >= 0) return;  // scattered back
    }
  }

  bool arrive_or_leave(bool arrived) {
    this->stop_at_edge(motion_.left());
    this->arrive(arrived);
    return arrived;
  }

  void to_perigee(std::size_t top) {
    for (int step = 0; step < most_steps; ++step) {
      const PivotApproach perigee = approach_pivot(point_, 0, 0);
      if (!perigee.exists || std::abs(perigee.arc) < exact) break;
      arc_ = perigee.arc;
      motion_.along(point_, arc_);
      arrive_or_leave(true);
    }
    ahead_ = this->first_ahead(point_.radius());
    fire_cells(static_cast<std::size_t>(ahead_), top);
  }

  // From the outer to the inner edge of a drift gap, at whose middle the particle is.
  void cross_gap(const Slab& slab, double since) {
    const MeasuringLayer& layer = detector_.layers[static_cast<std::size_t>(slab.gap)];
    Point entry = point_, exit = point_;
    double before = 0, rest = 0;
    const bool enters = motion_.to_cylinder(entry, layer.r_gap_out, before, false, true);
    const bool leaves = motion_.to_cylinder(exit, layer.r_gap_in, rest, false, true);
    const bool whole = enters && leaves && time_ + this->flight_time(before) >= since;
    const double path = (rest - before) * sec_lambda_;
    gaps_.push_back({&slab, false, entry, point_, exit, now_, path, time_, 0.0, motion_.bz(exit)});
    this->cross(slab, true);
    gaps_.back().deposit = deposit_;
    gaps_.back().filled = whole && within_;
  }

  // The cells between two surfaces on the path that ends here. They are found by following the path back in
  // time, which is outward.
  void fire_cells(std::size_t first, std::size_t end) {
    const Point here = point_;
    const bool flies = flying_;
    motion_.reverse(point_);
    sec_lambda_ = -sec_lambda_;
    for (std::size_t i = first; i < end; ++i) {
      const Surface& surface = detector_.surfaces[i];
      curled_ = curled_ || surface.is_slab;  // beyond the apex: only cells that reach below it
      if (!surface.is_slab && !this->pass_cells(static_cast<std::size_t>(surface.index), true) && curled_)
        break;
    }
    motion_.reverse(point_);
    point_ = here;
    sec_lambda_ = -sec_lambda_;
    curled_ = false;
    flying_ = flies && !has_ended();
  }

  // Marks the records of a half turn. A cell at the apex or the perigee may have been found in the half turn
  // before.
  void mark(int turn) {
    if (turn != 0 && time_ < begun_ - one_approach) return abandon();
    const auto number = static_cast<std::int8_t>(turn);
    const auto first = cells_.begin() + static_cast<std::ptrdiff_t>(old_cells_);
    const auto begin = cells_.begin() + static_cast<std::ptrdiff_t>(new_cells_);
    const auto found = [&](const CellRecord<double>& cell) {
      return std::any_of(first, begin, [&](const CellRecord<double>& old) {
        return old.layer == cell.layer && old.wire == cell.wire &&
               std::abs(old.time - cell.time) < one_approach;
      });
    };
    cells_.erase(std::remove_if(begin, cells_.end(), found), cells_.end());
    for (std::size_t k = new_cells_; k < cells_.size(); ++k) {
      cells_[k].half_turn = number;
      if (turn % 2 != 0) cells_[k].doca = -cells_[k].doca;  // found against the direction of flight
    }
    for (std::size_t k = new_gaps_; k < gaps_.size(); ++k) gaps_[k].half_turn = number;
    old_cells_ = new_cells_;
    new_cells_ = cells_.size();
    new_gaps_ = gaps_.size();
  }

  // A map that does not bend the particle back, far outside of its magnet: the search for an apex or a
  // perigee has led back in time. The half turn leaves no records.
  void abandon() {
    cells_.erase(cells_.begin() + static_cast<std::ptrdiff_t>(new_cells_), cells_.end());
    gaps_.erase(gaps_.begin() + static_cast<std::ptrdiff_t>(new_gaps_), gaps_.end());
    this->stop_at_edge(true);
  }

  double begun_ = 0;                              // ns
  std::size_t old_cells_, new_cells_, new_gaps_;  // first records of the half turn before, and of this one
};

}  // namespace cgemit
