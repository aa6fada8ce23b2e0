#include "reconstruction/find/find.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "common/angles.hpp"
#include "reconstruction/find/anneal.hpp"
#include "reconstruction/find/axial.hpp"
#include "reconstruction/find/compete.hpp"
#include "reconstruction/find/displaced.hpp"
#include "reconstruction/find/segments.hpp"
#include "reconstruction/find/stereo.hpp"
#include "reconstruction/find/trace_back.hpp"
#include "reconstruction/find/views.hpp"

namespace cgemit {

namespace {

class EventFinder {
 public:
  EventFinder(const Detector& detector, const FindSettings& settings, const PairScores& pairs)
      : detector_(detector),
        settings_(settings),
        hits_(detector, pairs),
        follower_(detector, settings),
        segments_(detector, settings),
        axial_hits_(detector, settings),
        axial_(detector, axial_hits_),
        displaced_(detector, axial_hits_),
        stereo_(detector, settings),
        annealing_(detector, settings),
        single_(std::ranges::any_of(detector.layers, [](const auto& l) { return l.has_x != l.has_v; })),
        stereo_only_(!detector.wires.empty() &&
                     std::ranges::all_of(detector.wires, [](const auto& w) { return w.twist != 0; })) {
    const auto count = [&](int sign) {
      return std::ranges::count(detector.wires, sign, [](const auto& layer) { return stereo_sign(layer); });
    };
    const bool one_sign = count(0) > 0 && (count(1) == 0) != (count(-1) == 0);
    ambiguous_ = detector.wires.empty() ? single_ : one_sign && detector.layers.empty();
    if (stereo_only_ || (!detector.wires.empty() && count(0) < std::min(count(1), count(-1))))
      views_.emplace(detector, settings);
  }

  const std::vector<FoundTrack>& find(std::span<const Hit> hits, std::int64_t first) {
    hits_.load(hits, first);
    follower_.start(hits_);
    tracks_.clear();
    seeds_ = 0;
    limits_ = 0;
    stereo_.start();
    if (detector_.wires.empty() && detector_.layers.size() == 3 && !single_) {
      if (settings_.segments) from_segments();
      return tracks_;
    }
    // Combinations of clusters grow faster than circles with the number of tracks.
    const bool circles_first = settings_.chamber && is_crowded();
    if (circles_first) from_chamber();
    if (settings_.segments && detector_.layers.size() >= 3) {
      const std::int64_t before = seeds_, most = settings_.max_seeds;
      for (const FindSeed& seed : segments_.three_layers(hits_, !circles_first)) {
        if (seeds_ - before == most) {
          reach(limit_segments, true);
          break;
        }
        try_segment(seed);
      }
      reach(limit_segments, segments_.is_cut());
    }
    if (settings_.chamber && !circles_first) from_chamber();
    if (settings_.chamber && stereo_only_) from_views();
    if (settings_.segments && detector_.layers.size() >= 2) {
      const std::int64_t before = seeds_, most = settings_.max_seeds;
      for (const FindSeed& seed : segments_.two_layers(hits_)) {
        if (seeds_ - before == most) break;
        if (!is_found(seed)) try_segment(seed);
      }
      reach(limit_segments, segments_.is_cut());
    }
    settle();
    if (settings_.annealing) annealing_.share(tracks_, hits_);
    return tracks_;
  }
  const EventHits& hits() const { return hits_; }
  std::int64_t seeds() const { return seeds_; }
  std::uint8_t limits() const { return limits_; }

 private:
  void reach(SearchLimit limit, bool cut) {
    if (cut) limits_ = static_cast<std::uint8_t>(limits_ | limit);
  }

  bool is_crowded() const {
    constexpr std::size_t many_clusters = 20;  // in a layer
    std::int32_t clusters = 0;
    for (std::size_t i = 0; i < detector_.layers.size(); ++i)
      clusters += hits_.last(i, View::x) - hits_.first(i, View::x);
    return static_cast<std::size_t>(clusters) > many_clusters * detector_.layers.size();
  }

