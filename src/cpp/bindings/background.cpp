#include "simulation/background/background.hpp"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <tuple>

#include "bindings/arrays.hpp"
#include "readout/strip_maps.hpp"

namespace py = pybind11;
using namespace cgemit;
using namespace cgemit::bindings;

namespace {

// `end`: of the running numbers, which begin at `begin`.
HotChannels hot_channels(const Array<std::int32_t>& gids, const Array<double>& fires, int begin, int end) {
  const auto gid = column(gids, "hot");
  for (const std::int32_t one : gid) {
    if (one < begin || one >= end) throw std::invalid_argument("hot: channel " + std::to_string(one));
  }
  return {gid, column(fires, "hot_fires", gids.shape(0))};
}

py::dict noisy_cells(const Detector& detector, const Array<std::int64_t>& events, const Array<double>& begins,
                     const Array<double>& lengths, double window, const Array<std::int32_t>& hot,
                     const Array<double>& hot_fires, std::uint64_t seed) {
  const bool is_empty = detector.wires.empty();
  const int begin = is_empty ? 0 : detector.wires.front().gid_first;
  const int end = is_empty ? 0 : detector.wires.back().gid_first + detector.wires.back().cells;
  const auto event = column(events, "events");
  const CellNoise noise{.begins = column(begins, "begins", static_cast<py::ssize_t>(detector.wires.size())),
                        .lengths = column(lengths, "lengths"),
                        .window = window,
                        .hot = hot_channels(hot, hot_fires, begin, end),
                        .seed = seed};
  NoisyCells found;
  {
    py::gil_scoped_release release;
    found = background_cells(detector, event, noise);
  }
  return to_dict(std::move(found));
}

py::dict noisy_strips(const Detector& detector, const Array<std::int64_t>& events,
                      const Array<double>& clusters, int most_strips, const Array<double>& single,
                      std::array<double, 2> charge, std::array<double, 2> noise_charge, double window,
                      const Array<std::int32_t>& hot, const Array<double>& hot_fires, std::uint64_t seed) {
  const auto event = column(events, "events");
  const auto layers = static_cast<py::ssize_t>(detector.layers.size());
  const StripNoise noise{.clusters = column(clusters, "clusters", layers),
                         .most_strips = most_strips,
                         .single = column(single, "single", 2 * layers),
                         .charge = charge,
                         .noise = noise_charge,
                         .window = window,
                         .hot = hot_channels(hot, hot_fires, 0, strips_of(detector)),
                         .seed = seed};
  NoisyStrips found;
  {
    py::gil_scoped_release release;
    found = background_strips(detector, event, noise);
  }
  return to_dict(std::move(found));
}

std::tuple<py::array_t<std::int64_t>, py::array_t<std::int64_t>> channel_order(
    const Array<std::int64_t>& events, const Array<std::int32_t>& gids, const Array<double>& times) {
  const auto event = column(events, "event");
  const auto gid = column(gids, "gid", events.shape(0));
  const auto time = column(times, "time", events.shape(0));
  ChannelOrder order;
  {
    py::gil_scoped_release release;
    order = by_channel(event, gid, time);
  }
  return {to_numpy(std::move(order.rows)), to_numpy(std::move(order.first))};
}

}  // namespace

void bind_background(py::module_& module) {
  module.def("background_cells", &noisy_cells, py::arg("detector"), py::arg("events"), py::kw_only(),
             py::arg("begins"), py::arg("lengths"), py::arg("window"), py::arg("hot"), py::arg("hot_fires"),
             py::arg("seed"), "Columns of wire hits that fire without a particle of the event.");
  module.def("background_strips", &noisy_strips, py::arg("detector"), py::arg("events"), py::kw_only(),
             py::arg("clusters"), py::arg("most_strips"), py::arg("single"), py::arg("charge"),
             py::arg("noise_charge"), py::arg("window"), py::arg("hot"), py::arg("hot_fires"),
             py::arg("seed"), "Columns of digis that fire without a particle of the event.");
  module.def("by_channel", &channel_order, py::arg("event"), py::arg("gid"), py::arg("time"),
             "Rows in the order of event, channel and time, and where in it each channel begins.");
}
