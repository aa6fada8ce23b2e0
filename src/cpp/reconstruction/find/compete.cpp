#include "reconstruction/find/compete.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace cgemit {

void Competition::settle(std::vector<FoundTrack>& tracks, std::span<const HitKind> kinds, double min_score) {
  kinds_ = kinds;
  min_score_ = min_score;
  std::erase_if(tracks, [&](const FoundTrack& track) { return !is_likely(track, min_score); });
  std::ranges::sort(tracks, [](const FoundTrack& a, const FoundTrack& b) {
    return a.score != b.score ? a.score > b.score : a.hits < b.hits;
  });
  used_.assign(kinds.size(), 0);
  gain_.resize(kinds.size());
  drop_losers(tracks);
  one_by_one(tracks);
}

// The best one first.
void Competition::one_by_one(std::vector<FoundTrack>& tracks) {
  std::size_t kept = 0;
  for (std::size_t i = 0; i < tracks.size(); ++i) {
    FoundTrack& track = tracks[i];
    const Own own = this->own(track);
    if (!keeps(track, own)) continue;
    if (own.hits < static_cast<int>(track.hits.size())) {
      std::size_t left = 0;
      for (std::size_t k = 0; k < track.hits.size(); ++k) {
        if (kinds_[static_cast<std::size_t>(track.hits[k])].wire && is_used(track.hits[k])) continue;
        track.hits[left] = track.hits[k];
        track.gains[left++] = track.gains[k];
      }
      track.hits.resize(left);
      track.gains.resize(left);
      track.across = own.across;
      track.along = own.along;
      track.plus = own.plus;
      track.minus = own.minus;
      track.wires = static_cast<int>(std::ranges::count_if(
          track.hits, [&](std::int32_t hit) { return kinds_[static_cast<std::size_t>(hit)].wire; }));
    }
    use(track, 1);
    if (kept != i) tracks[kept] = std::move(track);
    ++kept;
  }
  tracks.resize(kept);
}

// Leaves the best set of each small group: the one with the largest sum of scores, where a hit of several
// tracks counts once, with the largest of its gains, and each track has a cost.
void Competition::drop_losers(std::vector<FoundTrack>& tracks) {
  find_groups(tracks);
  loses_.assign(tracks.size(), 0);
  for (std::size_t first = 0; first < tracks.size(); ++first) {
    if (leader_[first] != first) continue;
    group_.clear();
    for (std::size_t i = first; i < tracks.size(); ++i)
      if (root(i) == first) group_.push_back(i);
    if (group_.size() < 2 || group_.size() > most_exact) continue;
    rest_.assign(group_.size() + 1, 0);
    for (std::size_t i = group_.size(); i-- > 0;)
      rest_[i] = rest_[i + 1] + std::max(0.0, tracks[group_[i]].score - cost(tracks[group_[i]]));
    best_sum_ = -std::numeric_limits<double>::infinity();
    chosen_ = best_ = 0;
    search(tracks, 0, 0);
    for (std::size_t i = 0; i < group_.size(); ++i) loses_[group_[i]] = (best_ >> i & 1) == 0 ? 1 : 0;
  }
  std::size_t number = 0;
  std::erase_if(tracks, [&](const FoundTrack&) { return loses_[number++] != 0; });
}

// Two tracks are of a group if the worse one shares more with the other than it may.
void Competition::find_groups(const std::vector<FoundTrack>& tracks) {
  entries_.clear();
  last_of_.assign(kinds_.size(), -1);
  leader_.resize(tracks.size());
  for (std::size_t i = 0; i < tracks.size(); ++i) {
    leader_[i] = i;
    shared_.assign(i, 0);
    for (const std::int32_t hit : tracks[i].hits) {
      std::int32_t& last = last_of_[static_cast<std::size_t>(hit)];
      for (std::int32_t at = last; at >= 0; at = entries_[static_cast<std::size_t>(at)].before)
        ++shared_[entries_[static_cast<std::size_t>(at)].track];
      entries_.push_back({i, last});
      last = static_cast<std::int32_t>(entries_.size() - 1);
    }
    const double most = most_shared * static_cast<double>(tracks[i].hits.size());
    for (std::size_t other = 0; other < i; ++other) {
      if (shared_[other] <= most) continue;
      const std::size_t a = root(i), b = root(other);
      leader_[std::max(a, b)] = std::min(a, b);
    }
  }
}

std::size_t Competition::root(std::size_t track) const {
  while (leader_[track] != track) track = leader_[track];
  return track;
}

// With or without the track at this place, after those chosen before. The first set tried is that of the
// tracks one by one, and another one must be better.
void Competition::search(const std::vector<FoundTrack>& tracks, std::size_t place, double sum) {
  if (sum + rest_[place] <= best_sum_) return;
  if (place == group_.size()) {
    best_sum_ = sum;
    best_ = chosen_;
    return;
  }
  const FoundTrack& track = tracks[group_[place]];
  const std::uint32_t bit = std::uint32_t{1} << place;
  if (const Own own = this->own(track); keeps(track, own)) {
    const std::size_t before = replaced_.size();
    const double worth = add(track) - cost(track);
    chosen_ |= bit;
    search(tracks, place + 1, sum + worth);
    chosen_ &= ~bit;
    remove(track, before);
  }
  search(tracks, place + 1, sum);
}

// Returns by how much the sum of scores grows.
double Competition::add(const FoundTrack& track) {
  double score = track.score;
  for (std::size_t i = 0; i < track.hits.size(); ++i) {
    double& gain = gain_[static_cast<std::size_t>(track.hits[i])];
    replaced_.push_back(gain);
    if (is_used(track.hits[i])) {
      score -= std::max(0.0, std::min(gain, track.gains[i]));
      gain = std::max(gain, track.gains[i]);
    } else {
      gain = track.gains[i];
    }
  }
  use(track, 1);
  return score;
}

void Competition::remove(const FoundTrack& track, std::size_t before) {
  use(track, -1);
  for (std::size_t i = 0; i < track.hits.size(); ++i)
    gain_[static_cast<std::size_t>(track.hits[i])] = replaced_[before + i];
  replaced_.resize(before);
}

// What a track must add to a set: that of any track, and (ln n)/2 for each of its five parameters
// (G. Schwarz, Ann. Statist. 6 (1978) 461).
double Competition::cost(const FoundTrack& track) const {
  return min_score_ + 2.5 * std::log(static_cast<double>(track.hits.size()));
}

Competition::Own Competition::own(const FoundTrack& track) const {
  Own own{track.score};
  for (std::size_t i = 0; i < track.hits.size(); ++i) {
    const HitKind kind = kinds_[static_cast<std::size_t>(track.hits[i])];
    const bool used = is_used(track.hits[i]);
    if (used)
      own.score -= track.gains[i];
    else
      ++own.hits;
    if (used && kind.wire) continue;
    ++(kind.along ? own.along : own.across);
    if (kind.sign != 0) ++(kind.sign > 0 ? own.plus : own.minus);
  }
  return own;
}

// A track of clusters alone may share more of them if the others are likely by themselves: one cluster may be
// of two tracks.
bool Competition::keeps(const FoundTrack& track, const Own& own) const {
  const auto n = static_cast<double>(track.hits.size()), shared = n - own.hits;
  const auto is_likely_alone = [&] {
    return track.wires == 0 && own.score > min_score_ + doubt + per_hit * own.hits;
  };
  if (shared > most_shared * n && !(shared <= most_shared_clusters * n && is_likely_alone())) return false;
  return is_track(own);
}

}  // namespace cgemit
