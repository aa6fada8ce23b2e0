// The clusters table as a dict of numpy columns.
#pragma once

#include "bindings/arrays.hpp"
#include "detector/cluster_rows.hpp"

namespace cgemit::bindings {

inline py::dict to_dict(ClusterColumns&& clusters) {
  py::dict out;
  out["event"] = to_numpy(std::move(clusters.event));
  out["layer"] = to_numpy(std::move(clusters.layer));
  out["sheet"] = to_numpy(std::move(clusters.sheet));
  out["view"] = to_numpy(std::move(clusters.view));
  out["first"] = to_numpy(std::move(clusters.first));
  out["last"] = to_numpy(std::move(clusters.last));
  out["size"] = to_numpy(std::move(clusters.size));
  out["charge"] = to_numpy(std::move(clusters.charge));
  out["time"] = to_numpy(std::move(clusters.time));
  out["x"] = to_numpy(std::move(clusters.x));
  out["v"] = to_numpy(std::move(clusters.v));
  out["phi"] = to_numpy(std::move(clusters.phi));
  out["z"] = to_numpy(std::move(clusters.z));
  out["r"] = to_numpy(std::move(clusters.r));
  out["err_x"] = to_numpy(std::move(clusters.err_x));
  out["err_v"] = to_numpy(std::move(clusters.err_v));
  out["err_phi"] = to_numpy(std::move(clusters.err_phi));
  out["err_z"] = to_numpy(std::move(clusters.err_z));
  out["x_cluster"] = to_numpy(std::move(clusters.x_cluster));
  out["v_cluster"] = to_numpy(std::move(clusters.v_cluster));
  out["truth"] = to_numpy(std::move(clusters.truth));
  out["n_truths"] = to_numpy(std::move(clusters.n_truths));
  out["method"] = to_numpy(std::move(clusters.method));
  out["score"] = to_numpy(std::move(clusters.score));
  return out;
}

}  // namespace cgemit::bindings
