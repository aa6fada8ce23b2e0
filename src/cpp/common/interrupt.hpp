// Whether the results of a stage are still wanted.
#pragma once

namespace cgemit {

// Asked between events, groups of tracks and many iterations. Once the answer is true, a stage ends as soon
// as it can, and what it returns is worthless. A function, since the kernels of an instruction set are a
// library of their own that shares no variable with the core.
using Interrupted = bool (*)();

inline bool never_interrupted() { return false; }

}  // namespace cgemit
