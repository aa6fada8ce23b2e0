#include "simulation/digitize/induced.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <span>
#include <tuple>
#include <vector>

#include "common/rng.hpp"
#include "detector/strip_maps.hpp"

namespace cgemit {
namespace {

constexpr double counts = 30;                 // ADC counts per fC
constexpr double delay_spread = 30;           // ns, standard deviation
constexpr std::uint32_t first_block = 65536;  // of the random numbers of a strip, behind those of its noise

DigiRow row_of(const DigiColumns& digis, std::size_t i) {
  return {digis.event[i],    digis.layer[i],  digis.sheet[i], digis.view[i],  digis.strip[i],   digis.gid[i],
          digis.position[i], digis.charge[i], digis.time[i],  digis.truth[i], digis.n_truths[i]};
}

bool of_one_view(const DigiRow& a, const DigiRow& b) {
  return std::tie(a.event, a.layer, a.sheet, a.view) == std::tie(b.event, b.layer, b.sheet, b.view);
}

// What one strip has from its neighbours.
struct Induced {
  double charge = 0, largest = 0;  // fC, sum and largest part
  DigiRow row{};                   // of the strip that induced the largest part, moved here
};

// By strip, from the digis of one view of a sheet.
std::map<std::int32_t, Induced> induced_by(std::span<const DigiRow> rows, const CgemLayer& layer,
                                           const Stream& stream) {
  std::map<std::int32_t, Induced> found;
  const int strips = rows.front().view == 0 ? layer.strips_x : layer.strips_v;
  for (const DigiRow& row : rows) {
    const Block words =
        stream.block(Purpose::readout_strip, static_cast<std::uint32_t>(row.gid), first_block);
    for (const std::size_t side : {0U, 1U}) {
      const int step = side == 0 ? -1 : 1, strip = row.strip + step;
      if (strip < 0 || strip >= strips) continue;
      if (open_unit(words[2 * side]) > induced_probability(row.charge)) continue;
      Induced& here = found[strip];
      const double part = induced_share(row.charge) * row.charge;
      here.charge += part;
      if (part <= here.largest) continue;
      here.largest = part;
      here.row = row;
      here.row.strip = strip;
      here.row.gid += step;
      here.row.time +=
          induced_delay(row.charge) + delay_spread * normal_quantile(open_unit(words[2 * side + 1]));
    }
  }
  return found;
}

}  // namespace

double induced_probability(double charge) {
  const double q = counts * charge;
  const double percent = -9.428 + q * (0.1063 + q * (-2.091e-4 + q * (2.015e-7 - 5.479e-11 * q)));
  return std::clamp(percent, 0.0, 100.0) / 100;
}

double induced_share(double charge) {
  const double q = counts * charge;
  const double percent =
      std::exp(1.363 + 5.104e-4 * q) + std::exp(3.386 - 2.523e-3 * q) + std::exp(8.683 - 0.02639 * q);
  return std::min(percent, 50.0) / 100;
}

double induced_delay(double charge) {
  const double q = counts * charge;
  return -(5.708 + q * (0.04036 + q * (-3.24e-5 + 6.657e-9 * q)));
}

DigiColumns with_induced(const Detector& detector, const DigiColumns& digis, const InducedCharge& model) {
  DigiColumns out;
  std::vector<DigiRow> rows;
  for (std::size_t begin = 0; begin < digis.event.size();) {
    rows.clear();
    for (std::size_t i = begin; i < digis.event.size(); ++i) {
      const DigiRow row = row_of(digis, i);
      if (!rows.empty() && !of_one_view(rows.front(), row)) break;
      rows.push_back(row);
    }
    begin += rows.size();
    const Stream stream(model.seed, static_cast<std::uint64_t>(rows.front().event), 0);
    auto induced = induced_by(rows, detector.cgem[static_cast<std::size_t>(rows.front().layer)], stream);
    for (DigiRow& row : rows) {
      if (const auto here = induced.find(row.strip); here != induced.end()) {
        row.charge = std::min(row.charge + here->second.charge, model.saturation);
        induced.erase(here);
      }
    }
    const double threshold = model.threshold[static_cast<std::size_t>(rows.front().view)];
    for (auto& [strip, here] : induced) {
      if (here.charge <= threshold) continue;
      here.row.charge = std::min(here.charge, model.saturation);
      rows.push_back(here.row);
    }
    std::ranges::sort(rows, {}, &DigiRow::strip);
    for (const DigiRow& row : rows) out.push_back(row);
  }
  return out;
}

}  // namespace cgemit
