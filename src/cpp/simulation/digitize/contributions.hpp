// Charges that truths leave on strips, and the digis that they add up to.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "detector/detector.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/strips.hpp"

namespace cgemit {

// The contribution of one truth to one strip.
struct Contribution {
  std::int32_t gid, layer, sheet;
  std::int8_t view;
  std::int32_t strip;
  double charge, time;
  std::int64_t truth;
};

inline void append(const MeasuringLayer& layer, const Contribution& each, StripRange range,
                   std::vector<Contribution>& out) {
  const int sheet_first = layer.gid_first + each.sheet * (layer.strips_x + layer.strips_v);
  const int view_first = sheet_first + (each.view == 0 ? 0 : layer.strips_x);
  for (int strip = range.first; strip <= range.last; ++strip) {
    out.push_back(
        {view_first + strip, each.layer, each.sheet, each.view, strip, each.charge, each.time, each.truth});
  }
}

// The contributions of an event, listed by truth.
class Contributions {
 public:
  std::vector<Contribution> parts;

  // Appends the digis that `accept` takes; it may change them.
  template <class Accept>
  void write(std::int64_t event, Columns<DigiRow>& digis, Accept&& accept) {
    order_.clear();
    for (const Contribution& part : parts)
      order_.push_back(static_cast<std::uint64_t>(part.gid) << 32 | order_.size());
    // Without delta electrons they are in order already.
    if (!std::ranges::is_sorted(order_)) std::ranges::sort(order_);
    for (std::size_t first = 0, last; first < order_.size(); first = last) {
      last = first + 1;
      while (last < order_.size() && order_[last] >> 32 == order_[first] >> 32) ++last;
      DigiRow& digi = digis.next();
      sum_up(event, std::span(order_).subspan(first, last - first), digi);
      if (accept(digi)) digis.keep();
    }
  }

 private:
  const Contribution& part(std::uint64_t place) const { return parts[place & 0xFFFFFFFF]; }

  // Makes the digi of a strip.
  void sum_up(std::int64_t event, std::span<const std::uint64_t> places, DigiRow& digi) const {
    const Contribution& first = part(places.front());
    digi.event = event;
    digi.layer = first.layer;
    digi.sheet = first.sheet;
    digi.view = first.view;
    digi.strip = first.strip;
    digi.gid = first.gid;
    digi.charge = 0;
    digi.time = first.time;
    digi.n_truths = 0;
    double of_truth = 0, largest = -1;
    std::int64_t before = -1;
    for (const std::uint64_t place : places) {
      const Contribution& one = part(place);
      const bool new_truth = one.truth != before;
      before = one.truth;
      digi.n_truths += new_truth;
      of_truth = one.charge + (new_truth ? 0 : of_truth);
      if (of_truth > largest) {
        largest = of_truth;
        digi.truth = one.truth;
      }
      digi.charge += one.charge;
      digi.time = std::min(digi.time, one.time);
    }
  }

  std::vector<std::uint64_t> order_;  // strip, then number in `parts`
};

}  // namespace cgemit
