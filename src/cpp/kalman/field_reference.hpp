// The reference trajectory in a field map, with the interface of `HelixMotion` for the tracer.
//
// Every step also propagates the derivatives by the five parameters at the origin. The inverse of the matrix
// of the parameters at one point by those at the origin transports noise from that point to the origin.
#pragma once

#include "kalman/deflection.hpp"
#include "kalman/field_local.hpp"
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
    const mask_of<T> reached = motion_.to_cylinder(point_, radius, arc, true, who);
    left_ = left_ | motion_.left();
    return reached;
  }
  mask_of<T> approach(const WireOf<T>& wire, ApproachOf<T>& result, const mask_of<T>& who) {
    const mask_of<T> met = motion_.approach(point_, wire, result, who);
    left_ = left_ | motion_.left();
    return met;
  }

  Rows<T> rows() const {
    Rows<T> r{};
    r.sideways = point_.sideways();
    r.across = {by_origin_.across};
    r.along_z = {by_origin_.z};
    return r;
  }

  // As in `HelixMotion`; lanes without loss stay as they are.
  void lose(const T& ratio, const T& gain, const T& mixed) {
    const auto slow_down = [&](Row&) {
      const Row by_kappa = kappa_derivatives<T>(point_, motion_.charge_per_p(), by_origin_);
      motion_.lose(point_, ratio);
      const T sec = sec_lambda(), share = motion_.charge_per_p() * point_.tanl / sec,
              per = 1.0 / (sec * radius_per_kappa);
      for (std::size_t i = 0; i < parameters; ++i)
        by_origin_.bend[i] = per * (gain * by_kappa[i] + (mixed - share) * by_origin_.tanl[i]);
    };
    on_cylinder(ratio != 1.0, slow_down);
  }

  void scatter(const T& aside, const T& up) {
    const auto deflect = [&](Row& forward) {
      const Deflection<T> bent(point_.tanl, aside, up);
      for (std::size_t i = 0; i < parameters; ++i) {
        const T across = by_origin_.across[i];
        by_origin_.across[i] = bent.cosine * across - bent.sine * forward[i];
        forward[i] = bent.cosine * forward[i] + bent.sine * across;
        by_origin_.psi[i] += bent.psi_by_tanl * by_origin_.tanl[i];
        by_origin_.tanl[i] *= bent.tanl_by_tanl;
      }
      bent.turn(point_);
      motion_.turned(point_);
    };
    on_cylinder((aside != 0.0) | (up != 0.0), deflect);
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

  T sec_lambda() const { return sqrt(1.0 + point_.tanl * point_.tanl); }

  // Material acts on every displaced track of the lanes `who` on this cylinder, not after the same path:
  // `forward` is the additional path to the cylinder. `act` may turn the plane.
  template <class Act>
  void on_cylinder(const mask_of<T>& who, const Act& act) {
    const FieldDerivatives<T> before = by_origin_;
    const HelixPointOf<T> here = point_;
    const T outward = point_.outward(), ahead = point_.sideways() / outward;
    Row forward;
    for (std::size_t i = 0; i < parameters; ++i) forward[i] = ahead * by_origin_.across[i];
    follow(forward);
    act(forward);
    for (T& x : forward) x = -x;
    follow(forward);
    if (all(who)) return;
    by_origin_ = select(who, by_origin_, before);
    static_cast<HelixPointOf<T>&>(point_) = select<T>(who, point_, here);
  }
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
  mask_of<T> left_{false};
};

}  // namespace cgemit