  void settle() {
    kinds_.clear();
    for (std::int32_t id = 0; id < hits_.size(); ++id) {
      const Hit& hit = hits_[id];
      const bool wire = hit.view == View::wire;
      const double twist = wire ? detector_.wires[static_cast<std::size_t>(hit.layer)].twist : 0;
      const int sign = !stereo_only_ || twist == 0 ? 0 : twist > 0 ? 1 : -1;
      kinds_.push_back({wire, wire ? twist != 0 : hit.view == View::v, sign});
    }
    competition_.settle(tracks_, kinds_, settings_.min_score);
  }

  // Segments of three layers and nothing else are tracks, the better ones first.
  void from_segments() {
    constexpr std::size_t shared_parts = 3;  // a third of the clusters may belong to better tracks
    const std::vector<FindSeed>& seeds = segments_.tracks(hits_);
    reach(limit_segments, segments_.is_cut());
    for (const FindSeed& seed : seeds) {
      if (seeds_ == settings_.max_seeds) {
        reach(limit_segments, true);
        break;
      }
      ++seeds_;
      std::size_t shared = 0;
      for (const std::int32_t id : seed.hits) shared += hits_.is_taken(id) ? 1 : 0;
      if (shared_parts * shared > seed.hits.size()) continue;
      for (const std::int32_t id : seed.hits) hits_.take(id);
      FoundTrack& track = tracks_.emplace_back();
      track.hits = seed.hits;
      track.score = -seed.rank;
      track.holes = static_cast<int>(6 - seed.hits.size());
    }
  }

  static constexpr int most_failures = 5;  // circles in a row that led to no track beyond doubt
  static constexpr int most_failures_of_clusters = 20;
  static constexpr std::size_t few_lines = 2, many_lines = 4;  // of a circle
  static constexpr int few_wires = 5;
  // A track beyond doubt has at least so many wires and coordinates along the beam, more than so many wires
  // for each hole, and a smaller chi-square per hit.
  static constexpr int many_wires = 14, many_along = 4, wires_per_hole = 4;
  static constexpr double largest_chi2 = 4;

  // A seed of which two clusters belong to a track beyond doubt is not followed, nor one that is part of a
  // track.
  void try_segment(const FindSeed& seed) {
    int taken = 0;
    for (const std::int32_t id : seed.hits) taken += hits_.is_taken(id) ? 1 : 0;
    if (taken >= 2 ||
        std::ranges::any_of(tracks_, [&](const FoundTrack& t) { return is_enough(t) && holds(t, seed); }))
      return;
    if (seed.hits.size() < 6 || std::abs(seed.helix.kappa) <= slow_kappa) {
      try_seed(seed);
      return;
    }
    // The circle through three layers has the momentum in the middle one.
    FindSeed slow = seed;
    const auto middle = static_cast<std::size_t>(hits_[seed.hits[2]].layer);
    slow.helix = trace_back(detector_, seed.helix, detector_.layers[middle].r_mid(),
                            species_of(settings_, seed.helix.kappa));
    slow.covariance(2, 2) = variance_of_kappa(slow.helix.kappa);
    try_seed(slow);
  }
  // Where no circle in the chamber leads to the wires, a track without them does not keep its clusters from
  // other seeds: the beam line gives the curvature that the clusters leave open.
  bool is_enough(const FoundTrack& track) const { return !stereo_only_ || track.wires >= few_wires; }
  // Whether two clusters belong to likely tracks.
  bool is_found(const FindSeed& seed) const {
    return std::ranges::count_if(seed.hits, [this](std::int32_t id) {
             return std::ranges::any_of(tracks_, [&](const FoundTrack& t) {
               return is_likely(t, settings_.min_score) && is_enough(t) &&
                      std::ranges::find(t.hits, id) != t.hits.end();
             });
           }) >= 2;
  }
  static bool holds(const FoundTrack& track, const FindSeed& seed) {
    return std::ranges::all_of(
        seed.hits, [&](std::int32_t id) { return std::ranges::find(track.hits, id) != track.hits.end(); });
  }

