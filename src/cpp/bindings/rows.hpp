// Columns of numpy from rows of a struct.
#pragma once

#include <functional>
#include <type_traits>

#include "bindings/arrays.hpp"

namespace cgemit::bindings {

// The type of an entry of a column: numbers as they are, enums as their numbers, arrays entry by entry.
template <class T>
struct EntryOf {
  using type = T;
};
template <class T>
  requires std::is_enum_v<T>
struct EntryOf<T> {
  using type = std::underlying_type_t<T>;
};
template <class T, std::size_t N>
struct EntryOf<std::array<T, N>> {
  using type = T;
};

// The columns are allocated for a number of rows that is known in advance, and filled from the first row to
// the last; filling needs no GIL.
template <class Row>
class RowColumns {
 public:
  explicit RowColumns(std::size_t rows) : rows_(static_cast<py::ssize_t>(rows)) {}

  // Adds a column of a member or of a function of the rows; `shape`: of each entry that is an array.
  template <class Value>
  RowColumns& add(const char* name, Value value, std::vector<py::ssize_t> shape = {}) {
    using Given = std::remove_cvref_t<std::invoke_result_t<Value, const Row&>>;
    using Entry = typename EntryOf<Given>::type;
    shape.insert(shape.begin(), rows_);
    py::array_t<Entry> array(std::move(shape));
    fill_.push_back([to = array.mutable_data(), value](std::span<const Row> rows) mutable {
      for (const Row& row : rows) {
        if constexpr (std::is_arithmetic_v<Given> || std::is_enum_v<Given>)
          *to++ = static_cast<Entry>(std::invoke(value, row));
        else
          to = std::ranges::copy(std::invoke(value, row), to).out;
      }
    });
    columns_[name] = std::move(array);
    return *this;
  }
  void append(std::span<const Row> rows) {
    for (const auto& fill : fill_) fill(rows);
  }
  // Adds the columns to a table.
  void give(py::dict& table) const {
    for (const auto& [name, column] : columns_) table[name] = column;
  }

 private:
  py::ssize_t rows_;
  py::dict columns_;
  std::vector<std::function<void(std::span<const Row>)>> fill_;
};

}  // namespace cgemit::bindings
