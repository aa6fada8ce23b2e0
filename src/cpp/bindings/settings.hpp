// Settings come from Python as a dict of values by field name. The struct is made with designated
// initializers, so that the compiler tells of a field that is left out:
//
//   Settings in("settings", values);
//   const FitSettings settings{.max_iterations = in["max_iterations"], ...};
//   in.check();
#pragma once

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <set>
#include <string>

#include "common/problems.hpp"

namespace cgemit::bindings {

namespace py = pybind11;

class Settings {
 public:
  Settings(const char* what, const py::dict& values) : what_(what), values_(values) {}

  // Converts to the type of the field; a value that is missing or wrong is reported by `check`.
  class Value {
   public:
    Value(Settings& settings, const char* name) : settings_(settings), name_(name) {}
    template <class T>
    operator T() const {
      return settings_.get<T>(name_);
    }

   private:
    Settings& settings_;
    const char* name_;
  };
  Value operator[](const char* name) { return {*this, name}; }

  // Throws std::invalid_argument, listing the names that are missing, unknown or have a value of another
  // type.
  void check() {
    for (const auto& [name, value] : values_) {
      const auto given = py::str(name).cast<std::string>();
      if (!read_.contains(given)) problems_.add(given + ": no such field");
    }
    problems_.raise(what_);
  }

 private:
  template <class T>
  T get(const char* name) {
    read_.insert(name);
    if (!values_.contains(name)) {
      problems_.add(std::string(name) + ": missing");
      return {};
    }
    try {
      return py::cast<T>(values_[name]);
    } catch (const py::cast_error&) {
      problems_.add(std::string(name) + ": got " + py::repr(values_[name]).cast<std::string>() +
                    ", which has another type than the field");
      return {};
    }
  }

  std::string what_;
  py::dict values_;
  std::set<std::string> read_;
  Problems problems_;
};

}  // namespace cgemit::bindings