  bool try_seed(const FindSeed& seed) {
    ++seeds_;
    FoundTrack track;
    if (!follower_.follow(seed, track) || !is_track(track)) return false;
    const bool likely = is_likely(track, settings_.min_score);
    const bool solid = likely && is_solid(track);
    if (solid && !ambiguous_) take(track);
    tracks_.push_back(std::move(track));
    return solid || (single_ && likely);
  }
  static bool is_solid(const FoundTrack& track) {
    return track.wires >= many_wires && track.along >= many_along &&
           track.wires > wires_per_hole * track.holes && !track.has_gaps() &&
           track.chi2 < largest_chi2 * static_cast<double>(track.hits.size());
  }
  void take(const FoundTrack& track) {
    for (const std::int32_t id : track.hits) hits_.take(id);
  }

  void from_chamber() {
    if (views_ && !stereo_only_) from_views();
    axial_hits_.load(hits_);
    reach(limit_layers, axial_hits_.are_too_many());
    // Tracks that are found leave fewer hits, among which a circle needs fewer layers.
    for (int least = 0; axial_hits_.least(0) != least; axial_hits_.load(hits_)) {
      least = axial_hits_.least(0);
      axial_.start();
      follow_circles(axial_, true);
      reach(limit_boxes, axial_.is_cut());
      if (!ambiguous_) continue;
      settle();
      for (const FoundTrack& track : tracks_)
        if (is_solid(track)) take(track);
    }
    if (single_) {  // anew: clusters of a circle without a track may be of others
      axial_hits_.load(hits_);
      for (const FoundTrack& track : tracks_)
        if (is_likely(track, settings_.min_score)) axial_hits_.leave_out(track.hits);
    }
    displaced_.start(hits_);
    reach(limit_local, displaced_.is_cut());
    follow_circles(displaced_, false);
    reach(limit_heights, stereo_.is_cut());
  }

  // Tracks that are found leave fewer hits, among which others are seen.
  void from_views() {
    constexpr int most_rounds = 8;
    int followed = 0;
    bool displaced = false;
    for (int round = 0; round < most_rounds; ++round) {
      const std::vector<ViewSeed>& seeds = views_->find(hits_, displaced);
      reach(limit_boxes, views_->boxes_are_cut());
      reach(limit_local, views_->segments_are_cut());
      reach(limit_layers, views_->are_too_many());
      bool any = false;
      int failures = 0;
      for (const ViewSeed& seed : seeds) {
        constexpr std::size_t taken_parts = 3;  // a third of the wires may belong to better tracks
        const auto taken = static_cast<std::size_t>(
            std::ranges::count_if(seed.wires, [this](std::int32_t id) { return hits_.is_taken(id); }));
        if (taken_parts * taken > seed.wires.size()) continue;
        if (++followed > settings_.max_seeds || failures == most_failures) {
          reach(limit_circles, followed > settings_.max_seeds);
          reach(limit_failures, failures == most_failures);
          break;
        }
        ++failures;
        FindSeed first = seed.seed;
        if (std::abs(first.helix.kappa) > slow_kappa) before_loss(seed.radius, first);
        if (!try_seed(first)) continue;
        failures = 0;
        any = true;
      }
      if (any) continue;
      if (displaced) return;
      displaced = true;
    }
  }

  template <class Search>
  void follow_circles(Search& search, bool bend) {
    const bool of_clusters = single_ && !bend;
    const int most = of_clusters ? most_failures_of_clusters : most_failures;
    int failures = 0;
    for (int n = 0; n < settings_.max_seeds && failures < most; ++n) {
      const auto circle = search.next();
      if (!circle) return;
      ++failures;
      for (const FoundLine& line : stereo_.find(*circle, hits_, ambiguous_ ? many_lines : few_lines, bend)) {
        if (!try_seed(seed_of(bent(*circle, line), line))) continue;
        failures = 0;
        if (!ambiguous_) break;
      }
      if (of_clusters && failures > 0) axial_hits_.leave_out(circle->hits, false);
      reach(limit_circles, n + 1 == settings_.max_seeds);
      reach(limit_failures, failures == most);
    }
  }

  // The circle with the curvature of a line.
  static FoundCircle bent(FoundCircle circle, const FoundLine& line) {
    if (line.dw == 0) return circle;
    const CircleSlope slope(circle);
    circle.d += slope.d * line.dw;
    circle.psi = wrap_angle(circle.psi + slope.psi * line.dw);
    circle.w += line.dw;
    return circle;
  }

