#include "reconstruction/find/anneal.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <tuple>

#include "kalman/filter.hpp"
#include "reconstruction/find/compete.hpp"
#include "reconstruction/find/reference_slots.hpp"

namespace cgemit {

namespace {

constexpr std::array<double, 3> temperatures{9, 3, 1};
constexpr int beside = 2;              // cells between tracks that may share one
constexpr double least_weight = 1e-3;  // a hit with less does not take part
constexpr Five<double> prior{{1e4, 1, 100, 1e6, 25}};

}  // namespace

void Annealing::share(std::vector<FoundTrack>& tracks, const EventHits& hits) {
  if (tracks.size() < 2 || !find_neighbours(tracks, hits)) return;
  while (paths_.size() < tracks.size()) paths_.push_back(std::make_unique<Path>(detector_));
  open_.assign(tracks.size(), 0);
  for (std::size_t i = 0; i < tracks.size(); ++i)
    open_[i] = neighbour_[i] != 0 && trace(i, tracks[i], hits) ? 1 : 0;
  find_claims(tracks.size());
  if (claims_.empty()) return;
  for (const double temperature : temperatures) {
    weigh(temperature);
    for (std::size_t i = 0; i < tracks.size(); ++i)
      if (open_[i] != 0) fit(*paths_[i]);
  }
  weigh(temperatures.back());
  move(tracks);
}

// Marks tracks with a hit few cells from one of another track, in the same layer.
bool Annealing::find_neighbours(const std::vector<FoundTrack>& tracks, const EventHits& hits) {
  owner_.assign(static_cast<std::size_t>(hits.size()), -1);
  for (std::size_t i = 0; i < tracks.size(); ++i)
    for (const std::int32_t id : tracks[i].hits)
      if (hits[id].view == View::wire) owner_[static_cast<std::size_t>(id)] = static_cast<std::int32_t>(i);
  neighbour_.assign(tracks.size(), 0);
  bool any_two = false;
  for (std::size_t i = 0; i < tracks.size(); ++i) {
    for (const std::int32_t id : tracks[i].hits) {
      if (hits[id].view != View::wire) continue;
      const auto layer = static_cast<std::size_t>(hits[id].layer);
      const std::int64_t cells = detector_.wires[layer].cells;
      for (int k = 1; k <= beside; ++k) {  // the other direction is that of the other track
        const std::int32_t other = hits.at(layer, (hits[id].channel + k) % cells);
        if (other < 0 || owner(other) < 0 || owner(other) == static_cast<std::int32_t>(i)) continue;
        neighbour_[i] = neighbour_[static_cast<std::size_t>(owner(other))] = 1;
        any_two = true;
      }
    }
  }
  return any_two;
}

// Fits a track to its own hits about its helix, and predicts the hits of others near it. False where the
// reference does not meet all of its own: then they stay.
bool Annealing::trace(std::size_t number, const FoundTrack& track, const EventHits& hits) {
  Path& path = *paths_[number];
  Group<double>& group = path.group;
  path.nearby.begin(hits, false, true);
  trace_nearby(detector_, track.helix, settings_, group, path.nearby);
  std::int32_t kept = 0;
  std::size_t own = 0;
  path.weight.clear();
  for (GroupStep& step : group.steps) {
    const std::int32_t first = kept;
    for (std::int32_t s = step.first; s < step.last; ++s) {
      Slot<double>& slot = group.slots[static_cast<std::size_t>(s)];
      if (!slot.met || !slot.there || slot.hit[0] < 0) continue;
      const bool is_own = std::ranges::find(track.hits, slot.hit[0]) != track.hits.end();
      const bool of_other = slot.view == View::wire && owner(slot.hit[0]) >= 0;
      if (!is_own && !of_other) continue;
      own += is_own ? 1 : 0;
      path.weight.push_back(is_own ? 1 : 0);
      if (slot.view == View::wire) slot.weight = slot.predicted > 0 ? 1 : -1;
      if (s != kept) group.slots[static_cast<std::size_t>(kept)] = slot;
      ++kept;
    }
    step.first = first;
    step.last = kept;
  }
  group.slots = group.slots.first(static_cast<std::size_t>(kept));
  path.chi2.assign(path.weight.size(), 0);
  fit(path);
  fit(path);  // with the sides of the first one
  return own == track.hits.size();
}

// Fits a track to its hits by their weights: chi-square of each one to the track without it.
void Annealing::fit(Path& path) const {
  for (std::size_t i = 0; i < path.weight.size(); ++i) {
    Slot<double>& slot = path.group.slots[i];
    measure(detector_, settings_, slot);
    slot.used = path.weight[i] > least_weight;
    if (slot.used) slot.variance /= path.weight[i];
  }
  filter(detector_, path.group, Symmetric<double>::diagonal(prior));
  smooth(path.group, false);
  for (std::size_t i = 0; i < path.weight.size(); ++i) {
    Slot<double>& slot = path.group.slots[i];
    if (slot.view != View::wire) continue;
    const double known = std::max(slot.unbiased_variance - slot.variance, 0.0);
    const double predicted = slot.value - slot.unbiased, variance = known + slot.noise;
    const double near = std::abs(predicted) - slot.drift;
    path.chi2[i] = near * near / variance;
    slot.weight = std::tanh(slot.drift * predicted / variance);
  }
}

// Hits that belong to a track whose hits may move, and that fit another such track, too.
void Annealing::find_claims(std::size_t tracks) {
  claims_.clear();
  for (std::size_t i = 0; i < tracks; ++i) {
    if (open_[i] == 0) continue;
    const Path& path = *paths_[i];
    for (std::size_t s = 0; s < path.weight.size(); ++s) {
      const Slot<double>& slot = path.group.slots[s];
      if (slot.view != View::wire || open_[static_cast<std::size_t>(owner(slot.hit[0]))] == 0) continue;
      if (path.weight[s] == 1 || path.chi2[s] < settings_.gate * settings_.gate)
        claims_.push_back({slot.hit[0], i, s});
    }
  }
  std::ranges::sort(claims_, [](const Claim& a, const Claim& b) {
    return std::tuple(a.hit, a.track, a.slot) < std::tuple(b.hit, b.track, b.slot);
  });
  std::size_t kept = 0;
  for (std::size_t i = 0, next = 0; i < claims_.size(); i = next) {
    while (next < claims_.size() && claims_[next].hit == claims_[i].hit) ++next;
    if (next - i == 1) continue;
    for (std::size_t k = i; k < next; ++k) claims_[kept++] = claims_[k];
  }
  claims_.resize(kept);
}

void Annealing::weigh(double temperature) {
  const double none = std::exp(-0.5 * settings_.gate * settings_.gate / temperature);
  for (std::size_t i = 0, next = 0; i < claims_.size(); i = next) {
    double sum = none;
    for (; next < claims_.size() && claims_[next].hit == claims_[i].hit; ++next) {
      Path& path = *paths_[claims_[next].track];
      double& weight = path.weight[claims_[next].slot];
      weight = std::exp(-0.5 * path.chi2[claims_[next].slot] / temperature);
      sum += weight;
    }
    for (std::size_t k = i; k < next; ++k) paths_[claims_[k].track]->weight[claims_[k].slot] /= sum;
  }
}

// Gives each hit to the track with the largest weight, if the other track can do without it.
void Annealing::move(std::vector<FoundTrack>& tracks) {
  const auto weight = [this](const Claim& c) { return paths_[c.track]->weight[c.slot]; };
  for (std::size_t i = 0, next = 0; i < claims_.size(); i = next) {
    const Claim* best = nullptr;
    const auto from = static_cast<std::size_t>(owner(claims_[i].hit));
    double own = 0;
    for (; next < claims_.size() && claims_[next].hit == claims_[i].hit; ++next) {
      if (claims_[next].track == from) own = weight(claims_[next]);
      if (best == nullptr || weight(claims_[next]) > weight(*best)) best = &claims_[next];
    }
    if (best->track == from || weight(*best) <= own) continue;
    FoundTrack& loser = tracks[from];
    FoundTrack& winner = tracks[best->track];
    const std::int32_t hit = best->hit;
    const Slot<double>& slot = paths_[best->track]->group.slots[best->slot];
    const double twist = detector_.wires[static_cast<std::size_t>(slot.layer)].twist;
    const bool by_sign = loser.plus + loser.minus > 0;
    const auto count = [&](FoundTrack& track, int change) {
      (twist != 0 ? track.along : track.across) += change;
      if (by_sign) (twist > 0 ? track.plus : track.minus) += change;
      track.wires += change;
    };
    count(loser, -1);
    if (!is_track(loser)) {
      count(loser, 1);
      continue;
    }
    count(winner, 1);
    std::erase(loser.hits, hit);
    owner_[static_cast<std::size_t>(hit)] = static_cast<std::int32_t>(best->track);
    insert(winner, hit, best->track, best->slot);
  }
}

// Behind the hits that the track passes before.
void Annealing::insert(FoundTrack& track, std::int32_t hit, std::size_t number, std::size_t slot) const {
  const auto& slots = paths_[number]->group.slots;
  auto at = track.hits.begin();
  for (std::size_t s = slot; s-- > 0;) {
    const auto before = std::ranges::find(track.hits, slots[s].hit[0]);
    if (before == track.hits.end()) continue;
    at = before + 1;
    break;
  }
  track.hits.insert(at, hit);
}

}  // namespace cgemit
