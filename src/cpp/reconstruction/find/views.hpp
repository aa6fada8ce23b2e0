// Seeds of chambers without axial wires, from the two signs of the stereo angle.
//
// A wire turns about the beam line by t z, with t = tan(twist/2)/half length. Where it is at z = 0 it has,
// seen along a helix, the azimuth phi - t z: a circle again to a few millimetres, since z grows linearly with
// the arc. So each sign is a view of its own, in which circles are searched as among axial wires, sides
// included. Two circles, one of each view, that belong together are half of their sum and half of their
// difference: the azimuth and the height of a helix at each radius.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

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
    std::vector<double> radii, turns;  // of its layers: mm, and turning per height, 1/mm
    double turn(double r) const;
  };
  struct Helix {
    double d, psi, w, z0, tanl;
  };
  struct Point {
    double x, y, z;
  };

  void assign();
  void circles(View& view, const EventHits& hits, bool displaced);
  std::optional<Helix> together(const FoundCircle& a, const FoundCircle& b, const EventHits& hits) const;
  std::optional<Point> between(const FoundCircle& a, const FoundCircle& b, double r) const;
  std::optional<ViewSeed> refined(Helix helix, const FoundCircle& a, const FoundCircle& b,
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
