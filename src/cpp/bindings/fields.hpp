// Input tables by the columns that a C++ struct names (common/columns.hpp): a struct of spans, or one for
// each row. A column that is missing, or has another type or length, is named in the error.
#pragma once

#include <algorithm>
#include <array>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "bindings/arrays.hpp"

namespace cgemit::bindings {

// Calls a function for every field of a struct that it names as a column.
template <class F, class... Fields>
void each_field(const std::tuple<Fields...>& fields, F&& f) {
  std::apply([&](const auto&... one) { (f(one), ...); }, fields);
}

// The numbers in which a field comes: those of enums are their own.
template <class T>
struct NumbersOf {
  using type = T;
};
template <class T>
  requires std::is_enum_v<T>
struct NumbersOf<T> {
  using type = std::underlying_type_t<T>;
};

// The columns of one input table, kept alive while a kernel reads them without the GIL.
class Inputs {
 public:
  // `what`: the table, for errors. All columns must be as long as the first that is read, or have `rows`
  // rows.
  Inputs(const py::dict& table, std::string what, py::ssize_t rows = -1)
      : table_(table), what_(std::move(what)), rows_(rows) {}

  py::ssize_t rows() const { return rows_; }

  template <class T>
  std::span<const T> get(const char* name) {
    Problems problems;
    const auto found = column_of<T>(name, problems);
    problems.raise(what_);
    return found;
  }

  // A struct of spans: those that `columns()` names, and those of `optional()` that are there.
  template <class View>
  View read() {
    View view{};
    Problems problems;
    each_field(View::columns(), [&](const auto& one) { fill(view.*one.value, one.name, problems); });
    if constexpr (requires { View::optional(); }) {
      each_field(View::optional(), [&](const auto& one) {
        if (table_.contains(one.name)) fill(view.*one.value, one.name, problems);
      });
    }
    problems.raise(what_);
    return view;
  }

  // A struct for each row; what `columns()` does not name is as in Row{}.
  template <class Row>
  std::vector<Row> read_rows() {
    Problems problems;
    auto rows = rows_of<Row>(problems);
    problems.raise(what_);
    return rows;
  }

  // The same for one of several tables of an input, whose problems are listed together.
  template <class T>
  std::span<const T> get(const char* name, Problems& of_all) {
    Problems problems;
    const auto found = column_of<T>(name, problems);
    of_all.add(problems, what_);
    return found;
  }
  template <class Row>
  std::vector<Row> read_rows(Problems& of_all) {
    Problems problems;
    auto rows = rows_of<Row>(problems);
    of_all.add(problems, what_);
    return rows;
  }

 private:
  // The numbers of a column of rows of this shape; none if that is a problem.
  template <class T>
  std::span<const T> column_of(const std::string& name, Problems& problems,
                               const std::vector<py::ssize_t>& shape = {}) {
    Array<T> array(0);
    if (!take(table_, name, problems, array)) return {};
    const bool is_table = array.ndim() == static_cast<py::ssize_t>(1 + shape.size());
    if (rows_ < 0 && is_table) rows_ = array.shape(0);
    if (!is_table || array.shape(0) != rows_ || !std::equal(shape.begin(), shape.end(), array.shape() + 1)) {
      std::string expected = "a one-dimensional array of length " + std::to_string(rows_);
      if (!shape.empty()) {
        expected = "shape (" + (rows_ < 0 ? "rows" : std::to_string(rows_));
        for (const py::ssize_t n : shape) expected += ", " + std::to_string(n);
        expected += ")";
      }
      problems.add(name + ": expected " + expected);
      return {};
    }
    held_.append(array);
    return {array.data(), static_cast<std::size_t>(array.size())};
  }

  template <class Row>
  std::vector<Row> rows_of(Problems& problems) {
    std::vector<Row> rows;
    each_field(Row::columns(), [&](const auto& one) {
      fill(one.name, {}, problems, [&](std::size_t i) -> auto& {
        if (rows.empty()) rows.resize(static_cast<std::size_t>(rows_));
        return rows[i].*one.value;
      });
    });
    return rows;
  }
  // A field of all rows, where `at(i)` is the i-th one, row by row.
  template <class At>
  void fill(const std::string& name, const std::vector<py::ssize_t>& shape, Problems& problems,
            const At& at) {
    using Field = std::remove_cvref_t<decltype(at(0))>;
    if constexpr (requires { Field::columns(); }) {
      each_field(Field::columns(), [&](const auto& one) {
        fill(name + one.name, shape, problems, [&](std::size_t i) -> auto& { return at(i).*one.value; });
      });
    } else if constexpr (requires { std::tuple_size<Field>::value; }) {
      constexpr std::size_t n = std::tuple_size<Field>::value;
      std::vector<py::ssize_t> of_entries = shape;
      of_entries.push_back(static_cast<py::ssize_t>(n));
      fill(name, of_entries, problems, [&](std::size_t i) -> auto& { return at(i / n)[i % n]; });
    } else {
      const auto values = column_of<typename NumbersOf<Field>::type>(name, problems, shape);
      for (std::size_t i = 0; i < values.size(); ++i) at(i) = static_cast<Field>(values[i]);
    }
  }

  template <class T>
  void fill(std::span<const T>& to, const std::string& name, Problems& problems) {
    to = column_of<T>(name, problems);
  }
  // Of a point: the name, followed by x, y and z.
  template <class T>
  void fill(std::array<std::span<const T>, 3>& to, const std::string& name, Problems& problems) {
    for (std::size_t axis = 0; axis < 3; ++axis) fill(to[axis], name + "xyz"[axis], problems);
  }

  py::dict table_;
  std::string what_;
  py::ssize_t rows_;
  py::list held_;
};

}  // namespace cgemit::bindings
