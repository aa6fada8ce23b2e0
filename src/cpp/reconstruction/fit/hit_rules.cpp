#include "reconstruction/fit/hit_rules.hpp"

namespace cgemit {

namespace {

std::string where(const HitView& hits, std::size_t i) {
  if (hits.hit.empty()) return "hit " + std::to_string(i);
  const bool wire = hits.kind[i] == static_cast<std::uint8_t>(View::wire);
  return (wire ? "wire_hits row " : "clusters row ") + std::to_string(hits.hit[i]);
}

Hit hit_of(const HitRules& rules, const HitView& hits, std::size_t i) {
  return {.view = static_cast<View>(hits.kind[i]),
          .layer = rules.index(hits.kind[i], hits.layer[i]),
          .channel = hits.channel[i],
          .size = hits.size[i],
          .value = hits.value[i],
          .sigma = hits.sigma[i],
          .k = hits.k.empty() ? 0 : hits.k[i],
          .x = hits.x.empty() ? 0 : hits.x[i]};
}

}  // namespace

HitRules::HitRules(const Detector& detector) : cgem_(detector.layers.size()) {
  for (std::size_t i = 0; i < detector.layers.size(); ++i)
    cgem_[i] = {static_cast<int>(i), detector.layers[i].sheets, -1};
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

void HitRules::explain(const HitView& hits, std::size_t i, std::vector<HitProblem>& problems) const {
  const std::uint8_t kind = hits.kind[i];
  const bool wire = kind == static_cast<std::uint8_t>(View::wire), x = kind == 0;
  const auto add = [&](std::string name, std::string got, std::string expected) {
    problems.push_back({i, std::move(name), std::move(got), std::move(expected)});
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

void copy_hits(const HitRules& rules, const HitView& hits, std::size_t first, std::size_t n,
               std::vector<Hit>& out) {
  out.resize(n);
  for (std::size_t i = 0; i < n; ++i) out[i] = hit_of(rules, hits, first + i);
}

bool copy_tracks(const HitRules& rules, const HitView& hits, std::span<const std::int64_t> offsets,
                 std::vector<Hit>& out) {
  const auto at = [&](std::size_t track) { return static_cast<std::size_t>(offsets[track]); };
  out.resize(static_cast<std::size_t>(offsets.back() - offsets.front()));
  bool fits = true;
  for (std::size_t track = 0; track + 1 < offsets.size(); ++track) {
    int last = -1;
    for (std::size_t i = at(track); i < at(track + 1); ++i) {
      const int surface = rules.surface(hits.kind[i], hits.layer[i]);
      fits &= surface >= last && rules.fits(hits, i);
      last = surface;
      out[i - at(0)] = hit_of(rules, hits, i);
    }
  }
  return fits;
}

HitProblems problems_of(const HitRules& rules, const HitView& hits) {
  HitProblems found;
  std::vector<HitProblem> of_hit;
  for (std::size_t i = 0; i < hits.kind.size(); ++i) {
    if (rules.fits(hits, i)) continue;
    of_hit.clear();
    rules.explain(hits, i, of_hit);
    found.count += of_hit.size();
    for (HitProblem& one : of_hit)
      if (found.listed.size() < Problems::most) found.listed.push_back(std::move(one));
  }
  return found;
}

void add_problems(const HitRules& rules, const HitView& hits, Problems& problems) {
  const HitProblems found = problems_of(rules, hits);
  for (const HitProblem& one : found.listed)
    problems.add(where(hits, one.hit) + ": " + one.name + ": got " + one.got + ", expected " + one.expected);
  problems.skip(found.count - found.listed.size());
}

void check_hits(const HitRules& rules, const HitView& hits) {
  bool all = true;
  for (std::size_t i = 0; i < hits.kind.size(); ++i) all &= rules.fits(hits, i);
  if (all) return;
  Problems problems;
  add_problems(rules, hits, problems);
  problems.raise("hits");
}

}  // namespace cgemit
