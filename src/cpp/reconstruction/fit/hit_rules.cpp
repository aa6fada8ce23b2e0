#include "reconstruction/fit/hit_rules.hpp"

namespace cgemit {

HitRules::HitRules(const Detector& detector) : cgem_(detector.cgem.size()) {
  for (std::size_t i = 0; i < detector.cgem.size(); ++i)
    cgem_[i] = {static_cast<int>(i), detector.cgem[i].sheets, -1};
  std::vector<std::size_t> number_of(detector.wires.size());
  for (std::size_t i = 0; i < detector.wires.size(); ++i) {
    number_of[i] = static_cast<std::size_t>(detector.wires[i].number);
    if (number_of[i] >= wires_.size()) wires_.resize(number_of[i] + 1);
    wires_[number_of[i]] = {static_cast<int>(i), detector.wires[i].cells, -1};
  }
  int surface = 0;
  for (const Surface& at : detector.surfaces) {
    const auto i = static_cast<std::size_t>(at.index);
    if (!at.is_slab) wires_[number_of[i]].surface = surface;
    const int gap = at.is_slab ? detector.slabs[i].gap : -1;
    if (gap >= 0) cgem_[static_cast<std::size_t>(gap)].surface = surface;
    ++surface;
  }
}

void HitRules::explain(const HitView& hits, std::size_t i, Problems& problems) const {
  const std::uint8_t kind = hits.kind[i];
  const bool wire = kind == static_cast<std::uint8_t>(View::wire), x = kind == 0;
  const std::string where = hits.row.empty()
                                ? "hit " + std::to_string(i)
                                : (wire ? "wire_hits row " : "clusters row ") + std::to_string(hits.row[i]);
  const auto add = [&](const std::string& name, const std::string& got, const std::string& expected) {
    problems.add(where + ": " + name + ": got " + got + ", expected " + expected);
  };
  const double value = hits.value[i], sigma = hits.sigma[i];
  const Layer& layer = layer_of(kind, hits.layer[i]);
  if (kind > static_cast<std::uint8_t>(View::wire)) {
    add("kind", std::to_string(kind), "0 (X), 1 (V) or 2 (wire)");
  } else if (layer.index < 0) {
    add("layer", std::to_string(hits.layer[i]),
        wire ? "the number of a wire layer of the detector" : "a CGEM layer of the detector");
  } else if (hits.channel[i] < 0 || hits.channel[i] >= layer.channels) {
    add(wire ? "wire" : "sheet", std::to_string(hits.channel[i]),
        "0 to " + std::to_string(layer.channels - 1) + " in layer " + std::to_string(hits.layer[i]));
  }
  if (!std::isfinite(value)) add(wire ? "drift" : x ? "x" : "v", to_text(value), "a finite number, mm");
  if (!(sigma > 0 && sigma < HUGE_VAL))
    add(wire ? "sigma" : x ? "err_x" : "err_v", to_text(sigma), "a finite number above 0, mm");
  if (hits.size[i] < 0) add("size", std::to_string(hits.size[i]), "0 or more strips");
  const int side = hits.side[i];
  if (side * side > 1) {
    add("side", std::to_string(side), "-1, 0 (unknown) or 1");
  } else if (side != 0 && value < -most_below * sigma) {
    add("drift", to_text(value), "none so far below 0 on a known side (sigma " + to_text(sigma) + ")");
  }
}

void check_hits(const HitRules& rules, const HitView& hits) {
  bool all = true;
  for (std::size_t i = 0; i < hits.kind.size(); ++i) all &= rules.fits(hits, i);
  if (all) return;
  Problems problems;
  for (std::size_t i = 0; i < hits.kind.size(); ++i)
    if (!rules.fits(hits, i)) rules.explain(hits, i, problems);
  problems.raise("hits");
}

}  // namespace cgemit
