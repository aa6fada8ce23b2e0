// Collects the measurements of track candidates from the tables that they refer to, ordered from the beam
// line outward.
#pragma once

#include <cstdint>
#include <span>
#include <tuple>
#include <vector>

#include "common/columns.hpp"
#include "reconstruction/fit/hit_rules.hpp"

namespace cgemit {

struct CandidateInput {
  std::span<const std::int64_t> event;           // of each candidate
  std::span<const double> mass;                  // GeV, likewise
  std::span<const std::int64_t> hit_event;       // of each hit, and the following
  std::span<const std::int64_t> candidate, hit;  // which candidate, which row of the hit's table
  std::span<const std::int8_t> view;             // 0 X, 1 V, 2 wire, 3 XV cluster
};

struct ClusterInput {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> layer, sheet, size;
  std::span<const std::int8_t> view;  // 0 X, 1 V, 2 XV
  std::span<const double> x, v, err_x, err_v;
  std::span<const double> cov_xv;  // mm^2, of XV clusters: covariance of x and v; may be empty
  std::span<const double>
      corr_xv;  // correlation of x and v of X and V clusters of one particle; may be empty

  static constexpr auto columns() {
    return std::tuple(Column("event", &ClusterInput::event), Column("layer", &ClusterInput::layer),
                      Column("sheet", &ClusterInput::sheet), Column("size", &ClusterInput::size),
                      Column("view", &ClusterInput::view), Column("x", &ClusterInput::x),
                      Column("v", &ClusterInput::v), Column("err_x", &ClusterInput::err_x),
                      Column("err_v", &ClusterInput::err_v));
  }

  static constexpr auto optional() {
    return std::tuple(Column("cov_xv", &ClusterInput::cov_xv), Column("corr_xv", &ClusterInput::corr_xv));
  }
};

struct WireInput {
  std::span<const std::int64_t> event;
  std::span<const std::int32_t> layer, wire;
  std::span<const double> drift, sigma;
  std::span<const std::int8_t> side;

  static constexpr auto columns() {
    return std::tuple(Column("event", &WireInput::event), Column("layer", &WireInput::layer),
                      Column("wire", &WireInput::wire), Column("drift", &WireInput::drift),
                      Column("sigma", &WireInput::sigma), Column("side", &WireInput::side));
  }
};

// Flat columns; hits `offsets[i]` to `offsets[i + 1]` belong to candidate i. An XV cluster becomes two hits:
// X, and the part of V that is uncorrelated with X. So do an X and a V cluster of a layer with a correlation.
struct CollectedHits {
  std::vector<std::int64_t> offsets;
  std::vector<std::uint8_t> kind;
  std::vector<std::int32_t> layer, channel, size;
  std::vector<double> value, sigma, k, x;
  std::vector<std::int8_t> side;
  std::vector<std::int64_t> hit;  // rows of their tables

  static constexpr auto columns() {
    return std::tuple(Column("hit_offsets", &CollectedHits::offsets), Column("kind", &CollectedHits::kind),
                      Column("layer", &CollectedHits::layer), Column("channel", &CollectedHits::channel),
                      Column("value", &CollectedHits::value), Column("sigma", &CollectedHits::sigma),
                      Column("size", &CollectedHits::size), Column("side", &CollectedHits::side),
                      Column("hit", &CollectedHits::hit), Column("k", &CollectedHits::k),
                      Column("x", &CollectedHits::x));
  }
};

// The order of the result depends on the hits only, not on their order in the input. Throws, listing every
// problem, if a hit is given twice, belongs to another event, or does not exist. `check_hits` checks the
// measurements themselves.
CollectedHits collect_hits(const Detector& detector, const CandidateInput& candidates,
                           const ClusterInput& clusters, const WireInput& wires);

}  // namespace cgemit
