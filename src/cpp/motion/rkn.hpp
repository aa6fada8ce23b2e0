// Motion in a field that changes from place to place: Runge-Kutta-Nystrom steps of fourth order.
//
// With x the place, t the direction of flight (unit vector) and l the path,
//   dx/dl = t,   dt/dl = a = bend (t x B(x)),   bend = charge/p over 10^6/c: 1/(mm T).
// Three places of a step know the field, four directions the force (E. J. Nystroem, Acta Soc. Sci. Fenn. 50
// no. 13 (1925); J. Myrheim and L. Bugge, Nucl. Instrum. Methods 160 (1979) 43). The same stages transport
// derivatives by any parameters, the field's gradient included (L. Bugge and J. Myrheim, Nucl. Instrum.
// Methods 179 (1981) 365).
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "field/field.hpp"

namespace cgemit {

struct FieldPoint {
  Eigen::Vector3d x;  // mm
  Eigen::Vector3d t;  // unit vector
  double bend;        // 1/(mm T)
};

// By five parameters: three rows of x, three of t, one of bend.
using FieldDerivatives = Eigen::Matrix<double, 7, 5>;

class RungeKutta {
 public:
  explicit RungeKutta(const FieldMap& field) : field_(field) {}

  // Moves along the path, back if it is negative; `derivatives` go along. False, leaving both where the track
  // leaves the map.
  bool advance(FieldPoint& point, double path, FieldDerivatives* derivatives = nullptr) {
    if (!field_.holds(point.x[0], point.x[1], point.x[2])) return false;
    double left = path;
    for (int steps = 0; left != 0 && steps < most_steps; ++steps) {
      const double h = std::copysign(std::min(std::abs(left), step_), left);
      const bool is_last = h == left;
      const Stages s = derivatives != nullptr ? stages<true>(point, h) : stages<false>(point, h);
      const double growth =
          s.error > 0 ? 0.9 * std::sqrt(std::sqrt(field_.tolerance / s.error)) : most_growth;
      if (!(s.error <= field_.tolerance) && std::abs(h) > shortest) {
        step_ = std::max(std::abs(h) * std::clamp(growth, 0.1, 0.9), shortest);
        continue;
      }
      step_ = std::max(is_last ? step_ : 0.0, std::abs(h) * std::clamp(growth, 0.1, most_growth));
      if (derivatives != nullptr) transport(point, h, s, *derivatives);
      move(point, h, s);
      if (!field_.holds(point.x[0], point.x[1], point.x[2])) return false;
      left = is_last ? 0 : left - h;
    }
    return left == 0;
  }

  Eigen::Vector3d field(const Eigen::Vector3d& x) const {
    return Eigen::Vector3d(field_.at(x[0], x[1], x[2]).data());
  }

 private:
  static constexpr int most_steps = 100000;
  static constexpr double most_growth = 4, shortest = 1e-3;  // mm

  using Gradient = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

  struct Stages {
    Eigen::Vector3d x2, x4;                      // middle and end
    Eigen::Vector3d t2, t3, t4;                  // directions there
    Eigen::Vector3d b1, b2, b4;                  // fields
    Eigen::Vector3d turn1, turn2, turn3, turn4;  // t x B
    Gradient g1, g2, g4;                         // of the field, if asked for
    double error;                                // mm
  };

  template <bool gradients>
  Stages stages(const FieldPoint& p, double h) const {
    const double hb = h * p.bend;
    Stages s;
    s.b1 = look<gradients>(p.x, s.g1);
    s.turn1 = p.t.cross(s.b1);
    s.x2 = p.x + 0.5 * h * p.t + 0.125 * h * hb * s.turn1;
    s.b2 = look<gradients>(s.x2, s.g2);
    s.t2 = p.t + 0.5 * hb * s.turn1;
    s.turn2 = s.t2.cross(s.b2);
    s.t3 = p.t + 0.5 * hb * s.turn2;
    s.turn3 = s.t3.cross(s.b2);
    s.x4 = p.x + h * p.t + 0.5 * h * hb * s.turn3;
    s.b4 = look<gradients>(s.x4, s.g4);
    s.t4 = p.t + hb * s.turn3;
    s.turn4 = s.t4.cross(s.b4);
    s.error = std::abs(h * hb) * (s.turn1 - s.turn2 - s.turn3 + s.turn4).norm();
    return s;
  }

  template <bool gradients>
  Eigen::Vector3d look(const Eigen::Vector3d& x, Gradient& gradient) const {
    if constexpr (!gradients) return field(x);
    FieldGradient g;
    const FieldVector b = field_.at(x[0], x[1], x[2], g);
    gradient = Gradient(g[0].data());
    return Eigen::Vector3d(b.data());
  }

  static void move(FieldPoint& p, double h, const Stages& s) {
    const double hb = h * p.bend;
    p.x += h * p.t + h * hb / 6 * (s.turn1 + s.turn2 + s.turn3);
    p.t += hb / 6 * (s.turn1 + 2 * (s.turn2 + s.turn3) + s.turn4);
    p.t.normalize();
  }

  static void transport(const FieldPoint& p, double h, const Stages& s, FieldDerivatives& d) {
    using Columns = Eigen::Matrix<double, 3, 5>;
    // Change of the force: by bend, by the direction, by the field at the place.
    const auto force = [&p, &d](const Eigen::Vector3d& turn, const Columns& dt, const Eigen::Vector3d& b,
                                const Eigen::Vector3d& t, const Columns& db) {
      Columns sum = turn * d.row(6);
      for (Eigen::Index i = 0; i < 5; ++i) sum.col(i) += p.bend * (dt.col(i).cross(b) + t.cross(db.col(i)));
      return sum;
    };
    const Columns dx = d.topRows<3>(), dt = d.middleRows<3>(3);
    const Columns a1 = force(s.turn1, dt, s.b1, p.t, s.g1 * dx);
    const Columns db2 = s.g2 * (dx + 0.5 * h * dt + 0.125 * h * h * a1);
    const Columns a2 = force(s.turn2, dt + 0.5 * h * a1, s.b2, s.t2, db2);
    const Columns a3 = force(s.turn3, dt + 0.5 * h * a2, s.b2, s.t3, db2);
    const Columns db4 = s.g4 * (dx + h * dt + 0.5 * h * h * a3);
    const Columns a4 = force(s.turn4, dt + h * a3, s.b4, s.t4, db4);
    d.topRows<3>() += h * dt + h * h / 6 * (a1 + a2 + a3);
    d.middleRows<3>(3) += h / 6 * (a1 + 2 * (a2 + a3) + a4);
  }

  const FieldMap& field_;
  double step_ = HUGE_VAL;  // mm, what the tolerance allowed last
};

}  // namespace cgemit
