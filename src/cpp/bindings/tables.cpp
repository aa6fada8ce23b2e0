// Checks of the columns of tables, in one pass each, and the memory that they come from.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cstdlib>
#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include <algorithm>
#include <optional>

#include "bindings/fields.hpp"
#include "common/particle_rows.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// First row from `row` on whose event is another one.
std::size_t skip(std::span<const std::int64_t> event, std::size_t row, std::int64_t one) {
  constexpr std::size_t block = 8;
  const auto differs = [&](std::size_t from) {  // written out: the bindings are compiled without unrolling
    const std::int64_t* e = event.data() + from;
    return ((e[0] ^ one) | (e[1] ^ one) | (e[2] ^ one) | (e[3] ^ one) | (e[4] ^ one) | (e[5] ^ one) |
            (e[6] ^ one) | (e[7] ^ one)) != 0;
  };
  while (row + block <= event.size() && !differs(row)) row += block;
  while (row < event.size() && event[row] == one) ++row;
  return row;
}

// Rows offsets[i] to offsets[i + 1] belong to event first + i; none unless the events are in order and
// `first` to first + n - 1.
std::optional<py::array_t<std::int64_t>> event_offsets(const Array<std::int64_t>& events, std::int64_t first,
                                                       std::int64_t n) {
  const auto event = column(events, "event");
  if (n < 0) throw std::invalid_argument("n: got " + std::to_string(n) + ", expected 0 or more");
  std::vector<std::int64_t> offsets(static_cast<std::size_t>(n) + 1);
  auto next = offsets.begin();
  std::int64_t last = first - 1;
  for (std::size_t row = 0; row < event.size(); row = skip(event, row, last)) {
    if (event[row] < last || event[row] < first || event[row] >= first + n) return std::nullopt;
    next = std::fill_n(next, event[row] - last, static_cast<std::int64_t>(row));
    last = event[row];
  }
  std::fill(next, offsets.end(), static_cast<std::int64_t>(event.size()));
  return to_numpy(std::move(offsets));
}

// First row that links to a row of another event or to one that is not there, -1 if there is none; negative
// links are none.
std::int64_t strange_link(const Array<std::int64_t>& links, const Array<std::int64_t>& events,
                          const Array<std::int64_t>& of_target) {
  const auto link = column(links, "links"), event = column(events, "event", links.size()),
             target = column(of_target, "target");
  for (std::size_t row = 0; row < link.size(); ++row) {
    if (link[row] < 0) continue;
    const auto to = static_cast<std::size_t>(link[row]);
    if (to >= target.size() || target[to] != event[row]) return static_cast<std::int64_t>(row);
  }
  return -1;
}

py::array_t<std::int64_t> rows_of_particles(const py::dict& particles, const py::dict& crossings) {
  Inputs of_particles(particles, "particles"), of_crossings(crossings, "crossings");
  return to_numpy(particle_rows(of_particles.read<NumberedRows>(), of_crossings.read<NumberedRows>()));
}

// Lets glibc keep the memory of a chunk of events for the next one, at once as much as it would keep by
// itself after large blocks have been freed. A page that the system gives anew costs as much as writing it
// ten times.
void keep_memory() {
#if defined(__GLIBC__)
  [[maybe_unused]] static const bool once =
      mallopt(M_MMAP_THRESHOLD, 32 << 20) != 0 && mallopt(M_TRIM_THRESHOLD, 64 << 20) != 0;
#endif
}

}  // namespace

void bind_tables(py::module_& module) {
  module.def("keep_memory", &keep_memory, "Let the process keep freed memory for the next tables.");
  module.def(
      "event_offsets", &event_offsets, py::arg("event"), py::arg("first"), py::arg("n"),
      "Where the rows of each event begin, and their number; None unless events increase in the range.");
  module.def("strange_link", &strange_link, py::arg("links"), py::arg("event"), py::arg("target"),
             "First row that links to a row of another event, or to none of the target; -1 none.");
  module.def("particle_rows", &rows_of_particles, py::arg("particles"), py::arg("crossings"),
             "Row of the particle behind each crossing; -1 none.");
}
