// The reference trajectory in a field map, with the interface of `HelixMotion` for the tracer.
//
// Every step also propagates the derivatives by the five parameters at the origin. The inverse of the matrix
// of the parameters at one point by those at the origin transports noise from that point to the origin. Wires
// between two slabs are passed on a span and need no steps.
#pragma once

#include "kalman/deflection.hpp"
#include "kalman/field_local.hpp"
#include "kalman/field_span.hpp"
#include "kalman/helix_motion.hpp"
#include "kalman/inverse.hpp"

namespace cgemit {

template <class T>
class FieldReference {
 public:
  static constexpr bool keeps_dip = false;

  FieldReference(const Detector& detector, const PerigeeOf<T>& start) : motion_(detector) {
    static_cast<HelixPointOf<T>&>(point_) = closest_point(start, 0.0);
    motion_.look(point_);
    motion_.bend(point_, start.kappa);
    by_origin_ = derivatives_by<T>(start, point_, point_.field.b, motion_.bending());
    motion_.carry(&by_origin_);
  }
  // The motion holds a pointer to the derivatives.
  FieldReference(const FieldReference&) = delete;
  FieldReference& operator=(const FieldReference&) = delete;

  const HelixPointOf<T>& point() const { return point_; }
  T kappa() const { return motion_.charge_per_p() * sec_lambda(); }
  // Lanes that left the map before the surface asked for last.
  const mask_of<T>& left() const { return left_; }

  mask_of<T> go_to(double radius, const mask_of<T>& who) {
    T arc(0.0);
    return go_to(radius, who, arc);
  }
  // Moves the lanes `who` to a cylinder and, where they do not reach it, those with `wires` to the last wire
  // before it. The wires on the way then need no steps of their own. Returns the lanes that reached the
  // cylinder.
  mask_of<T> go_past(const WireOf<T>& last, const mask_of<T>& wires, double radius, const mask_of<T>& who) {
    const FieldHelixPoint<T> from = point_;
    const FieldDerivatives<T> by_from = by_origin_;
    T arc(0.0);
    span_.reset();
    at_cylinder_ = any(who) ? go_to(radius, who, arc) : mask_of<T>(false);
    mask_of<T> met = wires & !at_cylinder_;
    if (any(met)) {
      ApproachOf<T> there;
      met = motion_.approach(point_, last, there, met);
      arc = select(met, there.arc, arc);
    }
    if (!any(wires)) return at_cylinder_;
    on_span_ = (at_cylinder_ | met) & (abs(arc * from.w) < most_turn);
    const T path = sqrt(1.0 + from.tanl * from.tanl) * arc;
    span_.emplace(from, by_from, point_, by_origin_, motion_.bending(), select(on_span_, path, T(0.0)));
    return at_cylinder_;
  }
  mask_of<T> approach(const WireOf<T>& wire, ApproachOf<T>& result, const mask_of<T>& who) {
    mask_of<T> met(false);
    if (span_) {
      met = span_->approach(wire, who & on_span_);
      passage_ = span_->passage();
    }
    if (const mask_of<T> others = who & !met; any(others)) {
      const FieldHelixPoint<T> here = point_;
      const FieldDerivatives<T> by_here = by_origin_;
      ApproachOf<T> other;
      const mask_of<T> moved = motion_.approach(point_, wire, other, others);
      left_ = left_ | motion_.left();
      passage_ = select(others, Passage<T>{point_, rows()}, passage_);
      met = met | moved;
      point_ = select(at_cylinder_, here, point_);
      by_origin_ = select(at_cylinder_, by_here, by_origin_);
    }
    result = distance_to_wire(passage_.at, wire);
    return met;
  }
  // Where the last wire was passed.
  const Passage<T>& passage() const { return passage_; }

  Rows<T> rows() const {
    Rows<T> r{};
    r.sideways = point_.sideways();
    r.across = {by_origin_.across};
    r.along_z = {by_origin_.z};
    return r;
  }

