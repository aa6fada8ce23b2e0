#include "simulation/transport/rows.hpp"

#include <algorithm>
#include <cmath>

namespace cgemit {

void Truths::append(const ParticleNumber& who, const GapRow& row) {
  event.push_back(who.event);
  particle.push_back(who.particle);
  layer.push_back(row.layer);
  daughter.push_back(row.daughter);
  half_turn.push_back(row.half_turn);
  entry_x.push_back(row.entry.x);
  entry_y.push_back(row.entry.y);
  entry_z.push_back(row.entry.z);
  exit_x.push_back(row.exit.x);
  exit_y.push_back(row.exit.y);
  exit_z.push_back(row.exit.z);
  r.push_back(row.middle.radius());
  phi.push_back(std::atan2(row.middle.y, row.middle.x));
  z.push_back(row.middle.z);
  const double pt = row.momentum / std::sqrt(1 + row.middle.tanl * row.middle.tanl);
  px.push_back(pt * row.middle.ux);
  py.push_back(pt * row.middle.uy);
  pz.push_back(pt * row.middle.tanl);
  path.push_back(row.path);
  time.push_back(row.time);
  energy.push_back(row.left.energy);
  secondaries.push_back(static_cast<std::uint8_t>(std::min(row.left.deltas, 255)));
}

void Steps::append(const ParticleNumber& who, std::int32_t in_layer, const Deposit& deposit,
                   std::int64_t in_truth) {
  event.push_back(who.event);
  particle.push_back(who.particle);
  layer.push_back(in_layer);
  x.push_back(deposit.x);
  y.push_back(deposit.y);
  z.push_back(deposit.z);
  dx.push_back(deposit.dx);
  dy.push_back(deposit.dy);
  dz.push_back(deposit.dz);
  energy.push_back(deposit.energy);
  electrons.push_back(deposit.electrons);
  parent.push_back(deposit.delta > 0 ? 1 : 0);
  delta.push_back(deposit.delta);
  truth.push_back(in_truth);
}

void Decays::append(const Daughter& one, std::int32_t number) {
  event.push_back(one.of.event);
  particle.push_back(one.of.particle);
  daughter.push_back(number);
  parent.push_back(one.parent);
  pdg.push_back(one.pdg);
  mode.push_back(one.mode);
  x.push_back(one.at.position.x);
  y.push_back(one.at.position.y);
  z.push_back(one.at.position.z);
  time.push_back(one.time);
  parent_px.push_back(one.at.momentum.x);
  parent_py.push_back(one.at.momentum.y);
  parent_pz.push_back(one.at.momentum.z);
  px.push_back(one.momentum.x);
  py.push_back(one.momentum.y);
  pz.push_back(one.momentum.z);
  status.push_back(static_cast<std::int8_t>(one.status));
}

}  // namespace cgemit
