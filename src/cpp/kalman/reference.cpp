#include "kalman/reference.hpp"

#include <algorithm>
#include <cmath>

#include "detector/strip_plane.hpp"
#include "matter/loss.hpp"
#include "matter/scattering.hpp"
#include "motion/helix.hpp"
#include "motion/wire.hpp"

namespace cgemit {

namespace {

// (1 - cos f)/f^2 and (f - sin f)/f^2: the integral of the position over a helix step.
struct StepIntegral {
  double along, across;
};
StepIntegral step_integral(double f) {
  const double q = f * f;
  if (q < 0.25) {
    return {
        0.5 + q * (-1.0 / 24 + q * (1.0 / 720 + q * (-1.0 / 40320 + q * (1.0 / 3628800 - q / 479001600)))),
        f * (1.0 / 6 + q * (-1.0 / 120 + q * (1.0 / 5040 + q * (-1.0 / 362880 + q / 39916800))))};
  }
  return {(1 - std::cos(f)) / q, (f - std::sin(f)) / q};
}

constexpr double seam_margin = 50;  // mm, more than a first helix is ever off at a CGEM layer

// Derivatives follow from one picture: a change of curvature dw on a piece ds'' of the path turns all that
// follows about that piece. With Z the quarter turn, the displacement at r(s) is
//   dr = dr0 + dpsi Z (r - r0) + Z integral dw(s'') (r(s) - r(s'')) ds'',
// so that two running integrals, of the curvature's derivative and of that times the position, give every row
// exactly, with energy loss (which makes the curvature depend on where it is, and on tanl) as without.
class Tracer {
 public:
  Tracer(const Detector& detector, const Perigee& start, double mass, Reference& out)
      : detector_(detector),
        out_(out),
        now_(std::sqrt(1 + start.tanl * start.tanl) / std::abs(start.kappa), mass,
             projectile_of(mass, start.kappa)),
        track_(total_matter(detector, start.tanl)) {
    point_ = {start.d * std::sin(start.psi),
              -start.d * std::cos(start.psi),
              start.z0,
              std::cos(start.psi),
              std::sin(start.psi),
              start.tanl,
              curvature(detector.bz, start.kappa)};
    u0x_ = point_.ux;
    u0y_ = point_.uy;
    tanl_ = start.tanl;
    stretch_ = std::sqrt(1 + tanl_ * tanl_);
    kappa_ = start.kappa;
    per_kappa_ = curvature(detector.bz, 1.0);
  }

  void run(std::span<const Hit> hits) {
    const double inner = point_.radius();
    for (const Place& place : detector_.places) {
      if (out_.reached == hits.size()) return;
      if (place.radius <= inner) continue;
      const auto index = static_cast<std::size_t>(place.index);
      if (!place.is_slab) {
        while (out_.reached < hits.size() && hits[out_.reached].view == View::wire &&
               hits[out_.reached].layer == place.index) {
          if (!meet_wire(hits[out_.reached])) return;
          ++out_.reached;
        }
        continue;
      }
      const Slab& slab = detector_.slabs[index];
      const bool reached = !curled_ && go_to(place.radius);
      if (slab.gap >= 0) {
        if (!reached) return;
        while (out_.reached < hits.size() && hits[out_.reached].view != View::wire &&
               hits[out_.reached].layer == slab.gap) {
          meet_gap(hits[out_.reached]);
          ++out_.reached;
        }
      }
      // A helix that curls back below a slab may still pass by the wires of the next layer.
      if (reached && std::abs(point_.z) <= slab.half_length && !cross(slab)) return;
    }
  }

 private:
  // Displacement across the flight and along z at one point, by the parameters at the origin.
  struct Rows {
    Vector5 across, along_z;
    double forward_d, forward_kappa, forward_tanl;  // displacement along the flight; by psi it is S
    double s;
  };

  Rows rows() const {
    const double x = point_.x, y = point_.y, ux = point_.ux, uy = point_.uy;
    const double kx = per_kappa_ * (sum_kappa_ * x - position_kappa_x_),
                 ky = per_kappa_ * (sum_kappa_ * y - position_kappa_y_);
    const double tx = per_kappa_ * (sum_tanl_ * x - position_tanl_x_),
                 ty = per_kappa_ * (sum_tanl_ * y - position_tanl_y_);
    Rows r;
    r.s = point_.sideways();
    r.forward_d = ux * u0y_ - uy * u0x_;
    r.forward_kappa = uy * kx - ux * ky;
    r.forward_tanl = uy * tx - ux * ty;
    r.across << -(ux * u0x_ + uy * u0y_), point_.outward(), ux * kx + uy * ky, 0, ux * tx + uy * ty;
    r.along_z << -tanl_ * r.forward_d, -tanl_ * r.s, -tanl_ * r.forward_kappa, 1,
        arc_ - tanl_ * r.forward_tanl;
    return r;
  }

