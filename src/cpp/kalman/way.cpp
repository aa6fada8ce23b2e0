#include "kalman/way.hpp"

#include <cmath>

#include "kalman/builder.hpp"

namespace cgemit {

namespace {

// Writes down what the tracer tells.
class Recorder {
 public:
  explicit Recorder(Way& way) : way_(&way) {}

  template <class Motion>
  void meets(const Slot<double>& slot, const Motion& motion) {
    mark(motion, slot.hit[0], nullptr);
    way_->predicted[static_cast<std::size_t>(slot.hit[0])] = slot.predicted;
    way_->elements.push_back({Eigen::Map<const Vector5>(slot.row.v.data()), true, false, 0, 0});
  }
  template <class Motion>
  void crosses(const Slab& slab, const SlabNoise<double>& noise, const Motion& motion) {
    mark(motion, -1, &slab);
    add(noise.turn);
    add(Eigen::Map<const Vector5>(noise.dip.v.data()));
    add(Vector5(noise.straggling[0], noise.straggling[1], noise.straggling[2], noise.straggling[3], 0));
    if (!slab.shifts) return;
    add(noise.shift_across);
    add(noise.shift_along);
  }
  template <class Motion>
  void ends(const Motion& motion) {
    mark(motion, -1, nullptr);
  }

 private:
  template <class Motion>
  void mark(const Motion& motion, std::int32_t hit, const Slab* slab) {
    Matrix5 jacobian;
    Eigen::Index i = 0;
    for (const Five<double>& row : motion.derivatives())
      jacobian.row(i++) = Eigen::Map<const Vector5>(row.v.data()).transpose();
    way_->stations.push_back({way_->elements.size(), hit, slab, motion.point(), jacobian});
  }
  void add(const Vector5& g) { way_->elements.push_back({g, false, false, 0, 0}); }
  void add(const std::array<double, 3>& g) { add(Vector5(g[0], g[1], 0, g[2], 0)); }

  Way* way_;
};

}  // namespace

void follow(const Detector& detector, const Perigee& start, double mass, std::span<const Hit> hits,
            Way& way) {
  way.elements.clear();
  way.stations.clear();
  way.predicted.assign(hits.size(), 0);
  if (!std::isfinite(start.kappa) || start.kappa == 0) return;
  const std::vector<std::int8_t> no_sides(hits.size(), 0);
  const std::span<const std::int8_t> sides(no_sides);
  Group<double> group;
  GroupBuilder<double>(detector).build(std::span(&hits, 1), std::span(&sides, 1), group);
  Tracer<double, HelixMotion<double>, Recorder>(detector, start, mass, projectile_of(mass, start.kappa),
                                                group, Recorder(way))
      .run(true);
}

}  // namespace cgemit
