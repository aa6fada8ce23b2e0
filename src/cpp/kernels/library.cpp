// Compiled once per instruction set, with CGEMIT_ISA its name and CGEMIT_LANES the width of its registers.
#include "common/compiler.hpp"
#include "covariance/batch.hpp"
#include "kernels/kernels.hpp"
#include "kernels/testing.hpp"
#include "reconstruction/fit/batch.hpp"
#include "simulation/digitize/analog_batch.hpp"
#include "simulation/transport/batch.hpp"

namespace cgemit {

namespace {

using Number = Pack<CGEMIT_LANES>;

void fit(const Detector& detector, const FitInput& input, const FitSettings& settings,
         const FitOutput& output) {
  BatchFit<Number>(detector, input, settings, output).run();
}

void covariances_of_lanes(const Detector& detector, const CovarianceInput& input, const HitModel& model,
                          const CovarianceOutput& output) {
  CovarianceBatch<Number>(detector, input, model, output).run();
}

constexpr Kernels these{
    CGEMIT_ISA, CGEMIT_LANES,          &function_of_lanes<Number>,    &simulate_lanes<Number>,
    &fit,       &covariances_of_lanes, &read_out_analog_lanes<Number>};

}  // namespace

}  // namespace cgemit

extern "C" CGEMIT_EXPORT const cgemit::Kernels* cgemit_kernels() { return &cgemit::these; }
