#include "common/rng.hpp"

#include <pybind11/native_enum.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <vector>

#include "bindings/arrays.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

py::array_t<double> draw(std::uint64_t seed, const Array<std::int64_t>& events,
                         const Array<std::int32_t>& particle, Purpose purpose,
                         const Array<std::uint32_t>& places, std::uint32_t block, bool normal) {
  const auto event = column(events, "events");
  const auto number = column(particle, "particle", events.shape(0));
  const bool is_one = places.ndim() == 0;  // the same for all
  const auto place = is_one ? std::span(places.data(), 1) : column(places, "place", events.shape(0));
  std::vector<double> values(4 * event.size());
  {
    py::gil_scoped_release release;
    for (std::size_t i = 0; i < event.size(); ++i) {
      const Stream stream(seed, static_cast<std::uint64_t>(event[i]), static_cast<std::uint32_t>(number[i]));
      const std::uint32_t at = place[is_one ? 0 : i];
      if (normal) {
        const auto four = stream.normals(purpose, at, block);
        for (std::size_t k = 0; k < 4; ++k) values[4 * i + k] = four[k];
      } else {
        const Block words = stream.block(purpose, at, block);
        for (std::size_t k = 0; k < 4; ++k) values[4 * i + k] = open_unit(words[k]);
      }
    }
  }
  return to_numpy(std::move(values), {events.shape(0), 4});
}

}  // namespace

void bind_rng(py::module_& module) {
  py::native_enum<Purpose>(module, "Purpose", "enum.IntEnum",
                           "The purpose of a random draw; part of every stream.")
      .value("gun", Purpose::gun)
      .value("scattering", Purpose::scattering)
      .value("energy_loss", Purpose::energy_loss)
      .value("digitization", Purpose::digitization)
      .value("drift_distance", Purpose::drift_distance)
      .value("fit_seed", Purpose::fit_seed)
      .value("test", Purpose::test)
      .value("ionization", Purpose::ionization)
      .value("deltas", Purpose::deltas)
      .value("radiation", Purpose::radiation)
      .value("foil", Purpose::foil)
      .value("decay", Purpose::decay)
      .value("readout_electron", Purpose::readout_electron)
      .value("readout_truth", Purpose::readout_truth)
      .value("readout_strip", Purpose::readout_strip)
      .value("half_turn", Purpose::half_turn)
      .value("background_runs", Purpose::background_runs)
      .value("background_cell", Purpose::background_cell)
      .value("background_clusters", Purpose::background_clusters)
      .value("background_noise", Purpose::background_noise)
      .value("background_strip", Purpose::background_strip)
      .value("channel_kind", Purpose::channel_kind)
      .value("mixed_event", Purpose::mixed_event)
      .value("start_time", Purpose::start_time)
      .finalize();
  module.def(
      "uniforms",
      [](std::uint64_t seed, const Array<std::int64_t>& events, const Array<std::int32_t>& particle,
         Purpose purpose, const Array<std::uint32_t>& place,
         std::uint32_t block) { return draw(seed, events, particle, purpose, place, block, false); },
      py::arg("seed"), py::arg("events"), py::arg("particle"), py::arg("purpose"), py::arg("place"),
      py::arg("block") = 0, "Four uniform numbers in (0, 1) for each (event, particle); shape (n, 4).");
  module.def(
      "normals",
      [](std::uint64_t seed, const Array<std::int64_t>& events, const Array<std::int32_t>& particle,
         Purpose purpose, const Array<std::uint32_t>& place,
         std::uint32_t block) { return draw(seed, events, particle, purpose, place, block, true); },
      py::arg("seed"), py::arg("events"), py::arg("particle"), py::arg("purpose"), py::arg("place"),
      py::arg("block") = 0, "Four standard normal numbers for each (event, particle); shape (n, 4).");
}
