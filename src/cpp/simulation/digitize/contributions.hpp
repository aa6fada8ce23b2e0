// Charges that truths leave on strips, and the digis that they add up to.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "readout/strip_maps.hpp"
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

// The contributions of an event; those of a truth come one after the other.
class Contributions {
 public:
  void clear() {
    parts_.clear();
    first_ = 0;
  }

  // Adds charge to each strip of a range.
  void add(const MeasuringLayer& layer, Contribution each, StripRange range) {
    if (parts_.empty() || parts_.back().truth != each.truth) first_ = parts_.size();
    each.strip = range.first;
    each.gid = gid_of(layer, each.sheet, each.view, each.strip);
    for (; each.strip <= range.last; ++each.strip, ++each.gid) {
      // A delta electron fires a few strips many times.
      const auto own = std::find_if(parts_.begin() + static_cast<std::ptrdiff_t>(first_), parts_.end(),
                                    [&](const Contribution& part) { return part.gid == each.gid; });
      if (own == parts_.end())
        parts_.push_back(each);
      else
        own->charge += each.charge;
    }
  }

  // Appends the digis that `accept` takes; it may change them.
  template <class Accept>
  void write(std::int64_t event, Columns<DigiRow>& digis, Accept&& accept) {
    order_.clear();
    for (const Contribution& part : parts_)
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
  const Contribution& part(std::uint64_t place) const { return parts_[place & 0xFFFFFFFF]; }

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
    digi.n_truths = static_cast<std::int32_t>(places.size());
    double largest = -1;
    for (const std::uint64_t place : places) {
      const Contribution& one = part(place);
      if (one.charge > largest) {
        largest = one.charge;
        digi.truth = one.truth;
      }
      digi.charge += one.charge;
      digi.time = std::min(digi.time, one.time);
    }
  }

  std::vector<Contribution> parts_;
  std::size_t first_ = 0;             // where those of the last truth begin
  std::vector<std::uint64_t> order_;  // strip, then number in `parts_`
};

}  // namespace cgemit
