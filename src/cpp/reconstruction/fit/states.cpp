#include "reconstruction/fit/states.hpp"

#include <algorithm>
#include <cmath>

namespace cgemit {

namespace {

// `matter_p`: momentum in matter, GeV/c; 0: that of the helix.
PropagationContext context_of(const Detector& detector, const Perigee& helix, double mass, double charge,
                              double matter_p) {
  const double of_helix = charge * std::sqrt(1 + helix.tanl * helix.tanl) / std::abs(helix.kappa);
  const Kinematics start(matter_p > 0 ? matter_p : of_helix, species_of(mass, charge, helix.kappa));
  return {mass, charge, track_matter(detector, helix.tanl, start), LocalMotion(detector)};
}

class States {
 public:
  States(const Detector& detector, const FittedTrack& track, StateSpace& space)
      : detector_(detector),
        track_(track),
        trajectory_(space.trajectory),
        inward_(space.inward),
        smoothed_(space.smoothed),
        context_(context_of(detector, track.reference, track.mass, track.charge, track.matter_p)) {
    follow(detector, track.reference, species_of(track.mass, track.charge, track.reference.kappa),
           track.matter_p, track.hits, track.kinks, trajectory_);
    for (const Station& station : trajectory_.stations) {
      if (station.hit < 0) continue;
      const auto i = static_cast<std::size_t>(station.hit);
      TrajectoryTerm& row = trajectory_.terms[station.term];
      row.used = track.used[i].used != 0;
      row.variance = track.used[i].variance;
      row.value = track.used[i].value - trajectory_.predicted[i];
    }
    filter_inward(trajectory_.terms, track.prior, inward_);
    smooth();
  }

  void append(const Target& target, std::vector<TrackState>& out) const {
    switch (target.surface) {
      case StateSurface::origin:
      case StateSurface::beam_line:
        out.push_back(closest(target.surface == StateSurface::beam_line));
        break;
      case StateSurface::cylinder:
        out.push_back(on_cylinder(target));
        break;
      case StateSurface::hit:
        for (std::size_t i = 0; i < track_.hits.size(); ++i) out.push_back(at_hit(i));
    }
  }

 private:
  static TrackState empty(StateStatus status) { return {status, -1, {}, 0, 0}; }

  bool is_slab(std::size_t k) const { return trajectory_.stations[k].slab != nullptr; }
  const Slab& slab(std::size_t k) const { return *trajectory_.stations[k].slab; }

  // The noise vectors of the slab at a station.
  std::span<const TrajectoryTerm> noise(std::size_t k) const {
    const std::size_t first = trajectory_.stations[k].term, end = trajectory_.stations[k + 1].term;
    return std::span(trajectory_.terms).subspan(first, end - first);
  }

  // The filtered state from all hits, before each station.
  void smooth() {
    smoothed_.assign(trajectory_.stations.size(), inward_.front());
    for (std::size_t k = 0; k + 1 < smoothed_.size(); ++k)
      smoothed_[k + 1] = is_slab(k) ? beyond(k, 1.0) : smoothed_[k];
  }
  OriginState beyond(std::size_t k, double part) const {
    return smooth_outward(smoothed_[k], inward_[trajectory_.stations[k + 1].term], noise(k), part);
  }

  LocalState local(const Station& station, const OriginState& estimate) const {
    const Vector5 moved = station.jacobian * estimate.x;
    const HelixPoint& p = station.point;
    const Perigee helix{moved[0], std::atan2(p.uy, p.ux) + moved[1], station.kappa + moved[2], moved[3],
                        p.tanl + moved[4]};
    // On the reference kappa grows as the momentum in matter falls.
    const double matter_p = track_.matter_p * std::abs(track_.reference.kappa / station.kappa);
    return {p.x, p.y, p.z, helix, station.jacobian * estimate.c * station.jacobian.transpose(), matter_p};
  }

  TrackState closest(bool moves_pivot) const {
    const OriginState& estimate = smoothed_.front();
    const Perigee& r = track_.reference;
    const Vector5& x = estimate.x;
    TrackState found{StateStatus::ok,
                     -1,
                     {0,
                      0,
                      0,
                      {r.d + x[0], r.psi + x[1], r.kappa + x[2], r.z0 + x[3], r.tanl + x[4]},
                      estimate.c,
                      track_.matter_p},
                     0,
                     0};
    if (moves_pivot) found.status = context_.motion.to_track(found.state);
    return found;
  }

  // Between the slabs, the state of the nearest station that is still on the outward part of the track.
  TrackState on_cylinder(const Target& target) const {
    std::size_t end = 0;
    while (end + 1 < smoothed_.size() && !(is_slab(end) && slab(end).r_out > target.radius)) ++end;
    if (end + 1 == smoothed_.size()) return beyond_the_end(target);
    TrackState found{StateStatus::ok, -1, {}, 0, 0};
    const double part = slab(end).r_in < target.radius ? target.share : 0.0;
    OriginState estimate = beyond(end, part);
    if (part > 0) estimate.x += known_noise(noise(end));  // relative to the reference before the slab
    found.state = local(trajectory_.stations[end], estimate);
    if (part > 0 && !cross(found.state, slab(end), part, context_, true, false))
      return empty(StateStatus::stopped);
    found.status = context_.motion.to_cylinder(found.state, target.radius);
    return found;
  }