  // The search has seen the hits already, and neglects scattering and loss.
  FindSeed seed_of(const FoundCircle& circle, const FoundLine& line) const {
    const double per_kappa = curvature(detector_.bz, 1.0), kappa = circle.w / per_kappa;
    FindSeed seed{{circle.d, circle.psi, kappa == 0 ? 1e-9 : kappa, line.z0, line.tanl}, {}, {}};
    Symmetric<double>& c = seed.covariance;
    c = Symmetric<double>::diagonal(Five<double>::zero());
    constexpr double caution = 6;
    c(0, 0) = caution * circle.covariance[0] + 0.1;
    c(0, 1) = caution * circle.covariance[1];
    c(0, 2) = caution * circle.covariance[2] / per_kappa;
    c(1, 1) = caution * circle.covariance[3] + 1e-6 * (1 + kappa * kappa);
    c(1, 2) = caution * circle.covariance[4] / per_kappa;
    c(2, 2) = caution * circle.covariance[5] / (per_kappa * per_kappa) + 4e-4 * kappa * kappa;
    c(3, 3) = caution * line.covariance[0] + 4;
    c(3, 4) = caution * line.covariance[1];
    c(4, 4) = caution * line.covariance[2] + 1e-6 * (1 + kappa * kappa);
    if (std::abs(kappa) <= slow_kappa) return seed;
    const auto on_wire =
        std::ranges::find_if(circle.hits, [this](std::int32_t id) { return hits_[id].view == View::wire; });
    if (on_wire != circle.hits.end())
      before_loss(detector_.wires[static_cast<std::size_t>(hits_[*on_wire].layer)].r_end, seed);
    return seed;
  }

  // The circle of a slow particle in the chamber is that after the loss in front of it.
  void before_loss(double radius, FindSeed& seed) const {
    const double kappa = seed.helix.kappa;
    seed.helix = trace_back(detector_, seed.helix, radius, species_of(settings_, kappa));
    const double lost = seed.helix.kappa - kappa;
    // How much, depends on the particle.
    seed.covariance(0, 0) += 9;
    seed.covariance(1, 1) += 1e-3;
    seed.covariance(2, 2) += lost * lost;
  }

  const Detector& detector_;
  const FindSettings& settings_;
  EventHits hits_;
  Follower follower_;
  SegmentFinder segments_;
  AxialHits axial_hits_;
  AxialSearch axial_;
  DisplacedSearch displaced_;
  StereoSearch stereo_;
  std::optional<ViewSearch> views_;
  std::vector<HitKind> kinds_;
  Competition competition_;
  Annealing annealing_;
  bool single_;  // whether there are layers of one coordinate, which make no segments
  bool stereo_only_;
  // Layers of one coordinate each, or axial wires and stereo wires of one sign: the measurements of another
  // track are a line in z, too, elsewhere. Several lines are followed, and the tracks of a circle compete.
  bool ambiguous_ = false;
  std::vector<FoundTrack> tracks_;
  std::int64_t seeds_ = 0;
  std::uint8_t limits_ = 0;
};

}  // namespace

FindOutput find_tracks(const Detector& detector, const FindInput& input, const FindSettings& settings) {
  FindOutput out;
  out.offsets.push_back(0);
  EventFinder finder(detector, settings, input.pairs);
  for (std::size_t event = 0; event + 1 < input.offsets.size() && !input.interrupted(); ++event) {
    const auto first = static_cast<std::size_t>(input.offsets[event]),
               last = static_cast<std::size_t>(input.offsets[event + 1]);
    for (const FoundTrack& track :
         finder.find(input.hits.subspan(first, last - first), input.offsets[event])) {
      out.event.push_back(static_cast<std::int64_t>(event));
      for (const std::int32_t hit : track.hits) out.hits.push_back(finder.hits().source(hit));
      out.offsets.push_back(static_cast<std::int64_t>(out.hits.size()));
      out.score.push_back(track.score);
      out.chi2.push_back(track.chi2);
      out.holes.push_back(track.holes);
    }
    out.seeds.push_back(finder.seeds());
    out.limits.push_back(finder.limits());
  }
  return out;
}

}  // namespace cgemit
