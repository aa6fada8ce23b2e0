#include "bindings/interrupt.hpp"

#include <pybind11/pybind11.h>

#include <atomic>
#include <chrono>

namespace py = pybind11;

namespace cgemit::bindings {

namespace {

std::atomic<int> stops{0};  // callers that want all stages to end

// Of a thread: whether it was told that its stage must end, and when it last looked for signals.
struct Thread {
  bool told = false;
  unsigned calls = 0;
  std::chrono::steady_clock::time_point looked;
  enum { unknown, main, other } kind = unknown;
};
thread_local Thread self;

constexpr unsigned calls_per_look = 64;
constexpr std::chrono::milliseconds between_looks{100};

// Runs the handlers of signals, which Python does in the main thread only; true if one raised an error.
bool look_for_signals() {
  const auto now = std::chrono::steady_clock::now();
  if (self.kind == Thread::other || now - self.looked < between_looks) return false;
  self.looked = now;
  const py::gil_scoped_acquire gil;
  if (self.kind == Thread::unknown) {
    const py::module_ threading = py::module_::import("threading");
    const bool is_main = threading.attr("current_thread")().is(threading.attr("main_thread")());
    self.kind = is_main ? Thread::main : Thread::other;
  }
  return self.kind == Thread::main && PyErr_CheckSignals() != 0;
}

}  // namespace

bool interrupted() {
  if (self.told) return true;
  self.told =
      stops.load(std::memory_order_relaxed) > 0 || (++self.calls % calls_per_look == 0 && look_for_signals());
  return self.told;
}

void throw_if_interrupted() {
  if (!self.told) return;
  self.told = false;
  if (PyErr_Occurred() == nullptr) PyErr_SetNone(PyExc_KeyboardInterrupt);
  throw py::error_already_set();
}

}  // namespace cgemit::bindings

void bind_interrupt(py::module_& module) {
  module.def(
      "stop_stages", [](bool stop) { cgemit::bindings::stops += stop ? 1 : -1; }, py::arg("stop"),
      "Make all stages that are at work, on any thread, raise KeyboardInterrupt; until called with False.");
}
