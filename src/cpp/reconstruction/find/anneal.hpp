// Cells that two tracks cross: the hit is that of the track that it fits better, whatever the other hits of
// both are worth.
//
// A cell measures the first of two tracks only. Each hit near several tracks belongs to track i with weight
//   w_i = exp(-chi2_i/2T) / (exp(-gate^2/2T) + sum_k exp(-chi2_k/2T)),
// chi2_i to the track without this hit, fitted to all of its hits by their weights, at falling temperatures T
// (the multitrack filter: A. Strandlie and R. Fruehwirth, CPC 133 (2000) 34). In the end the hit is of the
// track with the largest weight.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "reconstruction/find/event_hits.hpp"
#include "reconstruction/find/find.hpp"
#include "reconstruction/find/follower.hpp"
#include "reconstruction/find/nearby.hpp"

namespace cgemit {

class Annealing {
 public:
  Annealing(const Detector& detector, const FindSettings& settings)
      : detector_(detector), settings_(settings) {}

  // Tracks of an event, none of which has a wire hit of another.
  void share(std::vector<FoundTrack>& tracks, const EventHits& hits);

 private:
  // A track with its own hits and those wire hits of others that it may have.
  struct Path {
    explicit Path(const Detector& detector) : nearby(detector, group) {}
    Group<double> group;
    NearbyHits nearby;
    std::vector<double> chi2, weight;  // of each slot
  };
  // A hit near several tracks: the slot of each.
  struct Claim {
    std::int32_t hit;
    std::size_t track, slot;
  };

  bool find_neighbours(const std::vector<FoundTrack>& tracks, const EventHits& hits);
  bool trace(std::size_t number, const FoundTrack& track, const EventHits& hits);
  void fit(Path& path) const;
  void find_claims(std::size_t tracks);
  void weigh(double temperature);
  void move(std::vector<FoundTrack>& tracks);
  void insert(FoundTrack& track, std::int32_t hit, std::size_t number, std::size_t slot) const;
  std::int32_t owner(std::int32_t hit) const { return owner_[static_cast<std::size_t>(hit)]; }

  const Detector& detector_;
  const FindSettings& settings_;
  std::vector<std::int32_t> owner_;      // track of each hit, or -1
  std::vector<std::uint8_t> neighbour_;  // whether a track runs beside another
  std::vector<std::uint8_t> open_;       // whether hits of a track may move
  std::vector<std::unique_ptr<Path>> paths_;
  std::vector<Claim> claims_;
};

}  // namespace cgemit
