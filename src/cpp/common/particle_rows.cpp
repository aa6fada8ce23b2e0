#include "common/particle_rows.hpp"

#include <algorithm>

namespace cgemit {

std::vector<std::int64_t> particle_rows(const NumberedRows& particles, const NumberedRows& of) {
  const std::size_t n = particles.event.size();
  std::vector<std::int64_t> rows(of.event.size(), -1);
  std::size_t begin = 0, end = 0;  // particles of the event
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const std::int64_t event = of.event[i];
    const std::int32_t wanted = of.particle[i];
    if (i > 0 && event == of.event[i - 1] && wanted == of.particle[i - 1]) {
      rows[i] = rows[i - 1];
      continue;
    }
    if (i == 0 || event != of.event[i - 1]) {
      for (begin = end; begin < n && particles.event[begin] < event;) ++begin;
      for (end = begin; end < n && particles.event[end] == event;) ++end;
    }
    // Particles are usually numbered in the order of their rows.
    const auto numbers = particles.particle.subspan(begin, end - begin);
    const auto guess = static_cast<std::size_t>(std::max(wanted, 0));
    const bool there = guess < numbers.size() && numbers[guess] == wanted;
    const auto at =
        there ? guess : static_cast<std::size_t>(std::ranges::find(numbers, wanted) - numbers.begin());
    if (at < numbers.size()) rows[i] = static_cast<std::int64_t>(begin + at);
  }
  return rows;
}

}  // namespace cgemit
