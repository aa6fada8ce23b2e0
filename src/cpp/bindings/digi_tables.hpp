// The tables that the digitizers read and write as dicts of numpy columns.
#pragma once

#include "bindings/inputs.hpp"
#include "simulation/digitize/digis.hpp"
#include "simulation/digitize/truths.hpp"

namespace cgemit::bindings {

inline TruthColumns truth_columns(Inputs& in) {
  TruthColumns truths;
  truths.event = in.get<std::int64_t>("event");
  truths.particle = in.get<std::int32_t>("particle");
  truths.layer = in.get<std::int32_t>("layer");
  truths.entry = {in.get<double>("entry_x"), in.get<double>("entry_y"), in.get<double>("entry_z")};
  truths.exit = {in.get<double>("exit_x"), in.get<double>("exit_y"), in.get<double>("exit_z")};
  truths.phi = in.get<double>("phi");
  truths.z = in.get<double>("z");
  truths.time = in.get<double>("time");
  truths.energy = in.get<double>("energy");
  return truths;
}

inline StepColumns step_columns(Inputs& in) {
  StepColumns steps;
  steps.event = in.get<std::int64_t>("event");
  steps.truth = in.get<std::int64_t>("truth");
  steps.particle = in.get<std::int32_t>("particle");
  steps.layer = in.get<std::int32_t>("layer");
  steps.n_electrons = in.get<std::int32_t>("n_electrons");
  steps.parent = in.get<std::int8_t>("parent");
  steps.middle = {in.get<double>("x"), in.get<double>("y"), in.get<double>("z")};
  steps.d = {in.get<double>("dx"), in.get<double>("dy"), in.get<double>("dz")};
  steps.energy = in.get<double>("energy");
  return steps;
}

}  // namespace cgemit::bindings
