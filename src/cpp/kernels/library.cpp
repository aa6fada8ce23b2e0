// The kernels of one instruction set, CGEMIT_ISA its name and CGEMIT_LANES the width of its registers.
#include "common/compiler.hpp"
#include "common/lanes/number.hpp"
#include "kernels/kernels.hpp"
#include "kernels/testing.hpp"

namespace cgemit {

namespace {

constexpr Kernels these{CGEMIT_ISA,      CGEMIT_LANES,     &function_of_lanes<Number>,
                        &simulate,       &fit_tracks,      &covariances,
                        &alignment_sums, &read_out_analog, &read_out_wires};

}  // namespace

}  // namespace cgemit

extern "C" CGEMIT_EXPORT const cgemit::Kernels* cgemit_kernels() { return &cgemit::these; }