  // As in `HelixMotion`; lanes without loss stay as they are, bit for bit. Material acts on every displaced
  // track on this cylinder, not after the same path: `forward` is its additional path to the cylinder.
  void lose(const T& ratio, const T& gain, const T& mixed) {
    const T ahead = select(ratio != 1.0, point_.sideways() / point_.outward(), T(0.0));
    const T rate = slope_rate<T>(point_, point_.field.b, motion_.bending()), rest = 1.0 - ratio;
    const T sec = sec_lambda(), share = motion_.charge_per_p() * point_.tanl / sec;
    const T by_tanl = (share * (gain - ratio) + mixed) / (sec * radius_per_kappa);
    for (std::size_t i = 0; i < parameters; ++i) {
      const T forward = ahead * by_origin_.across[i], turn = rate * forward;
      by_origin_.bend[i] = gain * by_origin_.bend[i] + by_tanl * (by_origin_.tanl[i] + turn);
      by_origin_.psi[i] += rest * (point_.w * forward);
      by_origin_.tanl[i] += rest * turn;
    }
    motion_.lose(point_, ratio);
  }

  // Lanes without a kink stay as they are.
  void scatter(const T& aside, const T& up) {
    const mask_of<T> who = (aside != 0.0) | (up != 0.0);
    const FieldDerivatives<T> before = by_origin_;
    const HelixPointOf<T> here = point_;
    const T ahead = point_.sideways() / point_.outward();
    Row forward;
    for (std::size_t i = 0; i < parameters; ++i) forward[i] = ahead * by_origin_.across[i];
    follow(forward);
    const Deflection<T> bent(point_.tanl, aside, up);
    for (std::size_t i = 0; i < parameters; ++i) {
      const T across = by_origin_.across[i];
      by_origin_.across[i] = bent.cosine * across - bent.sine * forward[i];
      forward[i] = -(bent.cosine * forward[i] + bent.sine * across);
      by_origin_.psi[i] += bent.psi_by_tanl * by_origin_.tanl[i];
      by_origin_.tanl[i] *= bent.tanl_by_tanl;
    }
    bent.turn(point_);
    motion_.turned(point_);
    follow(forward);
    if (all(who)) return;
    by_origin_ = select(who, by_origin_, before);
    static_cast<HelixPointOf<T>&>(point_) = select<T>(who, point_, here);
  }

  // Derivatives of (d, psi, kappa, z0, tanl) with the pivot here by those at the origin, row by row.
  std::array<Five<T>, parameters> derivatives() const {
    Row d;
    for (std::size_t i = 0; i < parameters; ++i) d[i] = -by_origin_.across[i];
    return {{{d},
             {by_origin_.psi},
             {kappa_derivatives<T>(point_, motion_.charge_per_p(), by_origin_)},
             {by_origin_.z},
             {by_origin_.tanl}}};
  }

  // Parameters at the origin of a track that is displaced or turned here and whose kappa and tanl change.
  class Backward {
   public:
    Backward(const FieldReference& m, const Rows<T>&) : back_(inverse(m.derivatives())) {}
    Five<T> turned(const T& psi) const { return psi * column(1); }
    Five<T> moved(const T& across, const T& along_z, const T& psi) const {
      return along_z * column(3) + psi * column(1) - across * column(0);
    }
    Five<T> changed(const T& kappa, const T& tanl) const { return kappa * column(2) + tanl * column(4); }
    Five<T> slowed(const T& kappa) const { return kappa * column(2); }

   private:
    Five<T> column(int k) const {
      return {{back_[0][k], back_[1][k], back_[2][k], back_[3][k], back_[4][k]}};
    }
    std::array<Five<T>, parameters> back_;
  };

 private:
  using Row = typename FieldDerivatives<T>::Row;
  static constexpr double most_turn = 0.5;  // rad, on a span

  mask_of<T> go_to(double radius, const mask_of<T>& who, T& arc) {
    const mask_of<T> reached = motion_.to_cylinder(point_, radius, arc, true, who);
    left_ = left_ | motion_.left();
    return reached;
  }

  T sec_lambda() const { return sqrt(1.0 + point_.tanl * point_.tanl); }

  // Moves neighbours along their flight.
  void follow(const Row& forward) {
    const T rate = slope_rate<T>(point_, point_.field.b, motion_.bending());
    for (std::size_t i = 0; i < parameters; ++i) {
      by_origin_.psi[i] += point_.w * forward[i];
      by_origin_.tanl[i] += rate * forward[i];
      by_origin_.z[i] += point_.tanl * forward[i];
    }
  }

  FieldMotionOf<T> motion_;
  FieldHelixPoint<T> point_;
  FieldDerivatives<T> by_origin_;
  std::optional<FieldSpan<T>> span_;                // past the wires before the next cylinder
  mask_of<T> on_span_{false}, at_cylinder_{false};  // lanes that have one; whose span ends at the cylinder
  Passage<T> passage_{};
  mask_of<T> left_{false};
};

}  // namespace cgemit
