#include "detector/cluster_rows.hpp"

namespace cgemit {

void ClusterColumns::reserve(std::size_t n) {
  event.reserve(n);
  for (auto* values : {&layer, &sheet, &first, &last, &size, &n_truths}) values->reserve(n);
  for (auto* values : {&view, &method}) values->reserve(n);
  for (auto* values : {&charge, &time, &x, &v, &phi, &z, &r, &err_x, &err_v, &err_phi, &err_z, &score}) {
    values->reserve(n);
  }
  for (auto* values : {&x_cluster, &v_cluster, &truth}) values->reserve(n);
}

void ClusterColumns::push_back(const ClusterRow& row) {
  event.push_back(row.event);
  layer.push_back(row.layer);
  sheet.push_back(row.sheet);
  view.push_back(static_cast<std::int8_t>(row.view));
  first.push_back(row.first);
  last.push_back(row.last);
  size.push_back(row.size);
  charge.push_back(row.charge);
  time.push_back(row.time);
  x.push_back(row.x);
  v.push_back(row.v);
  phi.push_back(row.phi);
  z.push_back(row.z);
  r.push_back(row.r);
  err_x.push_back(row.err_x);
  err_v.push_back(row.err_v);
  err_phi.push_back(row.err_phi);
  err_z.push_back(row.err_z);
  x_cluster.push_back(row.x_cluster);
  v_cluster.push_back(row.v_cluster);
  truth.push_back(row.truth);
  n_truths.push_back(row.n_truths);
  method.push_back(static_cast<std::int8_t>(row.method));
  score.push_back(row.score);
}

}  // namespace cgemit
