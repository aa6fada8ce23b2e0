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
#include <vector>

#include "common/columns.hpp"

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

// Numpy array that owns the vector's memory.
template <class T>
py::array_t<T> to_numpy(std::vector<T>&& values, std::vector<py::ssize_t> shape = {}) {
  if (shape.empty()) shape = {static_cast<py::ssize_t>(values.size())};
  auto owner = std::make_unique<std::vector<T>>(std::move(values));
  T* data = owner->data();
  py::capsule capsule(owner.release(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  py::array_t<T> array(std::move(shape), data, capsule);
  py::detail::array_proxy(array.ptr())->flags &= ~py::detail::npy_api::NPY_ARRAY_WRITEABLE_;
  return array;
}

template <class Row>
py::dict to_dict(Columns<Row>&& table) {
  py::dict columns;
  table.each_column([&](const char* name, auto& values) { columns[name] = to_numpy(std::move(values)); });
  return columns;
}

// A named column of a dict of columns, converted to T.
template <class T>
Array<T> take(const py::dict& columns, const char* name) {
  if (!columns.contains(name)) throw std::invalid_argument(std::string("missing column: ") + name);
  return py::cast<Array<T>>(columns[name]);
}

}  // namespace cgemit::bindings
