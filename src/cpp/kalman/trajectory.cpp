#include "kalman/trajectory.hpp"

#include <cmath>
#include <type_traits>

#include "kalman/builder.hpp"
#include "kalman/field_reference.hpp"

namespace cgemit {

namespace {

// The observer that records the trajectory.
class Recorder {
 public:
  static constexpr bool provides_hits = false, stops_at_wires = true;

  Recorder(const Detector& detector, ReferenceTrajectory& trajectory)
      : trajectory_(&trajectory), per_kappa_(curvature(detector.bz, 1.0)) {}

  template <class Motion>
  void meets(const Slot<double>& slot, const Motion& motion) {
    mark(motion, slot.hit[0], nullptr);
    trajectory_->predicted[static_cast<std::size_t>(slot.hit[0])] = slot.predicted;
    trajectory_->terms.push_back({Eigen::Map<const Vector5>(slot.row.v.data()), true, false, 0, 0});
  }
  template <class Motion>
  void arrives(const Slab& slab, const Motion& motion) {
    mark(motion, -1, &slab);
  }
  template <class Noise>
  void crosses(const Slab& slab, const Noise& noise, const Kink<double>& kink) {
    const auto [turn, dip] = in_noise_units(kink);
    add(noise.turn, turn);
    add(noise.dip, dip);
    add(noise.straggling);
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
    trajectory_->stations.push_back(
        {trajectory_->terms.size(), hit, slab, motion.point(), kappa_of(motion), jacobian});
  }
  // In a uniform field kappa follows from the curvature at a point, bit for bit.
  double kappa_of(const HelixMotion<double>& motion) const {
    return per_kappa_ == 0 ? motion.kappa() : motion.point().w / per_kappa_;
  }
  static double kappa_of(const FieldReference<double>& motion) { return motion.kappa(); }
  template <class G>
  void add(const G& g, double has = 0) {
    trajectory_->terms.push_back({vector5(g), false, false, has, 0});
  }

  ReferenceTrajectory* trajectory_;
  double per_kappa_;  // curvature for kappa = 1 in a uniform field
};

}  // namespace

void follow(const Detector& detector, const Perigee& start, const Species& species, double matter_p,
            std::span<const Hit> hits, std::span<const double> kinks, ReferenceTrajectory& trajectory) {
  trajectory.terms.clear();
  trajectory.stations.clear();
  trajectory.predicted.assign(hits.size(), 0);
  if (!std::isfinite(start.kappa) || start.kappa == 0) return;
  const std::vector<std::int8_t> no_sides(hits.size(), 0);
  const std::span<const std::int8_t> sides(no_sides);
  Group<double> group;
  GroupBuilder<double>(detector).build(std::span(&hits, 1), std::span(&sides, 1), group);
  set_kinks(group, kinks);
  const auto run = [&]<class Motion>(std::type_identity<Motion>) {
    Tracer<double, Motion, Recorder>(detector, start, species, group, Recorder(detector, trajectory),
                                     {matter_p > 0, matter_p})
        .run(true);
  };
  if (detector.field.is_uniform()) {
    run(std::type_identity<HelixMotion<double>>());
  } else {
    run(std::type_identity<FieldReference<double>>());
  }
}

}  // namespace cgemit
