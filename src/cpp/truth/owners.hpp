// Which particle left what: the particle behind each crossing, the hits that belong to each particle, and the
// particle that most hits of a candidate come from (docs/methods/match.md). Rows count from 0, -1 is none.
#pragma once

#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "common/particle_rows.hpp"

namespace cgemit {

using Links = std::span<const std::int64_t>;

// Crossings: rows by event with the number of a particle, the daughter and the half turn that left each.
struct CrossingRows : NumberedRows {
  std::span<const std::int32_t> daughter;
  std::span<const std::int8_t> half_turn;

  static constexpr auto columns() {
    return std::tuple(Column("event", &CrossingRows::event), Column("particle", &CrossingRows::particle),
                      Column("daughter", &CrossingRows::daughter),
                      Column("half_turn", &CrossingRows::half_turn));
  }
};

struct MatchInput {
  NumberedRows particles;
  CrossingRows truths, wire_truths;
  Links cluster_truth, wire_truth;            // of clusters and wire hits
  std::span<const std::int8_t> cluster_view;  // 0 X, 1 V, 2 XV
  Links x_cluster;                            // of XV clusters
  Links candidate, hit;                       // of the hits of candidates
  std::span<const std::int8_t> view;          // of these: 2 wire, 3 XV
  std::size_t candidates;
};

struct MatchOutput {
  // Of each candidate: row of its particle, hits of it without those of its daughters, all hits, those of
  // the particle's first half turn, of its daughters, and of its other half turns. An XV cluster counts as
  // two hits.
  std::vector<std::int64_t> particle, own, hits, found, of_daughters, of_loops;
  std::vector<std::int8_t> half_turn;  // that most of its particle's own hits are of; 0 without any
  // Measurements of the particle's first half turn in each candidate: crossings of a gap, counted per view
  // however many clusters they have, and cells.
  std::vector<std::int64_t> crossings;
  // Of each particle, of its first half turn: X and V clusters and wire hits, at least 1; and measurements.
  std::vector<std::int64_t> left, crossings_left;

  static constexpr auto columns() {
    return std::tuple(
        Column("particle", &MatchOutput::particle), Column("own", &MatchOutput::own),
        Column("hits", &MatchOutput::hits), Column("found", &MatchOutput::found),
        Column("left", &MatchOutput::left), Column("of_daughters", &MatchOutput::of_daughters),
        Column("of_loops", &MatchOutput::of_loops), Column("half_turn", &MatchOutput::half_turn),
        Column("crossings", &MatchOutput::crossings), Column("crossings_left", &MatchOutput::crossings_left));
  }
};

// Throws std::invalid_argument where a hit of a candidate counts a row that is not there.
void check_rows(const MatchInput& input);

// Of several particles with as many hits a candidate belongs to the first.
MatchOutput match_hits(const MatchInput& input);

struct HitsOfParticles {
  std::vector<std::int64_t> candidate, hit;
  std::vector<std::int8_t> view;

  static constexpr auto columns() {
    return std::tuple(Column("candidate", &HitsOfParticles::candidate),
                      Column("view", &HitsOfParticles::view), Column("hit", &HitsOfParticles::hit));
  }
};

// The hits of each candidate from the beam line outward: clusters by layer, then wire hits by layer, those of
// a layer in the order of their tables. `candidates`: of each particle, below their number. Hits of daughters
// and of other half turns than the first are left out. `clusters`: rows of the clusters that count.
struct AssignInput {
  NumberedRows particles;
  CrossingRows truths, wire_truths;
  Links candidates;
  Links clusters;
  Links cluster_truth, wire_truth;
  std::span<const std::int8_t> cluster_view;
  std::span<const std::int32_t> cluster_layer, wire_layer;
};
// Throws std::invalid_argument where `clusters` counts a row that is not there.
HitsOfParticles assign_hits(const AssignInput& input);

}  // namespace cgemit
