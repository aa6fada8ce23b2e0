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
#include <utility>

#include "common/problems.hpp"

namespace cgemit::bindings {

namespace py = pybind11;

class Settings {
 public:
  Settings(std::string what, const py::dict& values) : what_(std::move(what)), values_(values) {}

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
    find_unknown();
    problems_.raise(what_);
  }
  // The same for one of several parts of an input, whose problems are listed together.
  void check(Problems& of_all) {
    find_unknown();
    of_all.add(problems_, what_);
  }

 private:
  void find_unknown() {
    for (const auto& [name, value] : values_) {
      const auto given = py::str(name).cast<std::string>();
      if (!read_.contains(given)) problems_.add(given + ": no such field");
    }
  }
  template <class T>
  T get(const char* name) {
    read_.insert(name);
    if (!values_.contains(name)) {
      problems_.add(std::string(name) + ": missing");
      return {};
    }
    try {
      return py::cast<T>(values_[name]);
    } catch (const py::cast_error&) {         // of a number
    } catch (const py::error_already_set&) {  // of an array or a dict
    }
    problems_.add(std::string(name) + ": got " + py::repr(values_[name]).cast<std::string>() +
                  ", which has another type than the field");
    return {};
  }

  std::string what_;
  py::dict values_;
  std::set<std::string> read_;
  Problems problems_;
};

}  // namespace cgemit::bindings
