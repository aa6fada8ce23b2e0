// Of tracks that share hits, the likeliest ones keep them.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "reconstruction/find/follower.hpp"

namespace cgemit {

// Enough measurements for a helix; the beam line is another one. Two wires of opposite stereo signs measure
// once across the beam.
template <class Counts>
bool is_track(const Counts& of) {
  return of.across + std::min(of.plus, of.minus) >= 3 && of.along >= 2;
}

inline constexpr double per_hit = 2.5, doubt = 4;

// Chance finds hits wherever it looks: each hit must add to the likelihood on average, and fit; and where a
// track is so uncertain that no cell must fire, half of the layers must have a hit all the same.
inline bool is_likely(const FoundTrack& track, double min_score) {
  constexpr double chi2_per_hit = 15;
  const auto n = static_cast<double>(track.hits.size());
  if (2 * track.layers < track.spanned) return false;
  const double more = track.hits.size() < 6 ? doubt : 0;
  return track.score > min_score + more + per_hit * n && track.chi2 < chi2_per_hit * n;
}

// What a hit is to the tracks that compete for it.
struct HitKind {
  bool wire;     // a cell is of one track, a cluster may be of two
  bool along;    // measures along the beam, too
  int sign = 0;  // of the stereo angle, in a chamber without axial wires
};

class Competition {
 public:
  // Groups of more tracks are settled one by one, the best first.
  static constexpr std::size_t most_exact = 12;

  // Removes tracks that share too many of their hits with others, and shared wires of those that are worse.
  // Hits of tracks are numbers of `kinds`.
  void settle(std::vector<FoundTrack>& tracks, std::span<const HitKind> kinds, double min_score);

 private:
  static constexpr double most_shared = 0.3, most_shared_clusters = 0.5;

  // What a track has by itself.
  struct Own {
    double score;
    int hits = 0;               // that no better track has
    int across = 0, along = 0;  // with shared clusters
    int plus = 0, minus = 0;    // of these, of each stereo sign
  };

  void one_by_one(std::vector<FoundTrack>& tracks);
  void drop_losers(std::vector<FoundTrack>& tracks);
  void find_groups(const std::vector<FoundTrack>& tracks);
  void search(const std::vector<FoundTrack>& tracks, std::size_t place, double sum);
  double add(const FoundTrack& track);
  void remove(const FoundTrack& track, std::size_t before);
  Own own(const FoundTrack& track) const;
  bool keeps(const FoundTrack& track, const Own& own) const;
  double cost(const FoundTrack& track) const;
  bool is_used(std::int32_t hit) const { return used_[static_cast<std::size_t>(hit)] != 0; }
  void use(const FoundTrack& track, int change) {
    for (const std::int32_t hit : track.hits) used_[static_cast<std::size_t>(hit)] += change;
  }
  std::size_t root(std::size_t track) const;

  std::span<const HitKind> kinds_;
  double min_score_ = 0;
  std::vector<std::int32_t> used_;  // tracks with each hit, of those chosen so far

  // Tracks with a hit: `last_of_` is the entry of the last one, each entry knows the one before.
  struct Entry {
    std::size_t track;
    std::int32_t before;
  };
  std::vector<Entry> entries_;
  std::vector<std::int32_t> last_of_;
  std::vector<int> shared_;              // hits with each better track
  std::vector<std::size_t> leader_;      // a track of the same group, the leader of the group its own
  std::vector<std::size_t> group_;       // numbers of its tracks, the best first
  std::vector<double> rest_;             // the most that tracks of the group from here on are worth
  std::vector<std::uint8_t> loses_;      // tracks that are not in the best set of their group
  std::uint32_t chosen_ = 0, best_ = 0;  // tracks of the group, as bits
  double best_sum_ = 0;
  std::vector<double> gain_, replaced_;  // of each hit that is used; those that a track has replaced
};

}  // namespace cgemit
