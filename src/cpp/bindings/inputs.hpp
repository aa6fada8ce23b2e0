// The columns of one input table, kept alive while a kernel reads them without the GIL.
#pragma once

#include "bindings/arrays.hpp"
#include "common/particle_rows.hpp"

namespace cgemit::bindings {

class Inputs {
 public:
  // All columns must be as long as column `first`.
  Inputs(const py::dict& table, const char* first)
      : table_(table), rows_(py::cast<py::array>(table[first]).size()) {}

  template <class T>
  std::span<const T> get(const char* name) {
    const auto array = take<T>(table_, name);
    held_.append(array);
    return column(array, name, rows_);
  }

 private:
  py::dict table_;
  py::ssize_t rows_;
  py::list held_;
};

inline NumberedRows numbered(Inputs& in) {
  return {in.get<std::int64_t>("event"), in.get<std::int32_t>("particle")};
}

}  // namespace cgemit::bindings
