// The observer of a trace that asks for the expected hits.
#pragma once

#include "covariance/expected_hits.hpp"

namespace cgemit {

template <class T>
class Expectation : public NoObserver {
 public:
  static constexpr bool provides_hits = true, stops_at_wires = false;

  Expectation() = default;  // asks nobody yet
  explicit Expectation(ExpectedHits<T>& hits) : hits_(&hits) {}

  template <class Motion>
  void reaches(GroupStep& step, const Slab& slab, const Motion& motion, const mask_of<T>& reached) {
    step_ = &step;
    hits_->reaches(step, slab, motion.point(), reached);
  }
  template <class Motion>
  void passes(GroupStep& step, const Motion& motion, const mask_of<T>& alive) {
    hits_->passes(step, motion.point(), alive);
  }
  template <class Motion>
  void passes(GroupStep& step, const RecordedStep& recorded, const Motion& motion, const T& azimuth) {
    hits_->passes(step, recorded, motion.point(), azimuth);
  }
  template <class Motion>
  void meets(Slot<T>& slot, const Motion&) {
    hits_->measure(slot, slot.met);
  }
  mask_of<T> on_wire(const Slot<T>& slot, const T& z) const { return hits_->on_wire(slot, z); }
  template <class Motion>
  void arrives(const Slab& slab, const Motion&) {
    hits_->scatters(*step_, slab);
  }

 private:
  ExpectedHits<T>* hits_ = nullptr;
  const GroupStep* step_ = nullptr;  // of the slab reached last
};

}  // namespace cgemit
