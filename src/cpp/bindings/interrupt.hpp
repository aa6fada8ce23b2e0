// Ctrl-C while a stage works without the GIL.
#pragma once

namespace cgemit::bindings {

// Whether the stage of this thread must end: asked by the core, on any thread, without the GIL.
bool interrupted();

// Throws, with the GIL, what a signal's handler raised in this thread, or KeyboardInterrupt if a stage of
// this thread was told to end. To be called after every stage that is given `interrupted`.
void throw_if_interrupted();

}  // namespace cgemit::bindings