  // Past the last slab that the fit needed. Only the stations before the turning point have a trajectory.
  TrackState beyond_the_end(const Target& target) const {
    const auto& stations = trajectory_.stations;
    std::size_t first = stations.size() - 1;
    while (first > 0 && !is_slab(first - 1)) --first;
    std::size_t k = stations.size() - 1;
    while (k > first && !(stations[k].point.outward() > 0)) --k;
    if (!(stations[k].point.outward() > 0)) return empty(StateStatus::does_not_reach);
    TrackState found{StateStatus::ok, -1, local(stations[k], smoothed_[k]), 0, 0};
    for (std::size_t i = first_surface_beyond(); i < detector_.surfaces.size(); ++i) {
      const Surface& surface = detector_.surfaces[i];
      if (!surface.is_slab) continue;
      const Slab& next = detector_.slabs[static_cast<std::size_t>(surface.index)];
      if (next.r_in >= target.radius) break;
      if (std::ranges::find(stations, &next, &Station::slab) != stations.end()) continue;
      const double part = next.r_out <= target.radius ? 1.0 : target.share;
      const StateStatus status =
          traverse(found.state, std::min(next.radius, target.radius), next, part, context_, true);
      if (status != StateStatus::ok) return empty(status);
    }
    found.status = context_.motion.to_cylinder(found.state, target.radius);
    return found;
  }

  // The position of the last hit. The matter inside it has acted, and perhaps the gap itself.
  std::size_t first_surface_beyond() const {
    const auto last = std::ranges::find_if(trajectory_.stations.rbegin(), trajectory_.stations.rend(),
                                           [](const Station& station) { return station.hit >= 0; });
    if (last == trajectory_.stations.rend()) return 0;
    const Hit& hit = track_.hits[static_cast<std::size_t>(last->hit)];
    const bool wire = hit.view == View::wire;
    const auto holds = [&](const Surface& surface) {
      const auto index = static_cast<std::size_t>(surface.index);
      return surface.is_slab != wire && (wire ? surface.index : detector_.slabs[index].gap) == hit.layer;
    };
    return static_cast<std::size_t>(std::ranges::find_if(detector_.surfaces, holds) -
                                    detector_.surfaces.begin());
  }

  TrackState at_hit(std::size_t i) const {
    TrackState found = empty(StateStatus::does_not_reach);
    found.hit = static_cast<std::int32_t>(i);
    const auto at = std::ranges::find(trajectory_.stations, found.hit, &Station::hit);
    if (at == trajectory_.stations.end()) return found;
    const OriginState& estimate = smoothed_[static_cast<std::size_t>(at - trajectory_.stations.begin())];
    found.state = local(*at, estimate);
    const Hit& hit = track_.hits[i];
    if (hit.view == View::wire) {
      const auto layer = static_cast<std::size_t>(hit.layer), wire = static_cast<std::size_t>(hit.channel);
      found.status = context_.motion.to_wire(found.state, detector_.wires[layer].placed[wire]);
    } else {
      found.status = context_.motion.to_cylinder(found.state, at->point.radius());
    }
    if (found.status != StateStatus::ok) return found;
    const TrajectoryTerm& row = trajectory_.terms[at->term];
    found.residual = row.value - row.h.dot(estimate.x);
    // A hit that was used is correlated with the track.
    const double of_track = row.h.dot(estimate.c * row.h);
    found.variance = row.used ? row.variance - of_track : row.variance + of_track;
    return found;
  }

  const Detector& detector_;
  const FittedTrack& track_;
  ReferenceTrajectory& trajectory_;
  std::vector<OriginState>&inward_, &smoothed_;
  PropagationContext context_;
};

}  // namespace

void fitted_states(const Detector& detector, const FittedTrack& track, std::span<const Target> targets,
                   StateSpace& space, std::vector<TrackState>& out) {
  const States states(detector, track, space);
  for (const Target& target : targets) states.append(target, out);
}

StateStatus extrapolate(const Detector& detector, LocalState& state, double mass, double charge,
                        double radius, double from, double to) {
  const PropagationContext context = context_of(detector, state.helix, mass, charge, state.matter_p);
  const StateStatus begun = context.motion.to_track(state);
  if (begun != StateStatus::ok) return begun;
  const double start = std::hypot(state.x, state.y);
  const bool outward = radius > start;
  const double low = std::min(start, radius), high = std::max(start, radius);
  const double at_low = outward ? from : to, at_high = outward ? to : from;
  const std::size_t n = detector.slabs.size();
  for (std::size_t i = 0; i < n; ++i) {
    const Slab& slab = detector.slabs[outward ? i : n - 1 - i];
    if (slab.r_out <= low || slab.r_in >= high) continue;
    const double part = (slab.r_out > high ? at_high : 1.0) - (slab.r_in < low ? at_low : 0.0);
    const StateStatus status =
        traverse(state, std::clamp(slab.radius, low, high), slab, part, context, outward);
    if (status != StateStatus::ok) return status;
  }
  return context.motion.to_cylinder(state, radius);
}

}  // namespace cgemit
