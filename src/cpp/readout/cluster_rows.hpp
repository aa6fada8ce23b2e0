// Rows of the clusters table and the formulas that fill them, shared by the readouts with strips and those
// without.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <tuple>

#include "common/columns.hpp"
#include "detector/strip_plane.hpp"

namespace cgemit {

enum class ClusterView : std::int8_t { x = 0, v = 1, xv = 2 };
// Views of a candidate's hits, beside X and V.
inline constexpr std::int8_t wire_view = 2, point_view = 3;
// The source of the position: strips, whose error depends on their number and the incidence of the track, or
// the readout itself, with a fixed error.
enum class ClusterMethod : std::int8_t { strips = 0, positions = 1 };

inline constexpr double not_measured = std::numeric_limits<double>::quiet_NaN();

struct ClusterRow {
  std::int64_t event;
  std::int32_t layer, sheet;
  ClusterView view;
  std::int32_t first = -1, last = -1, size = 0;  // strips; -1 if there are none
  double charge = 0;                             // fC
  double time = 0;                               // ns
  double x = not_measured, v = not_measured;     // mm, local
  double phi = not_measured, z = not_measured;   // rad, mm
  double r = 0;                                  // mm, middle of the drift gap
  double err_x = not_measured, err_v = not_measured, err_phi = not_measured, err_z = not_measured;
  std::int64_t x_cluster = -1, v_cluster = -1;  // rows of the two views that an XV row joins
  std::int64_t truth = -1;
  std::int32_t n_truths = 0;
  ClusterMethod method = ClusterMethod::strips;
  double score = not_measured;  // of a pair: logarithm of a likelihood ratio
  double shift = 0;             // mm, of X or V by the direction of the track; not a column

  static constexpr auto columns() {
    return std::tuple(
        Column("event", &ClusterRow::event), Column("layer", &ClusterRow::layer),
        Column("sheet", &ClusterRow::sheet), Column("view", &ClusterRow::view),
        Column("first", &ClusterRow::first), Column("last", &ClusterRow::last),
        Column("size", &ClusterRow::size), Column("charge", &ClusterRow::charge),
        Column("time", &ClusterRow::time), Column("x", &ClusterRow::x), Column("v", &ClusterRow::v),
        Column("phi", &ClusterRow::phi), Column("z", &ClusterRow::z), Column("r", &ClusterRow::r),
        Column("err_x", &ClusterRow::err_x), Column("err_v", &ClusterRow::err_v),
        Column("err_phi", &ClusterRow::err_phi), Column("err_z", &ClusterRow::err_z),
        Column("x_cluster", &ClusterRow::x_cluster), Column("v_cluster", &ClusterRow::v_cluster),
        Column("truth", &ClusterRow::truth), Column("n_truths", &ClusterRow::n_truths),
        Column("method", &ClusterRow::method), Column("score", &ClusterRow::score));
  }
};

// Sets the azimuth of a row from its x and err_x. The azimuth is also valid at mid-gap: charge is projected
// to the readout at unchanged phi and z.
inline void set_azimuth(const MeasuringLayer& layer, ClusterRow& row) {
  row.phi = azimuth(layer, row.sheet, row.x);
  row.err_phi = row.err_x / layer.r_readout;
}

// The XV row of an X and a V row of one sheet; z from V = X cos + (z_ref - z) sin, errors uncorrelated.
inline ClusterRow join_views(const MeasuringLayer& layer, const ClusterRow& x, const ClusterRow& v,
                             std::int64_t x_row, std::int64_t v_row, double score = 0) {
  ClusterRow joined = x;
  joined.view = ClusterView::xv;
  joined.first = joined.last = -1;
  joined.size = x.size + v.size;
  joined.charge = x.charge + v.charge;
  joined.time = std::min(x.time, v.time);
  joined.v = v.v;
  joined.err_v = v.err_v;
  joined.z = crossing_z(layer, x.x, v.v);
  joined.err_z = std::hypot(v.err_v, layer.cos_stereo * x.err_x) / std::abs(layer.sin_stereo);
  joined.x_cluster = x_row;
  joined.v_cluster = v_row;
  joined.score = score;
  joined.truth = x.truth == v.truth ? x.truth : -1;
  joined.n_truths = std::max(x.n_truths, v.n_truths);
  return joined;
}

}  // namespace cgemit
