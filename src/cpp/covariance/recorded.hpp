// The reference trajectory of one track, recorded for others that differ by a turn about the beam line: in a
// uniform field they lose energy and scatter alike in all slabs, which are cylinders around the beam line.
// Only the hits differ.
#pragma once

#include <vector>

#include "kalman/tracer.hpp"
#include "motion/cells.hpp"
#include "motion/reach.hpp"
#include "motion/uniform.hpp"

namespace cgemit {

// A step of the trajectory.
struct RecordedStep {
  bool has_hits;  // the steps without are not recorded
  HelixMotion<double> motion;
  std::size_t layer;       // of wires
  CellSpan<double> cells;  // of wires
};

class RecordedTrack {
 public:
  // `group`: has the steps of the detector.
  RecordedTrack(const Detector& detector, const Group<double>& group, const Perigee& start,
                const Species& species)
      : detector_(&detector), group_(group), straight_on_(true) {
    const HelixMotion<double> begin(detector, start);
    steps_.assign(group_.steps.size(), {false, begin, 0, {}});
    group_.ahead.assign(group_.noise.size(), true);
    group_.kinked = false;
    Tracer<double, HelixMotion<double>, Recorder>(detector, start, species, group_, Recorder(*this))
        .run(true);
  }

  // Whether the track crosses every layer outward, up to where it leaves the detector or stops.
  bool straight_on() const { return straight_on_; }
  const std::vector<RecordedStep>& steps() const { return steps_; }

  // Fills in what all tracks have in common.
  template <class T>
  void give(Group<T>& group) const {
    group.ahead.assign(group.noise.size(), mask_of<T>(true));
    group.kinked = mask_of<T>(false);
    group.stopped = mask_of<T>(group_.stopped);
    group.left = mask_of<T>(false);
    for (std::size_t i = 0; i < group.noise.size(); ++i) {
      const SlabNoise<double>& from = group_.noise[i];
      SlabNoise<T>& to = group.noise[i];
      for (int k = 0; k < parameters; ++k) to.dip[k] = from.dip[k];
      copy(from.straggling, to.straggling);
      copy(from.turn, to.turn);
      copy(from.shift_across, to.shift_across);
      copy(from.shift_along, to.shift_along);
    }
  }

 private:
  template <class T, std::size_t n>
  static void copy(const std::array<double, n>& from, std::array<T, n>& to) {
    for (std::size_t i = 0; i < n; ++i) to[i] = from[i];
  }

  // The observer of the trace: hits are expected where it would look for them, but none is filled in.
  class Recorder : public NoObserver {
   public:
    static constexpr bool provides_hits = true, stops_at_wires = true;

    explicit Recorder(RecordedTrack& track)
        : track_(&track), ahead_(*track.detector_), cells_(*track.detector_, ahead_) {}
    Recorder(const Recorder& other) : Recorder(*other.track_) {}  // `cells_` refers to `ahead_`
    Recorder& operator=(const Recorder&) = delete;

    void passes(GroupStep& step, HelixMotion<double>& motion, bool alive) {
      step.first = step.last = 0;
      const std::size_t index = layer_++;
      if (!alive || !reach_.chamber) return;
      const HelixPoint from = motion.point();
      const double radius = wire_radius(track_->detector_->wires[index], from.z);
      if (!(from.outward() > 0) || !motion.go_to(radius, true)) {
        track_->straight_on_ = false;
        return;
      }
      record(step) = {true, motion, index, cells_.span(index, motion.point(), radius, true)};
    }
    void reaches(GroupStep& step, const Slab& slab, const HelixMotion<double>& motion, bool reached) {
      step.first = step.last = 0;
      if (reached && slab.ends.miss(motion.point().z))
        reach_.miss(*track_->detector_, slab, motion.point(), true, false);
      if (slab.gap >= 0 && reached && reach_.parts) record(step) = {true, motion, 0, {}};
    }
    bool on_wire(const Slot<double>&, double) const { return false; }

   private:
    RecordedStep& record(const GroupStep& step) {
      return track_->steps_[static_cast<std::size_t>(&step - track_->group_.steps.data())];
    }

    RecordedTrack* track_;
    UniformMotionOf<double> ahead_;
    CellFinder<double, UniformMotionOf<double>> cells_;
    std::size_t layer_ = 0;
    Reach<double> reach_;
  };

  const Detector* detector_;
  Group<double> group_;
  std::vector<RecordedStep> steps_;
  bool straight_on_;
};

}  // namespace cgemit
