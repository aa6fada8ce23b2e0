// What a kernel counts in: one number in the core, the lanes of a register in a library of kernels
// (CMakeLists.txt).
#pragma once

#if defined(CGEMIT_LANES)
#include "common/lanes/pack.hpp"
#endif

namespace cgemit {

#if defined(CGEMIT_LANES)
using Number = Pack<CGEMIT_LANES>;
#else
using Number = double;
#endif

}  // namespace cgemit
