#include "kalman/local.hpp"

#include <cmath>

#include "common/angles.hpp"
#include "kalman/field_local.hpp"
#include "kalman/slab_crossing.hpp"

namespace cgemit {

namespace {

// In the local coordinates; kappa and tanl are those inside the slab.
Matrix5 covariance(const Slab& slab, const LocalNoise<double>& noise) {
  Matrix5 g = Matrix5::Zero();
  g(1, 0) = noise.turn_psi;
  g(2, 1) = noise.dip_kappa;
  g(4, 1) = noise.dip_tanl;
  g(2, 2) = noise.straggling_kappa;
  if (slab.shifts) {
    g(0, 3) = -noise.shift_across;
    g(3, 4) = noise.shift_z;
    g(1, 4) = noise.shift_psi;
  }
  return g * g.transpose();
}

// To a point of the same helix, an arc ahead or (negative) behind.
void move_to(LocalState& state, const HelixPoint& to, double arc, double per_kappa) {
  const Matrix5 j = pivot_jacobian(state.helix, 0, arc, per_kappa);
  state.c = (j * state.c * j.transpose()).eval();
  state.helix.d = state.helix.z0 = 0;
  state.helix.psi = std::atan2(to.uy, to.ux);
  state.x = to.x;
  state.y = to.y;
  state.z = to.z;
}

}  // namespace

HelixPoint point_of(const LocalState& state, double per_kappa) {
  return closest_point(state.helix, per_kappa, state.x, state.y, state.z);
}

Matrix5 pivot_jacobian(const Perigee& from, double d_to, double arc, double per_kappa) {
  const double w = per_kappa * from.kappa, theta = w * arc, square = arc * arc;
  const StepIntegral<double> t = step_integral(theta);
  const double over = 1 - theta * t.across, sine = theta * over, cosine = 1 - theta * theta * t.along;
  const double before = 1 - w * from.d, per_after = 1 / (1 - w * d_to);
  Matrix5 j = Matrix5::Identity();
  j(0, 0) = cosine;
  j(0, 1) = -before * arc * over;
  j(0, 2) = -per_kappa * square * t.along;
  j(1, 0) = w * sine * per_after;
  j(1, 1) = before * cosine * per_after;
  j(1, 2) = per_kappa * arc * over * per_after;
  j(3, 0) = from.tanl * sine * per_after;
  j(3, 1) = -from.tanl * (arc * theta * t.along - d_to + from.d * cosine) * per_after;
  j(3, 2) = -from.tanl * per_kappa * (square * t.across - d_to * arc) * per_after;
  j(3, 4) = arc;
  return j;
}

bool change_pivot(LocalState& state, double x, double y, double z, double per_kappa) {
  const HelixPoint point = point_of(state, per_kappa);
  const PivotApproach closest = approach_pivot(point, x, y);
  if (!closest.exists) return false;
  const Matrix5 j = pivot_jacobian(state.helix, closest.d, closest.arc, per_kappa);
  state.c = (j * state.c * j.transpose()).eval();
  state.helix.d = closest.d;
  state.helix.psi = wrap_angle(state.helix.psi + closest.turn);
  state.helix.z0 = point.z + closest.arc * point.tanl - z;
  state.x = x;
  state.y = y;
  state.z = z;
  return true;
}

StateStatus LocalMotion::to_track(LocalState& state) const {
  if (!field_.is_uniform())
    return integrate(state, [](FieldMotion&, FieldHelixPoint<double>&) { return true; });
  move_to(state, point_of(state, per_kappa_), 0, per_kappa_);
  return StateStatus::ok;
}

StateStatus LocalMotion::to_cylinder(LocalState& state, double radius) const {
  double arc = 0;
  if (!field_.is_uniform())
    return integrate(state, [&](FieldMotion& m, auto& point) { return m.to_cylinder(point, radius, arc); });
  HelixPoint point = point_of(state, per_kappa_);
  if (!step_to_cylinder(point, radius, arc)) return StateStatus::does_not_reach;
  move_to(state, point, arc, per_kappa_);
  return StateStatus::ok;
}

StateStatus LocalMotion::to_wire(LocalState& state, const Wire& wire) const {
  Approach approach{};
  if (!field_.is_uniform())
    return integrate(state, [&](FieldMotion& m, auto& point) { return m.approach(point, wire, approach); });
  HelixPoint point = point_of(state, per_kappa_);
  if (!approach_wire(point, wire, approach)) return StateStatus::does_not_reach;
  move_to(state, point, approach.arc, per_kappa_);
  return StateStatus::ok;
}

double LocalMotion::turning(const HelixPoint& point, double kappa) const {
  if (field_.is_uniform()) return per_kappa_ * kappa;
  HelixPoint bent = point;
  FieldMotion(field_).bend(bent, kappa);
  return bent.w;
}

template <class Move>
StateStatus LocalMotion::integrate(LocalState& state, const Move& move) const {
  FieldHelixPoint<double> point{point_of(state, 0), {}};
  if (!field_.holds(Vec3<double>{point.x, point.y, point.z})) return StateStatus::left_field;
  FieldMotion motion(field_);
  motion.look(point);
  motion.bend(point, state.helix.kappa);
  auto by = derivatives_by<double>(state.helix, point, point.field.b, motion.bending());
  motion.carry(&by);
  const bool there = move(motion, point);
  if (motion.left()) return StateStatus::left_field;
  if (!there) return StateStatus::does_not_reach;
  const auto by_kappa = kappa_derivatives<double>(point, motion.charge_per_p(), by);
  Matrix5 j;
  for (std::size_t k = 0; k < parameters; ++k)
    j.col(static_cast<Eigen::Index>(k)) << -by.across[k], by.psi[k], by_kappa[k], by.z[k], by.tanl[k];
  const double kappa = motion.charge_per_p() * std::sqrt(1 + point.tanl * point.tanl);
  state = {point.x,
           point.y,
           point.z,
           {0, std::atan2(point.uy, point.ux), kappa, 0, point.tanl},
           (j * state.c * j.transpose()).eval(),
           state.matter_p};
  return StateStatus::ok;
}

bool cross(LocalState& state, const Slab& slab, double part, const PropagationContext& context, bool outward,
           bool noise) {
  Perigee& h = state.helix;
  const Dip<double> dip(h.tanl);
  const HelixPoint point = point_of(state, 0);
  const double path = part * path_factor(slab, dip.sec, std::abs(point.outward()));
  const bool given = state.matter_p > 0;
  const double momentum = given ? state.matter_p : context.charge * dip.sec / std::abs(h.kappa);
  const Kinematics here(momentum, species_of(context.mass, context.charge, h.kappa));
  const LossMoments loss = core_loss(slab, path, here, context.matter);
  if (outward && stops(here, loss)) return false;
  const SlabCrossing<double> crossing = outward ? cross_outward(slab, path, here, loss, context.matter)
                                                : cross_inward(slab, path, here, context.matter);
  const double kappa = outward ? h.kappa : h.kappa * crossing.after.p / crossing.before.p;
  LossJacobian<double> by = crossing.jacobian(kappa, dip);
  double kappa_in_matter = kappa;
  if (given) {  // as in the reference trajectory
    by.gain = by.ratio;
    by.mixed = 0;
    kappa_in_matter = std::copysign(context.charge * dip.sec * crossing.before.per_p, kappa);
    state.matter_p = outward ? crossing.after.p : crossing.before.p;
  }
  Matrix5 j = Matrix5::Identity();
  j(2, 2) = by.gain;
  j(2, 4) = by.mixed;
  if (!outward) {
    j(2, 2) = 1 / j(2, 2);
    j(2, 4) *= -j(2, 2);
    state.c = (j * state.c * j.transpose()).eval();
  }
  if (noise)
    state.c +=
        covariance(slab, crossing.noise(slab, kappa_in_matter, dip, context.motion.turning(point, kappa)));
  if (outward) state.c = (j * state.c * j.transpose()).eval();
  h.kappa = outward ? h.kappa * by.ratio : kappa;
  return true;
}

StateStatus traverse(LocalState& state, double radius, const Slab& slab, double part,
                     const PropagationContext& context, bool outward) {
  const StateStatus moved = context.motion.to_cylinder(state, radius);
  if (moved != StateStatus::ok) return moved;
  if (slab.ends.miss(state.z)) return StateStatus::ok;
  return cross(state, slab, part, context, outward, true) ? StateStatus::ok : StateStatus::stopped;
}

}  // namespace cgemit
