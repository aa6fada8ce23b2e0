// Charges that truths leave on strips, and the digis that they add up to.
#pragma once

#include <algorithm>
#include <cstdint>
#include <tuple>
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

  auto order() const { return std::tuple(gid, truth); }
};

inline void append(const MeasuringLayer& layer, Contribution strip, StripRange range,
                   std::vector<Contribution>& out) {
  const int sheet_first = layer.gid_first + strip.sheet * (layer.strips_x + layer.strips_v);
  const int view_first = sheet_first + (strip.view == 0 ? 0 : layer.strips_x);
  for (strip.strip = range.first; strip.strip <= range.last; ++strip.strip) {
    strip.gid = view_first + strip.strip;
    out.push_back(strip);
  }
}

// The digi of the contributions [begin, end) to one strip, ordered by truth.
inline DigiRow digi_of(std::int64_t event, const Contribution* begin, const Contribution* end) {
  double charge = 0, time = begin->time, of_truth = 0, largest = -1;
  std::int64_t truth = -1;
  std::int32_t n_truths = 0;
  for (const Contribution* part = begin; part != end; ++part) {
    const bool new_truth = part == begin || part->truth != (part - 1)->truth;
    n_truths += new_truth;
    of_truth = part->charge + (new_truth ? 0 : of_truth);
    if (of_truth > largest) {
      largest = of_truth;
      truth = part->truth;
    }
    charge += part->charge;
    time = std::min(time, part->time);
  }
  DigiRow digi{event, begin->layer, begin->sheet, begin->view, begin->strip, begin->gid};
  digi.charge = charge;
  digi.time = time;
  digi.truth = truth;
  digi.n_truths = n_truths;
  return digi;
}

// Sorts the contributions of an event and appends its digis that `accept` takes; it may change them.
template <class Accept>
void write_digis(std::int64_t event, std::vector<Contribution>& parts, DigiColumns& digis, Accept&& accept) {
  std::sort(parts.begin(), parts.end(), [](const auto& a, const auto& b) { return a.order() < b.order(); });
  for (std::size_t first = 0, last; first < parts.size(); first = last) {
    for (last = first + 1; last < parts.size() && parts[last].gid == parts[first].gid;) ++last;
    DigiRow digi = digi_of(event, &parts[first], parts.data() + last);
    if (accept(digi)) digis.push_back(digi);
  }
}

}  // namespace cgemit
