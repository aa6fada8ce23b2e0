// The combinatorial Kalman filter: follows a seed outward through the detector and decides which hits belong
// to it.
//
// The reference is traced once; every measurement near it is a row, every scatterer a set of vectors
// (`kalman/filter.hpp`). A branch is therefore only an estimate, its covariance and a list of hits. Branches
// are compared by the logarithm of their likelihood ratio to background,
//   hit:  ln(efficiency N(residual; 0, S) / density of foreign hits),   hole:  ln(1 - efficiency).
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "kalman/filter.hpp"
#include "reconstruction/find/find.hpp"
#include "reconstruction/find/nearby.hpp"

namespace cgemit {

// A helix that a track may follow.
struct FindSeed {
  Perigee helix;
  Symmetric<double> covariance;
  std::vector<std::int32_t>
      hits;         // clusters that the track must have; others of their layer and view are not tried
  double rank = 0;  // better ones are lower
};

struct FoundTrack {
  Perigee helix;  // at the origin
  Symmetric<double> covariance;
  std::vector<std::int32_t> hits;  // from the beam line outward
  std::vector<double> gains;       // of each hit, to the score
  double score = 0, chi2 = 0;
  int across = 0, along = 0;  // measured coordinates across the beam and along it
  int plus = 0, minus = 0;    // wires of each stereo sign; counted in a chamber without axial wires alone
  int wires = 0, holes = 0;
  // Layers of wires with a hit, and those from the first to the last; from the first one of the chamber if
  // there are clusters.
  int layers = 0, spanned = 0;
  double hidden = 0;  // of these, in which a hit of something else is likely to be in the way
  bool has_gaps() const { return layers + hidden < 0.85 * spanned; }
};

class Follower {
 public:
  Follower(const Detector& detector, const FindSettings& settings);

  // Begins with the hits of another event.
  void start(const EventHits& hits);
  // Returns false where the seed leads nowhere.
  bool follow(const FindSeed& seed, FoundTrack& track);

 private:
  struct Branch {
    FilteredState<double> state;
    double score;
    std::int32_t chain;  // its last hit; -1: none
    std::int32_t hits, holes, in_row;
    std::int32_t settled;  // hits since it last had an alternative
    bool ended;
  };
  struct Link {
    std::int32_t slot, before;
    double weight;  // right minus left probability of a wire
    double gain;
  };

  // The best branch, or none if it has too few hits.
  std::optional<Branch> pass(const Perigee& start, const Symmetric<double>& prior,
                             std::span<const std::int32_t> forced, bool wide);
  bool meets_all(std::span<const std::int32_t> wanted) const;
  // Chooses the clusters of a branch anew, by its wires. Returns whether others are likelier: these are then
  // `chosen_`, and the track with them is `fitted_`.
  bool choose_clusters(const Branch& best);
  void add_wire(std::int32_t number);
  void collect_noise(const GroupStep& step);
  void add_collected_noise();
  void gap_view(const GroupStep& step, View view, std::span<const std::int32_t> forced);
  bool is_in_point(const Branch& branch, std::size_t layer);
  double pair_score(const Branch& branch, const Slot<double>& v);
  void wires(const GroupStep& step);
  void wire(Slot<double>& slot);
  void hole(Branch& branch, double penalty) const;
  void take(Branch& branch, std::int32_t slot, double residual, double total, const Five<double>& ch,
            double gain, double weight);
  void settle();
  void keep_best();
  void keep_used(const Branch& best);
  bool refit(const Branch& best, int times);
  void collect(const Branch& best, FoundTrack& track) const;
  bool is_complete(const FoundTrack& track) const;
  Slot<double>& slot(std::int32_t number) { return group_.slots[static_cast<std::size_t>(number)]; }

  const Detector& detector_;
  const FindSettings& settings_;
  Group<double> group_;
  NearbyHits nearby_;
  const EventHits* hits_ = nullptr;
  const bool stereo_only_;               // no axial wires
  const double log_found_, log_missed_;  // probabilities that a layer has its hit, or not
  // Logarithms of the density of foreign hits, in the two views of each gap, and of the efficiency over it,
  // in each layer of wires.
  std::vector<std::array<double, 2>> gap_density_;
  std::vector<double> wire_ratio_;
  std::vector<std::int32_t> fired_;         // cells of each layer when its ratio was computed
  std::optional<Symmetric<double>> noise_;  // of slabs since the last measurement
  std::vector<Branch> branches_, next_;
  std::vector<std::int32_t> order_;  // of branches, the best one first
  std::vector<Link> links_;
  std::vector<std::int32_t> last_found_;
  std::vector<std::int32_t> chosen_, before_;  // clusters
  FilteredState<double> fitted_{};
  Perigee reference_{};
};

}  // namespace cgemit
