#include "reconstruction/find/follower.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <optional>

#include "common/compiler.hpp"
#include "reconstruction/find/compete.hpp"
#include "reconstruction/find/reference_slots.hpp"
#include "reconstruction/find/score.hpp"

namespace cgemit {

namespace {

constexpr double sure = 4;        // a hit with a larger likelihood ratio is taken without another branch
constexpr double rim = 0.5;       // mm, of a cell; a track in it need not fire the cell
constexpr double inflation = 10;  // of a covariance that the same hits have made
constexpr double curved = 0.1;    // mm; a fit linear about a distant reference is off by as much
constexpr int few_hits = 2, many_hits = 10, many_wires = 20;
constexpr double good_chi2 = 1.5;  // of a hit
constexpr int most_speed_ups = 20;
constexpr double speed_up = 0.97;  // of kappa; larger steps overshoot where slow particles stop
constexpr int least_hits = 3;
constexpr double close_to_edge = 0.85;  // of half a cell
constexpr int settled_after = 10;       // hits; a worse branch does not become the best one later
constexpr double negligible = -60;      // logarithm of the likelihood of the other side of a wire
constexpr Five<double> no_prior{{1e4, 1, 100, 1e6, 25}};
// Wires, and stereo wires among them, that predict the clusters in front of them.
constexpr int enough_wires = 10, enough_along = 4;
constexpr double log_scattered = -5;      // logarithm of the probability of a scatter beyond `gate`
constexpr double near_x = 2, near_v = 6;  // mm, of other clusters from the track

// What a pass expects of a track that the same hits have made.
Symmetric<double> loosened(Symmetric<double> covariance) {
  for (double& entry : covariance.v) entry *= inflation;
  covariance(0, 0) += curved * curved;
  covariance(3, 3) += curved * curved;
  return covariance;
}

Perigee moved(const Perigee& reference, const Five<double>& x) {
  Perigee helix{reference.d + x[0], wrap_angle(reference.psi + x[1]), reference.kappa + x[2],
                reference.z0 + x[3], reference.tanl + x[4]};
  if (helix.kappa == 0) helix.kappa = 1e-9;
  return helix;
}

}  // namespace

Follower::Follower(const Detector& detector, const FindSettings& settings)
    : detector_(detector),
      settings_(settings),
      nearby_(detector, group_),
      stereo_only_(std::ranges::all_of(detector.wires, [](const auto& w) { return w.twist != 0; })),
      log_found_(std::log(settings.efficiency)),
      log_missed_(std::log1p(-settings.efficiency)),
      gap_density_(detector.layers.size()),
      wire_ratio_(detector.wires.size()),
      fired_(detector.wires.size(), -1) {}

void Follower::start(const EventHits& hits) {
  hits_ = &hits;
  for (std::size_t i = 0; i < gap_density_.size(); ++i)
    gap_density_[i] = {std::log(hits.density(i, View::x)), std::log(hits.density(i, View::v))};
  for (std::size_t i = 0; i < wire_ratio_.size(); ++i) {
    if (hits.fired(i) == fired_[i]) continue;  // as in the last event
    fired_[i] = hits.fired(i);
    wire_ratio_[i] = std::log(settings_.efficiency / hits.density(i, View::wire));
  }
}

bool Follower::follow(const FindSeed& seed, FoundTrack& track) {
  last_found_.clear();
  Perigee start = seed.helix;
  Symmetric<double> prior = seed.covariance;
  std::span<const std::int32_t> forced = seed.hits;
  for (int number = 0; number < settings_.passes; ++number) {
    const std::optional<Branch> best = pass(start, prior, forced, number == 0);
    if (best && number + 1 < settings_.passes && choose_clusters(*best)) {
      start = moved(reference_, fitted_.x);
      prior = loosened(fitted_.c);
      forced = chosen_;
      continue;
    }
    if (!best || best->score < hopeless - most_prompt ||
        !refit(*best, number == 0 && !forced.empty() ? 1 : 2)) {
      if (track.hits.empty()) return false;
      break;  // about a reference that stops: the track of the pass before stays
    }
    collect(*best, track);
    if (track.score < hopeless) return false;
    // The reference was good enough if a second pass has changed next to nothing. Gaps may close with a
    // better one; those of a few hits that chance explains are not worth it.
    const auto n = static_cast<int>(track.hits.size()), more = n - static_cast<int>(last_found_.size());
    const bool is_open = track.has_gaps() && (n >= many_hits || track.score > per_hit * n);
    if (is_complete(track) || track.hits == last_found_ ||
        (number > 0 && std::abs(more) <= few_hits && !is_open))
      break;
    last_found_ = track.hits;
    start = track.helix;
    prior = loosened(track.covariance);
    forced = {};
  }
  return std::abs(track.helix.d) <= settings_.max_d && std::abs(track.helix.z0) <= settings_.max_z;
}

// Whether another pass would find the same hits: they reach from the first to the last layer and fit well,
// and the reference was at most a cell away from the track, so that the cells beside it were seen.
bool Follower::is_complete(const FoundTrack& track) const {
  if (track.spanned < static_cast<int>(detector_.wires.size()) || track.wires < many_wires ||
      track.has_gaps() || track.chi2 > good_chi2 * static_cast<double>(track.hits.size()))
    return false;
  std::size_t clusters = 0;
  for (const GroupStep& step : group_.steps) {
    if (!nearby_.expects(step)) continue;
    const auto slab = static_cast<std::size_t>(step.slab);
    const MeasuringLayer& layer = detector_.layers[static_cast<std::size_t>(detector_.slabs[slab].gap)];
    clusters += (layer.has_x ? 1 : 0) + (layer.has_v ? 1 : 0);
  }
  if (track.hits.size() < clusters + static_cast<std::size_t>(track.wires)) return false;
  return std::ranges::all_of(group_.slots, [this](const Slot<double>& s) {
    if (s.view != View::wire) return true;
    const WireLayer& layer = detector_.wires[static_cast<std::size_t>(s.layer)];
    return std::abs(dot(s.row, fitted_.x)) < 2 * pi * layer.r_end / layer.cells;
  });
}

// One pass outward about `start`.
auto Follower::pass(const Perigee& start, const Symmetric<double>& prior,
                    std::span<const std::int32_t> forced, bool wide) -> std::optional<Branch> {
  reference_ = start;
  // A circle through the hits has the momentum after some of the loss; with that at the origin, the particle
  // may stop before its last hits.
  for (int time = 0; time < most_speed_ups; ++time) {
    nearby_.begin(*hits_, wide);
    trace_nearby(detector_, reference_, settings_, group_, nearby_);
    // A particle that stops behind its last hit may do so.
    if (!group_.stopped || meets_all(forced.empty() ? std::span<const std::int32_t>(last_found_) : forced))
      break;
    reference_.kappa *= speed_up;
  }
  for (Slot<double>& s : group_.slots) s.met = s.met && s.there;
  links_.clear();
  noise_.reset();
  branches_.assign(1, {{Five<double>::zero(), prior, 0}, 0, -1, 0, 0, 0, 0, false});
  for (const GroupStep& step : group_.steps) {
    if (!step.is_slab) {
      wires(step);
      continue;
    }
    const Slab& slab = detector_.slabs[static_cast<std::size_t>(step.slab)];
    if (slab.gap >= 0) {
      gap_view(step, View::x, forced);
      gap_view(step, View::v, forced);
    }
    collect_noise(step);
  }
  const auto best = std::ranges::max_element(branches_, {}, &Branch::score);
  return best->hits >= least_hits ? std::optional(*best) : std::nullopt;
}

// Whether the reference passes all of some hits; false without any.
bool Follower::meets_all(std::span<const std::int32_t> wanted) const {
  std::size_t met = 0;
  for (const Slot<double>& s : group_.slots)
    if (s.met && s.hit[0] >= 0 && std::ranges::find(wanted, s.hit[0]) != wanted.end()) ++met;
  return met > 0 && met >= wanted.size();
}

// Outward, a foreign cluster in the first layer misleads those behind it, and the next pass expects it, since
// its hits have made the prior. Inward, the wires predict the clusters, which then have no part in it.
bool Follower::choose_clusters(const Branch& best) {
  before_.clear();
  int wires = 0, along = 0;
  for (std::int32_t at = best.chain; at >= 0; at = links_[static_cast<std::size_t>(at)].before) {
    const Link& link = links_[static_cast<std::size_t>(at)];
    Slot<double>& there = slot(link.slot);
    if (there.view != View::wire) {
      before_.push_back(there.hit[0]);
      continue;
    }
    there.used = true;
    there.weight = link.weight;
    measure(detector_, settings_, there);
    ++wires;
    along += detector_.wires[static_cast<std::size_t>(there.layer)].twist != 0 ? 1 : 0;
  }
  if (wires < enough_wires || along < enough_along) return false;
  // Without other clusters near the track, there is nothing to choose.
  const auto near = std::ranges::count_if(group_.slots, [&](const Slot<double>& s) {
    if (s.view == View::wire || !s.met) return false;
    const double off = s.drift - s.predicted - dot(s.row, best.state.x);
    return std::abs(off) < (s.view == View::x ? near_x : near_v) ||
           std::ranges::find(before_, s.hit[0]) != before_.end();
  });
  if (near == static_cast<std::ptrdiff_t>(before_.size())) return false;
  noise_.reset();
  branches_.assign(
      1, {{Five<double>::zero(), Symmetric<double>::diagonal(no_prior), 0}, 0, -1, 0, 0, 0, 0, false});
  for (std::size_t i = group_.steps.size(); i-- > 0;) {
    const GroupStep& step = group_.steps[i];
    if (!step.is_slab) {
      for (std::int32_t s = step.last; s-- > step.first;)
        if (slot(s).used) add_wire(s);
      continue;
    }
    const Slab& slab = detector_.slabs[static_cast<std::size_t>(step.slab)];
    collect_noise(step);
    if (slab.gap < 0) continue;
    gap_view(step, View::x, {});
    gap_view(step, View::v, {});
  }
  add_collected_noise();
  // The particle may come from behind the layers that it misses last.
  const Branch* chosen = nullptr;
  double most = 0;
  for (const Branch& branch : branches_) {
    const double score =
        branch.score - branch.in_row * log_missed_ +
        log_prompt(moved(reference_, branch.state.x), branch.state.c, settings_.max_d, settings_.max_z);
    if (chosen != nullptr && !(score > most)) continue;
    chosen = &branch;
    most = score;
  }
  chosen_.clear();
  for (std::int32_t at = chosen->chain; at >= 0; at = links_[static_cast<std::size_t>(at)].before)
    chosen_.push_back(slot(links_[static_cast<std::size_t>(at)].slot).hit[0]);
  fitted_ = chosen->state;
  std::ranges::sort(before_);
  std::ranges::sort(chosen_);
  return before_ != chosen_ && sound(fitted_) && positive_definite(fitted_.c);
}

// A wire of the track, for all branches.
void Follower::add_wire(std::int32_t number) {
  add_collected_noise();
  const Slot<double>& wire = slot(number);
  for (Branch& branch : branches_) {
    const Five<double> ch = branch.state.c * wire.row;
    const double total = dot(wire.row, ch) + wire.variance,
                 residual = wire.residual - dot(wire.row, branch.state.x), per = 1 / total;
    branch.state.x = branch.state.x + (residual * per) * ch;
    branch.state.c.add([&](auto i, auto j) { return -per * ch[i] * ch[j]; });
    branch.score += log_gaussian(residual * residual * per, total);
    ++branch.hits;
    branch.in_row = 0;
  }
}

// The noise of slabs adds up, until the next measurement needs the covariances of the branches.
void Follower::collect_noise(const GroupStep& step) {
  const bool shifts = detector_.slabs[static_cast<std::size_t>(step.slab)].shifts;
  const auto number = static_cast<std::size_t>(step.noise);
  if (!noise_) noise_ = Symmetric<double>::diagonal(Five<double>::zero());
  if (group_.dense)
    add_noise(*noise_, group_.dense_noise[number], shifts);
  else
    add_noise(*noise_, group_.noise[number], shifts);
}

void Follower::add_collected_noise() {
  if (!noise_) return;
  for (Branch& branch : branches_)
    for (std::size_t i = 0; !branch.ended && i < noise_->v.size(); ++i) branch.state.c.v[i] += noise_->v[i];
  noise_.reset();
}

// Whether the branch has the X of a point in this layer, whose V should follow.
bool Follower::is_in_point(const Branch& branch, std::size_t layer) {
  if (branch.chain < 0) return false;
  const Slot<double>& x = slot(links_[static_cast<std::size_t>(branch.chain)].slot);
  return x.view == View::x && static_cast<std::size_t>(x.layer) == layer && hits_->is_of_point(x.hit[0]);
}

// How well a V cluster fits the X cluster that the branch has in the same layer. The V of a point is not
// taken without its X: a foreign V is more often near by chance than a foreign point.
double Follower::pair_score(const Branch& branch, const Slot<double>& v) {
  if (branch.chain >= 0) {
    const Slot<double>& x = slot(links_[static_cast<std::size_t>(branch.chain)].slot);
    if (x.view == View::x && x.layer == v.layer) return hits_->pair_score(x.hit[0], v.hit[0]);
  }
  return hits_->is_of_point(v.hit[0]) ? PairScores::impossible : 0;
}

// Each branch takes one of the clusters of a view, or none.
CGEMIT_FLATTEN void Follower::gap_view(const GroupStep& step, View view,
                                       std::span<const std::int32_t> forced) {
  std::int32_t only = -1;
  for (std::int32_t s = step.first; s < step.last; ++s) {
    if (slot(s).view != view) continue;
    slot(s).variance = variance_of(detector_, settings_, slot(s));
    if (std::ranges::find(forced, slot(s).hit[0]) != forced.end()) only = s;
  }
  const auto layer = static_cast<std::size_t>(detector_.slabs[static_cast<std::size_t>(step.slab)].gap);
  const double log_density = gap_density_[layer][view == View::x ? 0 : 1];
  next_.clear();
  add_collected_noise();
  for (const Branch& branch : branches_) {
    const bool tries = !branch.ended;
    for (std::int32_t s = step.first; tries && s < step.last; ++s) {
      const Slot<double>& there = slot(s);
      if (there.view != view || !there.met || (only >= 0 && s != only)) continue;
      const Five<double> ch = branch.state.c * there.row;
      const double total = dot(there.row, ch) + there.variance;
      const double residual = there.drift - there.predicted - dot(there.row, branch.state.x);
      const double chi2 = residual * residual / total;
      if (only < 0 && !(chi2 < settings_.gate * settings_.gate)) continue;
      const double pair = view == View::v ? pair_score(branch, there) : 0;
      if (only < 0 && pair <= PairScores::impossible) continue;
      next_.push_back(branch);
      if (only < 0) next_.back().settled = 0;
      take(next_.back(), s, residual, total, ch, log_found_ + log_gaussian(chi2, total) - log_density + pair,
           0);
    }
    if (tries && only >= 0) continue;
    next_.push_back(branch);
    // A point far from the prediction along the beam is that of something else, or of a hard scatter.
    if (tries && view == View::v && is_in_point(branch, layer)) next_.back().score += log_scattered;
    if (tries && nearby_.expects(step) && detector_.layers[layer].has(view == View::x))
      hole(next_.back(), log_missed_);
  }
  if (next_.empty()) next_ = branches_;
  branches_.swap(next_);
  keep_best();
}

void Follower::wires(const GroupStep& step) {
  for (std::int32_t s = step.first; s < step.last; ++s) {
    if (!slot(s).met) continue;
    add_collected_noise();
    wire(slot(s));
  }
  settle();
}

// An alternative that is still worse after a number of hits is given up: later hits prefer neither.
void Follower::settle() {
  if (branches_.size() < 2) return;
  const double best = std::ranges::max_element(branches_, {}, &Branch::score)->score;
  std::erase_if(branches_, [&](const Branch& b) { return b.score < best && b.settled >= settled_after; });
}

CGEMIT_FLATTEN void Follower::wire(Slot<double>& cell) {
  const auto layer = static_cast<std::size_t>(cell.layer);
  const WireLayer& wires = detector_.wires[layer];
  const double half = pi * wires.r_end / wires.cells;
  const bool fired = cell.hit[0] >= 0;
  const auto number = static_cast<std::int32_t>(&cell - group_.slots.data());
  const double gate = settings_.gate;
  const std::size_t branches = branches_.size();
  for (std::size_t i = 0; i < branches; ++i) {
    if (branches_[i].ended) continue;
    const double predicted = cell.predicted + dot(cell.row, branches_[i].state.x),
                 distance = std::abs(predicted);
    if (!fired && distance >= close_to_edge * half - rim) continue;
    const Five<double> ch = branches_[i].state.c * cell.row;
    const double known = dot(cell.row, ch), spread = std::sqrt(known);
    const bool crosses = distance + 2 * spread < close_to_edge * half - rim;
    if (!fired) {
      if (crosses) hole(branches_[i], log_missed_);
      continue;
    }
    if (distance - gate * spread > 1.6 * half) continue;
    const double variance = known + cell.noise;
    const double right = cell.drift - predicted, left = -cell.drift - predicted;
    const double near = std::min(std::abs(right), std::abs(left)), chi2 = near * near / variance;
    if (!(chi2 < gate * gate)) {
      // An earlier hit of something else hides the track's own; a later one does not.
      if (crosses)
        hole(branches_[i], cell.drift < distance ? std::log(hits_->occupancy(layer)) : log_missed_);
      continue;
    }
    const double other = std::max(std::abs(right), std::abs(left));
    const double log_other = 0.5 * (chi2 - other * other / variance);
    const double both = log_other < negligible ? 0 : std::log1p(std::exp(log_other));
    const double ratio = wire_ratio_[layer] + log_gaussian(chi2, variance) + both;
    if (ratio < 0) continue;
    if (ratio < sure) {
      branches_[i].settled = 0;
      branches_.push_back(branches_[i]);  // without the hit
    }
    const double weight = std::tanh(cell.drift * predicted / variance);
    const double total = known + cell.noise + (1 - weight * weight) * cell.drift * cell.drift;
    take(branches_[i], number, weight * cell.drift - predicted, total, ch, ratio, weight);
  }
  if (branches_.size() > branches) keep_best();
}

void Follower::hole(Branch& branch, double penalty) const {
  if (branch.hits == 0) return;  // the particle may come from here
  branch.score += std::max(penalty, log_missed_);
  ++branch.holes;
  branch.ended = ++branch.in_row > settings_.holes_in_row;
}

void Follower::take(Branch& branch, std::int32_t number, double residual, double total,
                    const Five<double>& ch, double gain, double weight) {
  const double per = 1 / total;
  branch.state.x = branch.state.x + (residual * per) * ch;
  branch.state.c.add([&](auto i, auto j) { return -per * ch[i] * ch[j]; });
  branch.state.chi2 += residual * residual * per;
  branch.score += gain;
  branch.in_row = 0;
  ++branch.hits;
  ++branch.settled;
  links_.push_back({number, branch.chain, weight, gain});
  branch.chain = static_cast<std::int32_t>(links_.size()) - 1;
}

// Leaves the best branches, the best one first; of equal ones the first. Beside them stays the one that has
// no hit yet: a particle that comes from farther out meets hits of others before its own.
void Follower::keep_best() {
  const auto most = static_cast<std::size_t>(settings_.branches);
  if (branches_.size() <= most) return;
  const auto score = [this](std::int32_t i) { return branches_[static_cast<std::size_t>(i)].score; };
  std::int32_t waits = -1;
  order_.clear();
  for (std::int32_t i = 0; i < static_cast<std::int32_t>(branches_.size()); ++i) {
    if (branches_[static_cast<std::size_t>(i)].hits == 0) waits = i;
    order_.insert(std::ranges::upper_bound(order_, score(i), std::greater<>(), score), i);
    if (order_.size() > most) order_.pop_back();
  }
  if (waits >= 0 && std::ranges::find(order_, waits) == order_.end()) order_.push_back(waits);
  next_.clear();
  for (const std::int32_t i : order_) next_.push_back(branches_[static_cast<std::size_t>(i)]);
  branches_.swap(next_);
}

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
  const bool on_wires =
      std::ranges::any_of(group_.slots, [](const Slot<double>& s) { return s.view == View::wire; });
  for (int time = 1; time <= times; ++time) {
    for (Slot<double>& s : group_.slots) measure(detector_, settings_, s);
    fitted_ = filter(detector_, group_, Symmetric<double>::diagonal(no_prior));
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
  track.across = track.along = track.plus = track.minus = track.wires = track.layers = 0;
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
    const double twist = s.view == View::wire ? detector_.wires[static_cast<std::size_t>(s.layer)].twist : 0;
    const bool tilted = s.view == View::v || twist != 0;
    if (stereo_only_ && twist != 0) ++(twist > 0 ? track.plus : track.minus);
    ++(tilted ? track.along : track.across);
  }
  track.spanned = highest - lowest + 1;
  track.hidden = 0;
  for (std::int32_t layer = lowest; layer <= highest; ++layer)
    track.hidden += hits_->occupancy(static_cast<std::size_t>(layer));
  std::ranges::reverse(track.hits);
  std::ranges::reverse(track.gains);
  track.helix = moved(reference_, fitted_.x);
  track.covariance = fitted_.c;
  track.score += log_prompt(track.helix, track.covariance, settings_.max_d, settings_.max_z);
}

}  // namespace cgemit
