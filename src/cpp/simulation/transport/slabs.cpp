#include "simulation/transport/slabs.hpp"

#include <cmath>

#include "simulation/transport/slab_draws.hpp"

namespace cgemit {

namespace {

// Moves in a straight line to a plane across x.
void drift(HelixPoint& point, double x) {
  const double step = (x - point.x) / point.ux;
  point.x = x;
  point.y += step * point.uy;
  point.z += step * point.tanl;
}

TransportStatus pass(const Detector& detector, Kinematics now, const Stream& stream, HelixPoint& point,
                     double& energy_left) {
  for (std::size_t i = 0; i < detector.slabs.size(); ++i) {
    const Slab& slab = detector.slabs[i];
    drift(point, slab.radius);
    const double path = std::min(std::sqrt(1 + point.tanl * point.tanl) / point.ux, 100.0);
    const auto place = static_cast<std::uint32_t>(i);
    const double loss = draw_loss(slab, path, now, stream, place).loss;
    if (now.kinetic() - loss < stopped_below(now.mass)) {
      energy_left = 0;
      return TransportStatus::stopped;
    }
    const Kinematics after = now.after_loss(loss);
    apply_kick(point, sample_scattering(slab, path, now, after, stream, place));
    now = after;
    energy_left = now.kinetic();
    if (!(point.ux > 0.01)) return TransportStatus::curled;
  }
  drift(point, detector.slabs.back().r_out);
  return TransportStatus::outside;
}

}  // namespace

SlabResults through_slabs(const Detector& detector, const Kinematics& incoming, std::uint64_t first,
                          std::size_t n, std::uint64_t seed) {
  SlabResults out;
  if (detector.slabs.empty()) return out;
  for (auto* column : {&out.angle_1, &out.angle_2, &out.shift_1, &out.shift_2, &out.loss}) column->reserve(n);
  for (std::size_t row = 0; row < n; ++row) {
    HelixPoint point{detector.slabs.front().r_in, 0, 0, 1, 0, 0, 0};
    double left = incoming.kinetic();
    out.status.push_back(pass(detector, incoming, Stream(seed, first + row, 0), point, left));
    out.angle_1.push_back(std::atan2(point.uy, point.ux));
    out.angle_2.push_back(std::atan2(point.tanl, point.ux));
    out.shift_1.push_back(point.y);
    out.shift_2.push_back(point.z);
    out.loss.push_back(incoming.kinetic() - left);
  }
  return out;
}

}  // namespace cgemit