  // Accounts for a step that began at `from`.
  void count(const HelixPoint& from, double step) {
    const StepIntegral i = step_integral(from.w * step);
    const double square = step * step;
    const double ix = from.x * step + square * (i.along * from.ux - i.across * from.uy),
                 iy = from.y * step + square * (i.along * from.uy + i.across * from.ux);
    sum_kappa_ += d_kappa_ * step;
    position_kappa_x_ += d_kappa_ * ix;
    position_kappa_y_ += d_kappa_ * iy;
    sum_tanl_ += d_tanl_ * step;
    position_tanl_x_ += d_tanl_ * ix;
    position_tanl_y_ += d_tanl_ * iy;
    arc_ += step;
  }

  bool go_to(double radius) {
    const HelixPoint from = point_;
    double step = 0;
    if (!step_to_cylinder(point_, radius, step)) return false;
    count(from, step);
    return true;
  }

  void add_row(const Vector5& h) {
    out_.elements.push_back({h, true, static_cast<std::int32_t>(out_.reached), 0, 0});
  }
  void add_noise(const Vector5& g) { out_.elements.push_back({g, false, -1, 0, 0}); }

  void meet_gap(const Hit& hit) {
    const CgemLayer& layer = detector_.cgem[static_cast<std::size_t>(hit.layer)];
    const Rows r = rows();
    const double radius = point_.radius(), outward = point_.outward();
    const double tan_a = r.s / outward, per_cos = radius / outward;
    const double scale = layer.r_readout / radius;
    const double gap = layer.r_gap_out - layer.r_gap_in;
    const double around = 2 * pi * layer.r_readout;
    double x = local_x(layer, hit.element, std::atan2(point_.y, point_.x));
    if (hit.view == View::x) x += around * std::round((hit.value - x) / around);
    const double x_extent = scale * gap * tan_a, z_extent = gap * per_cos * tanl_;
    const Vector5 row_x = (scale * per_cos) * r.across;
    if (hit.view == View::x) {
      out_.crossings.push_back({x, std::abs(x_extent)});
      add_row(row_x);
      return;
    }
    const double cosine = layer.cos_stereo, sine = layer.sin_stereo;
    double v = local_v(layer, x, point_.z);
    // Near the sheet's first edge track and hit may lie on either side of it.
    const double other = x < 0.5 * around ? v + around * cosine : v - around * cosine;
    const bool near_edge = std::min(x, around - x) < seam_margin;
    if (near_edge && std::abs(other - hit.value) < std::abs(v - hit.value)) v = other;
    out_.crossings.push_back({v, std::abs(x_extent * cosine - z_extent * sine)});
    add_row(cosine * row_x - sine * (r.along_z + (tanl_ * tan_a) * r.across));
  }

  bool meet_wire(const Hit& hit) {
    const WireLayer& layer = detector_.wires[static_cast<std::size_t>(hit.layer)];
    const HelixPoint from = point_;
    Approach approach{};
    if (!approach_wire(point_, layer.placed[static_cast<std::size_t>(hit.element)], approach)) return false;
    count(from, approach.arc);
    curled_ = point_.outward() < 0;
    const Rows r = rows();
    const double across = approach.ny * point_.ux - approach.nx * point_.uy;
    out_.crossings.push_back({approach.doca, 0});
    add_row(across * r.across + approach.nz * r.along_z);
    return true;
  }

