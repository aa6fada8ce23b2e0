// Passing arrays between Python and C++. Inputs: C-contiguous, of the stated type, shape checked, never
// truncated. Outputs are not copied: a C++ vector moves into a capsule that numpy keeps alive.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "common/columns.hpp"
#include "common/problems.hpp"

namespace cgemit::bindings {

namespace py = pybind11;

template <class T>
using Array = py::array_t<T, py::array::c_style>;

// View of a one-dimensional input; `name` appears in the error when the length is not `size` (-1: any).
template <class T>
std::span<const T> column(const Array<T>& array, const char* name, py::ssize_t size = -1) {
  if (array.ndim() != 1 || (size >= 0 && array.shape(0) != size)) {
    throw std::invalid_argument(std::string(name) + ": expected a one-dimensional array" +
                                (size >= 0 ? " of length " + std::to_string(size) : std::string()));
  }
  return {array.data(), static_cast<std::size_t>(array.shape(0))};
}

// View of a two-dimensional input of shape (rows, width).
template <class T>
std::span<const T> matrix(const Array<T>& array, const char* name, py::ssize_t rows, py::ssize_t width) {
  if (array.ndim() != 2 || array.shape(0) != rows || array.shape(1) != width) {
    throw std::invalid_argument(std::string(name) + ": expected shape (" + std::to_string(rows) + ", " +
                                std::to_string(width) + ")");
  }
  return {array.data(), static_cast<std::size_t>(array.size())};
}

// The numbers of an entry of a column, and its shape: one number, or an array of entries.
template <class T>
struct EntryOf {
  using Number = T;
  static void add_shape(std::vector<py::ssize_t>&) {}
};
template <class T, std::size_t N>
struct EntryOf<std::array<T, N>> {
  using Number = typename EntryOf<T>::Number;
  static void add_shape(std::vector<py::ssize_t>& shape) {
    shape.push_back(static_cast<py::ssize_t>(N));
    EntryOf<T>::add_shape(shape);
  }
};

// Numpy array that owns the vector's memory.
template <class T>
  requires(!std::is_enum_v<T>)
auto to_numpy(std::vector<T>&& values, std::vector<py::ssize_t> shape = {}) {
  using Number = typename EntryOf<T>::Number;
  if (shape.empty()) {
    shape = {static_cast<py::ssize_t>(values.size())};
    EntryOf<T>::add_shape(shape);
  }
  auto owner = std::make_unique<std::vector<T>>(std::move(values));
  const void* data = owner->data();
  py::capsule capsule(owner.release(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  py::array_t<Number> array(std::move(shape), static_cast<const Number*>(data), capsule);
  py::detail::array_proxy(array.ptr())->flags &= ~py::detail::npy_api::NPY_ARRAY_WRITEABLE_;
  return array;
}

// Enums go out as their numbers.
template <class T>
  requires std::is_enum_v<T>
auto to_numpy(std::vector<T>&& values) {
  std::vector<std::underlying_type_t<T>> numbers(values.size());
  std::ranges::transform(values, numbers.begin(),
                         [](T one) { return static_cast<std::underlying_type_t<T>>(one); });
  return to_numpy(std::move(numbers));
}

// Adds the columns of a table to a dict: of `Columns`, or of a struct of vectors.
template <class Table>
void add_columns(Table&& table, py::dict& to) {
  const auto add = [&](const char* name, auto& values) { to[name] = to_numpy(std::move(values)); };
  if constexpr (requires { Table::columns(); }) {
    std::apply([&](const auto&... one) { (add(one.name, table.*one.value), ...); }, Table::columns());
  } else {
    table.each_column(add);
  }
}
template <class Table>
py::dict to_dict(Table&& table) {
  py::dict columns;
  add_columns(std::move(table), columns);
  return columns;
}

// Takes a named column of a dict of columns as numbers T; false, with a problem, where it is missing or has
// another type.
template <class T>
bool take(const py::dict& columns, const std::string& name, Problems& problems, Array<T>& to) {
  if (!columns.contains(name)) {
    problems.add(name + ": missing");
    return false;
  }
  const py::object given = columns[py::str(name)];
  if (auto array = Array<T>::ensure(given)) {
    to = std::move(array);
    return true;
  }
  const auto as_it_is = py::array::ensure(given);
  const py::str kind = as_it_is ? py::str(as_it_is.dtype()) : py::str(py::type::of(given));
  problems.add(name + ": got " + kind.cast<std::string>() + ", expected " +
               py::str(py::dtype::of<T>()).template cast<std::string>());
  return false;
}

template <class T>
Array<T> take(const py::dict& columns, const char* name) {
  Problems problems;
  Array<T> found(0);
  take(columns, name, problems, found);
  problems.raise("columns");
  return found;
}

}  // namespace cgemit::bindings
