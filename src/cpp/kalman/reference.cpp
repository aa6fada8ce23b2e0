#include "kalman/reference.hpp"

#include <cmath>

#include "kalman/builder.hpp"
#include "kalman/field_reference.hpp"

namespace cgemit {

namespace {

void add_noise(const SlabNoise<double>& noise, bool shifts, std::vector<Vector5>& out) {
  const auto sparse = [&out](const std::array<double, 3>& g) {
    out.push_back(Vector5(g[0], g[1], 0, g[2], 0));
  };
  sparse(noise.turn);
  out.push_back(Eigen::Map<const Vector5>(noise.dip.v.data()));
  const auto& s = noise.straggling;
  out.push_back(Vector5(s[0], s[1], s[2], s[3], 0));
  if (!shifts) return;
  sparse(noise.shift_across);
  sparse(noise.shift_along);
}

}  // namespace

Reference trace(const Detector& detector, const Perigee& start, double mass, std::span<const Hit> hits) {
  Reference out{{}, {}, {}, 0, false};
  if (!std::isfinite(start.kappa) || start.kappa == 0) return out;
  const std::vector<std::int8_t> sides(hits.size(), 0);
  const std::span<const std::int8_t> no_sides(sides);
  Group<double> group;
  GroupBuilder<double>(detector).build(std::span(&hits, 1), std::span(&no_sides, 1), group);
  const Projectile projectile = projectile_of(mass, start.kappa);
  if (detector.field.is_uniform()) {
    Tracer<double>(detector, start, mass, projectile, group).run(true);
  } else {
    Tracer<double, FieldReference>(detector, start, mass, projectile, group).run(true);
  }
  for (const GroupStep& step : group.steps) {
    for (std::int32_t s = step.first; s < step.last; ++s) {
      const Slot<double>& slot = group.slots[static_cast<std::size_t>(s)];
      if (!slot.met) continue;
      out.rows.push_back(Eigen::Map<const Vector5>(slot.row.v.data()));
      out.crossings.push_back({slot.predicted, slot.extent});
    }
    if (!step.is_slab) continue;
    const auto noise = static_cast<std::size_t>(step.noise);
    if (!group.ahead[noise]) continue;
    if (!group.dense_noise.empty()) {
      for (const Five<double>& g : group.dense_noise[noise])
        if (g[1] != 0) out.noise.push_back(Eigen::Map<const Vector5>(g.v.data()));
    } else if (group.noise[noise].dip[4] != 0)
      add_noise(group.noise[noise], detector.slabs[static_cast<std::size_t>(step.slab)].shifts, out.noise);
  }
  out.reached = static_cast<std::size_t>(group.reached[0]);
  out.stopped = group.stopped;
  return out;
}

}  // namespace cgemit
