// Seeds of chambers without axial wires, from the two signs of the stereo angle.
//
// Each sign is a view (`motion/views.hpp`), in which circles are searched as among axial wires, sides
// included.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "motion/views.hpp"
#include "reconstruction/find/axial.hpp"
#include "reconstruction/find/displaced.hpp"
#include "reconstruction/find/follower.hpp"

namespace cgemit {

struct ViewSeed {
  FindSeed seed;  // the filter may take any hits; its rank is that of the pair of circles
  double radius;  // mm, of the innermost wire
  int layers;
  std::vector<std::int32_t> wires;  // near the helix
  std::array<std::size_t, 2> circles;
};

class ViewSearch {
 public:
  ViewSearch(const Detector& detector, const FindSettings& settings);

  // Seeds from wires that no track has taken: first those of the best pairs that use each circle once, the
  // best ones first. `displaced`: from anywhere, too.
  const std::vector<ViewSeed>& find(const EventHits& hits, bool displaced);
  // Whether the last search left out boxes or segments.
  bool boxes_are_cut() const { return boxes_cut_; }
  bool segments_are_cut() const { return segments_cut_; }
  // Whether circles need more layers than there are.
  bool are_too_many() const { return views_[0].hits.are_too_many() || views_[1].hits.are_too_many(); }

 private:
  struct View {
    View(const Detector& detector, const FindSettings& settings, int sign)
        : hits(detector, settings, sign), axial(detector, hits), displaced(detector, hits) {}
    AxialHits hits;
    AxialSearch axial;
    DisplacedSearch displaced;
    std::vector<FoundCircle> circles;
  };
  void assign();
  void circles(View& view, const EventHits& hits, bool displaced);
  std::optional<ViewHelix> together(const FoundCircle& a, const FoundCircle& b, const EventHits& hits) const;
  std::optional<ViewSeed> refined(ViewHelix helix, const FoundCircle& a, const FoundCircle& b,
                                  const EventHits& hits);

  const Detector& detector_;
  const FindSettings& settings_;
  std::array<View, 2> views_;             // positive and negative twist
  std::vector<std::uint8_t> of_circles_;  // of each hit, whether one of two circles has it
  std::vector<ViewSeed> seeds_, sorted_;
  std::vector<std::int32_t> pair_;     // the seed of each pair of circles, or -1
  std::vector<std::size_t> chosen_;    // seeds
  std::vector<std::uint8_t> is_used_;  // circles, then seeds
  bool boxes_cut_ = false, segments_cut_ = false;
};

}  // namespace cgemit
