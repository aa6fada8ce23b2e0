#include "simulation/digitize/efficiency.hpp"

#include "common/rng.hpp"

namespace cgemit {

void seen_crossings(const Detector& detector, const TruthColumns& truths, std::span<const double> efficiency,
                    std::uint64_t seed, std::span<bool> seen) {
  check(truths, detector);
  for (std::size_t begin = 0, end; begin < truths.size(); begin = end) {
    end = event_end(truths.event, begin);
    for (std::size_t row = begin; row < end; ++row) {
      const Stream stream(seed, static_cast<std::uint64_t>(truths.event[row]),
                          static_cast<std::uint32_t>(truths.particle[row]));
      const auto place = static_cast<std::uint32_t>(truths.layer[row]);
      const Block words = stream.block(Purpose::efficiency, place, earlier(truths, begin, row));
      seen[row] = open_unit(words[0]) <= efficiency[place];
    }
  }
}

}  // namespace cgemit
