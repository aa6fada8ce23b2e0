// Of tracks that share hits, the better ones keep them.
#pragma once

#include <algorithm>
#include <vector>

#include "find/event_hits.hpp"
#include "find/follower.hpp"

namespace cgemit {

// Enough measurements for a helix; the beam line is another one.
inline bool is_track(const FoundTrack& track) { return track.across >= 3 && track.along >= 2; }

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

class Competition {
 public:
  explicit Competition(const Detector& detector) : detector_(detector) {}

  // Removes tracks that share too many of their hits with better ones, and shared wires of the others.
  void settle(std::vector<FoundTrack>& tracks, const EventHits& hits, double min_score) {
    std::ranges::sort(tracks, [](const FoundTrack& a, const FoundTrack& b) {
      return a.score != b.score ? a.score > b.score : a.hits < b.hits;
    });
    used_.assign(static_cast<std::size_t>(hits.size()), 0);
    std::size_t kept = 0;
    for (std::size_t i = 0; i < tracks.size(); ++i) {
      FoundTrack& track = tracks[i];
      if (!is_likely(track, min_score) || !keeps(track, hits, min_score)) continue;
      for (const std::int32_t hit : track.hits) used_[static_cast<std::size_t>(hit)] = 1;
      if (kept != i) tracks[kept] = std::move(track);
      ++kept;
    }
    tracks.resize(kept);
  }

 private:
  static constexpr double most_shared = 0.3, most_shared_clusters = 0.5;

  bool keeps(FoundTrack& track, const EventHits& hits, double min_score) const {
    const auto is_used = [&](std::int32_t hit) { return used_[static_cast<std::size_t>(hit)] != 0; };
    const auto shared = static_cast<double>(std::ranges::count_if(track.hits, is_used));
    const auto n = static_cast<double>(track.hits.size());
    if (shared > most_shared * n &&
        !(shared <= most_shared_clusters * n && is_likely_alone(track, min_score)))
      return false;
    if (shared == 0) return is_track(track);
    std::erase_if(track.hits, [&](std::int32_t hit) { return hits[hit].view == View::wire && is_used(hit); });
    track.across = track.along = track.wires = 0;
    for (const std::int32_t id : track.hits) {
      const Hit& hit = hits[id];
      const bool wire = hit.view == View::wire;
      track.wires += wire ? 1 : 0;
      const bool tilted =
          wire ? detector_.wires[static_cast<std::size_t>(hit.layer)].twist != 0 : hit.view == View::v;
      ++(tilted ? track.along : track.across);
    }
    return is_track(track);
  }

  // Whether the hits that no better track has are likely by themselves; one cluster may be of two tracks.
  bool is_likely_alone(const FoundTrack& track, double min_score) const {
    double score = track.score;
    int own = 0;
    for (std::size_t i = 0; i < track.hits.size(); ++i) {
      if (used_[static_cast<std::size_t>(track.hits[i])] != 0)
        score -= track.gains[i];
      else
        ++own;
    }
    return track.wires == 0 && score > min_score + doubt + per_hit * own;
  }

  const Detector& detector_;
  std::vector<std::uint8_t> used_;
};

}  // namespace cgemit
