// From the best branch of a follower to the track: its hits are filtered once more, and collected.
#include <algorithm>
#include <cmath>

#include "find/follower.hpp"
#include "find/reference_slots.hpp"
#include "find/score.hpp"

namespace cgemit {

// Removes the slots of measurements that the branch does not have.
void Follower::keep_used(const Branch& best) {
  for (std::int32_t at = best.chain; at >= 0; at = links_[static_cast<std::size_t>(at)].before) {
    const Link& link = links_[static_cast<std::size_t>(at)];
    slot(link.slot).used = true;
    slot(link.slot).weight = link.weight;
  }
  std::int32_t kept = 0;
  for (GroupStep& step : group_.steps) {
    const std::int32_t first = kept;
    for (std::int32_t s = step.first; s < step.last; ++s) {
      if (!slot(s).used) continue;
      if (s != kept) slot(kept) = slot(s);
      ++kept;
    }
    step.first = first;
    step.last = kept;
  }
  group_.slots = group_.slots.first(static_cast<std::size_t>(kept));
}

// The track at the origin from all hits of a branch: the filter inward; if there are wires, as often as told,
// with their sides from the time before.
bool Follower::refit(const Branch& best, int times) {
  keep_used(best);
  const Five<double> prior{{1e4, 1, 100, 1e6, 25}};
  const bool on_wires =
      std::ranges::any_of(group_.slots, [](const Slot<double>& s) { return s.view == View::wire; });
  for (int time = 1; time <= times; ++time) {
    for (Slot<double>& s : group_.slots) measure(detector_, settings_, s);
    fitted_ = filter(detector_, group_, Symmetric<double>::diagonal(prior));
    if (!(sound(fitted_) && positive_definite(fitted_.c))) return false;
    if (time == times || !on_wires) break;
    smooth(group_, false);
    for (Slot<double>& s : group_.slots)
      if (s.view == View::wire) choose_side(s);
  }
  return true;
}

// The slots are those of the branch, one for each of its hits.
void Follower::collect(const Branch& best, FoundTrack& track) const {
  track.hits.clear();
  track.gains.clear();
  track.across = track.along = track.wires = track.layers = 0;
  std::int32_t lowest = 0, highest = -1, last = -1;  // layers of wires
  track.score = best.score;
  track.holes = best.holes;
  track.chi2 = fitted_.chi2;
  for (std::int32_t at = best.chain; at >= 0; at = links_[static_cast<std::size_t>(at)].before)
    track.gains.push_back(links_[static_cast<std::size_t>(at)].gain);
  for (std::size_t i = group_.slots.size(); i-- > 0;) {
    const Slot<double>& s = group_.slots[i];
    track.hits.push_back(s.hit[0]);
    if (s.view == View::wire) {
      ++track.wires;
      if (s.layer != last) ++track.layers;
      lowest = last = s.layer;
      highest = std::max(highest, last);
    } else {
      lowest = 0;
    }
    const bool tilted = s.view == View::v || (s.view == View::wire &&
                                              detector_.wires[static_cast<std::size_t>(s.layer)].twist != 0);
    ++(tilted ? track.along : track.across);
  }
  track.spanned = highest - lowest + 1;
  std::ranges::reverse(track.hits);
  std::ranges::reverse(track.gains);
  const Five<double>& x = fitted_.x;
  track.helix = {reference_.d + x[0], wrap_angle(reference_.psi + x[1]), reference_.kappa + x[2],
                 reference_.z0 + x[3], reference_.tanl + x[4]};
  if (track.helix.kappa == 0) track.helix.kappa = 1e-9;
  track.covariance = fitted_.c;
  track.score += log_prompt(track.helix, track.covariance, settings_.max_d, settings_.max_z);
}

}  // namespace cgemit
