// The matter that particles meet which begin beside the beam line.
#pragma once

#include <map>
#include <span>
#include <vector>

#include "detector/detector.hpp"

namespace cgemit {

// The detector for the fit of particles that begin at a distance from the beam line (mm): they have not
// crossed the slabs inside of it; if the radius is negative, they flew inward first and have crossed these
// twice.
Detector beginning_at(const Detector& detector, double radius);

// The detector of each track: one for each set of slabs inside of the start radii.
class StartRadii {
 public:
  // `radii`: one for each track, or none if all begin on the beam line.
  StartRadii(const Detector& detector, std::size_t tracks, std::span<const double> radii);
  StartRadii(const StartRadii&) = delete;
  StartRadii& operator=(const StartRadii&) = delete;

  const Detector& of(std::size_t track) const { return *of_track_[track]; }
  // Number of tracks from `first` on, below `last`, that have one detector.
  std::size_t alike(std::size_t first, std::size_t last) const;

 private:
  std::map<int, Detector> begun_;
  std::vector<const Detector*> of_track_;
};

}  // namespace cgemit