  // Origin parameters of a track that is displaced or turned here and whose kappa and tanl change.
  class Backward {
   public:
    Backward(const Tracer& t, const Rows& r) : r_(r) {
      const double w = t.point_.w;
      psi_d_ = -w * r.forward_d;
      psi_psi_ = 1 - w * r.s;
      psi_kappa_ = t.per_kappa_ * t.sum_kappa_ - w * r.forward_kappa;
      psi_tanl_ = t.per_kappa_ * t.sum_tanl_ - w * r.forward_tanl;
      per_determinant_ = 1 / (r.across[0] * psi_psi_ - r.across[1] * psi_d_);
      per_d_kappa_ = 1 / t.d_kappa_;
      d_tanl_ = t.d_tanl_;
    }
    // By (across, along_z) mm and psi rad at fixed kappa and tanl.
    Vector5 moved(double across, double along_z, double psi) const {
      const double d = (across * psi_psi_ - r_.across[1] * psi) * per_determinant_;
      const double turn = (r_.across[0] * psi - psi_d_ * across) * per_determinant_;
      return Vector5(d, turn, 0, along_z - r_.along_z[0] * d - r_.along_z[1] * turn, 0);
    }
    // By kappa and tanl at fixed place and azimuth.
    Vector5 changed(double kappa, double tanl) const {
      const double kappa0 = (kappa - d_tanl_ * tanl) * per_d_kappa_;
      Vector5 v =
          moved(-r_.across[2] * kappa0 - r_.across[4] * tanl, -r_.along_z[2] * kappa0 - r_.along_z[4] * tanl,
                -psi_kappa_ * kappa0 - psi_tanl_ * tanl);
      v[2] = kappa0;
      v[4] = tanl;
      return v;
    }

   private:
    const Rows& r_;
    double psi_d_, psi_psi_, psi_kappa_, psi_tanl_, per_determinant_, per_d_kappa_, d_tanl_;
  };

  // Noise of a slab, then its energy loss on the reference. False if the particle stops.
  bool cross(const Slab& slab) {
    const double path = path_factor(slab, stretch_, std::abs(point_.outward()));
    const LossMoments loss = core_loss(slab, path, now_, track_);
    if (now_.kinetic() - loss.loss < least_kinetic) {
      out_.stopped = true;
      return false;
    }
    const Kinematics after = now_.after_loss(loss.loss);
    const double theta = std::sqrt(scattering_variance(slab, path, now_, after, track_));
    const Rows r = rows();
    const Backward origin(*this, r);
    add_noise(origin.moved(0, 0, theta * stretch_));
    add_noise(origin.changed(kappa_ * tanl_ * theta, stretch_ * stretch_ * theta));
    add_noise(origin.changed(kappa_ * std::sqrt(loss.variance) * now_.energy / (now_.p * now_.p), 0));
    if (slab.shifts) {
      const double shift = theta * slab.spread * path;
      add_noise(origin.moved(shift, 0, 0));
      // A shift in dip moves along the flight too, where the azimuth is another.
      add_noise(origin.moved(0, shift * stretch_, point_.w * shift * tanl_ / stretch_));
    }
    lose(loss, after);
    return true;
  }

  void lose(const LossMoments& loss, const Kinematics& after) {
    // dp'/dp at fixed tanl, and dp'/dtanl at fixed p, of p' = p(E(p) - loss(p, tanl)).
    const double energy_per_p = after.energy / after.p, ratio = now_.p / after.p;
    const double by_p = energy_per_p * (now_.p / now_.energy - loss.slope);
    const double slope = tanl_ / (stretch_ * stretch_);
    const double by_tanl = -energy_per_p * loss.loss * slope;
    const double gain = by_p * ratio * ratio;
    const double mixed = kappa_ * ratio * (slope - by_p * ratio * slope - by_tanl / after.p);
    d_kappa_ *= gain;
    d_tanl_ = gain * d_tanl_ + mixed;
    kappa_ *= ratio;
    now_ = after;
    point_.w = per_kappa_ * kappa_;
  }

  const Detector& detector_;
  Reference& out_;
  HelixPoint point_{};
  Kinematics now_;
  TrackMatter track_;
  double u0x_, u0y_, tanl_, stretch_, kappa_, per_kappa_;
  double arc_ = 0;
  bool curled_ = false;              // past the outermost point: no cylinder lies ahead
  double d_kappa_ = 1, d_tanl_ = 0;  // derivatives of the local kappa by the origin's kappa and tanl
  double sum_kappa_ = 0, position_kappa_x_ = 0, position_kappa_y_ = 0;
  double sum_tanl_ = 0, position_tanl_x_ = 0, position_tanl_y_ = 0;
};

}  // namespace

void trace(const Detector& detector, const Perigee& start, double mass, std::span<const Hit> hits,
           Reference& out) {
  out.elements.clear();
  out.crossings.clear();
  out.reached = 0;
  out.stopped = false;
  if (!std::isfinite(start.kappa) || start.kappa == 0) return;
  Tracer(detector, start, mass, out).run(hits);
}

}  // namespace cgemit
