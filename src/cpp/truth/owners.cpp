#include "truth/owners.hpp"

#include <algorithm>
#include <array>
#include <numeric>
#include <stdexcept>
#include <string>

#include "readout/cluster_rows.hpp"

namespace cgemit {
namespace {

constexpr std::int8_t x_view = 0, v_view = 1, xv_cluster = 2;

// The particle behind a crossing; `late`: a daughter left it; `other`: so did it, or another half turn than
// the first.
struct Owner {
  std::int64_t row = -1;
  bool late = false, other = false;
  std::int8_t half_turn = 0;
};

std::vector<Owner> owners(const NumberedRows& particles, const CrossingRows& crossings) {
  const std::vector<std::int64_t> rows = particle_rows(particles, crossings);
  std::vector<Owner> found(rows.size());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const bool late = crossings.daughter[i] > 0;
    const std::int8_t turn = crossings.half_turn[i];
    found[i] = {rows[i], late, crossings.daughter[i] != 0 || turn != 0, turn};
  }
  return found;
}

Owner behind(const std::vector<Owner>& crossings, std::int64_t link) {
  return link < 0 ? Owner{} : crossings[static_cast<std::size_t>(link)];
}

// Numbers of the hits of candidates, by candidate; none if they are in this order.
std::vector<std::size_t> by_candidate(Links candidate) {
  if (std::ranges::is_sorted(candidate)) return {};
  std::vector<std::size_t> order(candidate.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  const auto before = [&](std::size_t a, std::size_t b) { return candidate[a] < candidate[b]; };
  std::ranges::stable_sort(order, before);
  return order;
}

void check_row(std::int64_t row, std::size_t size) {
  if (row < 0 || row >= static_cast<std::int64_t>(size))
    throw std::invalid_argument("row: got " + std::to_string(row) + ", expected 0 to " +
                                std::to_string(size) + " (excluded)");
}

}  // namespace

void check_rows(const MatchInput& in) {
  for (std::size_t i = 0; i < in.hit.size(); ++i)
    check_row(in.hit[i], in.view[i] == wire_view ? in.wire_truth.size() : in.cluster_truth.size());
}

namespace {

// Keys of the views of a crossing that a cluster measures.
template <class F>
void each_view(std::int64_t crossing, std::int8_t view, F&& f) {
  if (view != v_view) f(2 * crossing);
  if (view != x_view) f(2 * crossing + 1);
}

// Half turn with the most weight; the smallest of several.
std::int8_t most_common(const std::array<std::int64_t, 256>& weights) {
  const auto most = std::ranges::max_element(weights);
  return static_cast<std::int8_t>(*most > 0 ? most - weights.begin() - 128 : 0);
}

}  // namespace

MatchOutput match_hits(const MatchInput& in) {
  const std::vector<Owner> of_truth = owners(in.particles, in.truths),
                           of_crossing = owners(in.particles, in.wire_truths);
  MatchOutput out;
  out.left.assign(in.particles.event.size(), 0);
  const auto count = [&](const Owner& owner, int weight) {
    if (owner.row >= 0 && !owner.other) out.left[static_cast<std::size_t>(owner.row)] += weight;
  };
  for (std::size_t i = 0; i < in.cluster_truth.size(); ++i) {
    // An XV cluster counts only where the table holds no X or V cluster of its strips.
    const int weight = in.cluster_view[i] != xv_cluster ? 1 : in.x_cluster[i] < 0 ? 2 : 0;
    count(behind(of_truth, in.cluster_truth[i]), weight);
  }
  for (const std::int64_t link : in.wire_truth) count(behind(of_crossing, link), 1);
  for (std::int64_t& hits : out.left) hits = std::max<std::int64_t>(hits, 1);

  out.crossings_left.assign(in.particles.event.size(), 0);
  const auto measure = [&](const Owner& owner) {
    if (owner.row >= 0 && !owner.other) ++out.crossings_left[static_cast<std::size_t>(owner.row)];
  };
  std::vector<bool> seen(2 * of_truth.size(), false);
  for (std::size_t i = 0; i < in.cluster_truth.size(); ++i) {
    const std::int64_t link = in.cluster_truth[i];
    if (link < 0) continue;
    each_view(link, in.cluster_view[i], [&](std::int64_t key) {
      const auto at = static_cast<std::size_t>(key);
      if (!seen[at]) measure(behind(of_truth, link));
      seen[at] = true;
    });
  }
  for (const std::int64_t link : in.wire_truth) measure(behind(of_crossing, link));

  out.particle.assign(in.candidates, -1);
  out.half_turn.assign(in.candidates, 0);
  for (auto* column : {&out.own, &out.hits, &out.found, &out.of_daughters, &out.of_loops, &out.crossings})
    column->assign(in.candidates, 0);
  struct Share {
    std::int64_t row, hits, late, found;
  };
  std::vector<Share> shares;        // of the particles of a candidate
  std::vector<std::int64_t> views;  // of crossings that its clusters measure
  std::array<std::int64_t, 256> turns{};
  const std::vector<std::size_t> order = by_candidate(in.candidate);
  const auto hit_at = [&](std::size_t i) { return order.empty() ? i : order[i]; };
  const auto owner_of = [&](std::size_t hit) {
    const auto row = static_cast<std::size_t>(in.hit[hit]);
    return in.view[hit] == wire_view ? behind(of_crossing, in.wire_truth[row])
                                     : behind(of_truth, in.cluster_truth[row]);
  };
  for (std::size_t first = 0, last; first < in.candidate.size(); first = last) {
    const std::int64_t number = in.candidate[hit_at(first)];
    const auto candidate = static_cast<std::size_t>(number);
    shares.clear();
    for (last = first; last < in.candidate.size(); ++last) {
      const std::size_t hit = hit_at(last);
      if (in.candidate[hit] != number) break;
      const int weight = in.view[hit] == point_view ? 2 : 1;
      const Owner owner = owner_of(hit);
      out.hits[candidate] += weight;
      if (owner.row < 0) continue;
      auto share = std::ranges::find(shares, owner.row, &Share::row);
      if (share == shares.end()) share = shares.insert(share, {owner.row, 0, 0, 0});
      share->hits += weight;
      share->late += owner.late ? weight : 0;
      share->found += owner.other ? 0 : weight;
    }
    const auto more = [](const Share& a, const Share& b) {
      return a.hits != b.hits ? a.hits > b.hits : a.row < b.row;
    };
    const auto most = std::ranges::min_element(shares, more);
    if (most == shares.end()) continue;
    out.particle[candidate] = most->row;
    out.own[candidate] = most->hits - most->late;
    out.found[candidate] = most->found;
    out.of_daughters[candidate] = most->late;
    views.clear();
    turns.fill(0);
    for (std::size_t i = first; i < last; ++i) {
      const std::size_t hit = hit_at(i);
      const Owner owner = owner_of(hit);
      if (owner.row != most->row || owner.late) continue;
      const int weight = in.view[hit] == point_view ? 2 : 1;
      turns[static_cast<std::size_t>(owner.half_turn + 128)] += weight;
      if (owner.half_turn != 0)
        out.of_loops[candidate] += weight;
      else if (in.view[hit] == wire_view)
        ++out.crossings[candidate];
      else
        each_view(in.cluster_truth[static_cast<std::size_t>(in.hit[hit])], in.view[hit],
                  [&](std::int64_t key) { views.push_back(key); });
    }
    std::ranges::sort(views);
    views.erase(std::unique(views.begin(), views.end()), views.end());
    out.crossings[candidate] += static_cast<std::int64_t>(views.size());
    out.half_turn[candidate] = most_common(turns);
  }
  return out;
}

HitsOfParticles assign_hits(const AssignInput& in) {
  const std::vector<Owner> of_truth = owners(in.particles, in.truths),
                           of_crossing = owners(in.particles, in.wire_truths);
  const auto candidate_of = [&](const Owner& owner) {
    return owner.row < 0 || owner.other ? -1 : in.candidates[static_cast<std::size_t>(owner.row)];
  };
  for (const std::int64_t row : in.clusters) check_row(row, in.cluster_truth.size());
  for (const std::int64_t candidate : in.candidates)
    if (candidate >= 0) check_row(candidate, in.candidates.size());
  // Calls f(candidate, row, is wire) for each hit that a candidate gets, clusters first.
  const auto each = [&](auto&& f) {
    for (const std::int64_t row : in.clusters) {
      const std::int64_t link = in.cluster_truth[static_cast<std::size_t>(row)];
      if (const auto candidate = candidate_of(behind(of_truth, link)); candidate >= 0)
        f(candidate, row, false);
    }
    for (std::size_t row = 0; row < in.wire_truth.size(); ++row)
      if (const auto candidate = candidate_of(behind(of_crossing, in.wire_truth[row])); candidate >= 0)
        f(candidate, static_cast<std::int64_t>(row), true);
  };
  std::vector<std::size_t> ends;  // behind the hits of each candidate
  each([&](std::int64_t candidate, std::int64_t, bool) {
    const auto number = static_cast<std::size_t>(candidate);
    if (number >= ends.size()) ends.resize(number + 1, 0);
    ++ends[number];
  });
  const std::size_t total = std::reduce(ends.begin(), ends.end());
  std::exclusive_scan(ends.begin(), ends.end(), ends.begin(), std::size_t{0});
  struct Place {
    std::int64_t row;
    std::int32_t layer;
    bool wire;
  };
  const auto outward = [](const Place& a, const Place& b) {
    return a.wire != b.wire ? b.wire : a.layer < b.layer;
  };
  std::vector<Place> hits(total);
  each([&](std::int64_t candidate, std::int64_t row, bool wire) {
    std::size_t& end = ends[static_cast<std::size_t>(candidate)];
    const auto at = static_cast<std::size_t>(row);
    hits[end++] = {row, wire ? in.wire_layer[at] : in.cluster_layer[at], wire};
  });
  HitsOfParticles out;
  out.candidate.resize(total);
  out.hit.resize(total);
  out.view.resize(total);
  for (std::size_t candidate = 0, first = 0; candidate < ends.size(); first = ends[candidate++]) {
    const auto mine = std::span(hits).subspan(first, ends[candidate] - first);
    if (!std::ranges::is_sorted(mine, outward)) std::ranges::stable_sort(mine, outward);
    for (std::size_t i = first; i < ends[candidate]; ++i) {
      out.candidate[i] = static_cast<std::int64_t>(candidate);
      out.hit[i] = hits[i].row;
      out.view[i] = hits[i].wire ? wire_view : in.cluster_view[static_cast<std::size_t>(hits[i].row)];
    }
  }
  return out;
}

}  // namespace cgemit
