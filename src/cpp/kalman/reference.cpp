#include "kalman/reference.hpp"

#include <cmath>

#include "kalman/builder.hpp"
#include "kalman/field_reference.hpp"

namespace cgemit {

namespace {

// Noise vectors, and the kinks in units of them.
class Vectors {
 public:
  explicit Vectors(Reference& out) : out_(out) {}

  template <class Noise>
  void add(const Noise& noise, const Kink<double>& kink, bool shifts) {
    if (noise.dip[4] == 0) return;
    const auto [turn, dip] = in_noise_units(kink);
    add(noise.turn, turn);
    add(noise.dip, dip);
    add(noise.straggling, 0);
    if (!shifts) return;
    add(noise.shift_across, 0);
    add(noise.shift_along, 0);
  }

 private:
  template <class G>
  void add(const G& g, double units) {
    out_.noise.push_back(vector5(g));
    out_.noise_units.push_back(units);
  }
  Reference& out_;
};

}  // namespace

Reference trace(const Detector& detector, const Perigee& start, double mass, std::span<const Hit> hits,
                std::span<const double> kinks) {
  Reference out{{}, {}, {}, {}, 0, false};
  if (!std::isfinite(start.kappa) || start.kappa == 0) return out;
  const std::vector<std::int8_t> sides(hits.size(), 0);
  const std::span<const std::int8_t> no_sides(sides);
  Group<double> group;
  GroupBuilder<double>(detector).build(std::span(&hits, 1), std::span(&no_sides, 1), group);
  set_kinks(group, kinks);
  const Projectile projectile = projectile_of(mass, start.kappa);
  if (detector.field.is_uniform()) {
    Tracer<double>(detector, start, mass, projectile, group).run(true);
  } else {
    Tracer<double, FieldReference<double>>(detector, start, mass, projectile, group).run(true);
  }
  Vectors vectors(out);
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
    const Kink<double>& kink = group.kinks[noise];
    const bool shifts = detector.slabs[static_cast<std::size_t>(step.slab)].shifts;
    if (!group.dense_noise.empty()) {
      vectors.add(group.dense_noise[noise], kink, shifts);
    } else {
      vectors.add(group.noise[noise], kink, shifts);
    }
  }
  out.reached = static_cast<std::size_t>(group.reached[0]);
  out.stopped = group.stopped;
  return out;
}

}  // namespace cgemit
