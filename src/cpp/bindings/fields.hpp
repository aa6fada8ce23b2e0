// Input tables by the columns that a C++ struct names (common/columns.hpp): a struct of spans, or one for
// each row. A column that is missing, or has another type or length, is named in the error.
#pragma once

#include <array>
#include <concepts>
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
  Inputs(const py::dict& table, const char* what, py::ssize_t rows = -1)
      : table_(table), what_(what), rows_(rows) {}

  py::ssize_t rows() const { return rows_; }

  template <class T>
  std::span<const T> get(const char* name) {
    Problems problems;
    const auto found = get<T>(name, problems);
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

  // A struct for each row, of numbers that `columns()` names; what it does not name is as in Row{}.
  template <class Row>
  std::vector<Row> read_rows() {
    std::vector<Row> rows;
    Problems problems;
    each_field(Row::columns(), [&](const auto& one) {
      using Field = std::remove_cvref_t<decltype(std::declval<Row&>().*one.value)>;
      const auto values = get<typename NumbersOf<Field>::type>(one.name, problems);
      if (rows.empty()) rows.resize(values.size());
      if (values.size() != rows.size()) return;  // a problem
      for (std::size_t i = 0; i < rows.size(); ++i) rows[i].*one.value = static_cast<Field>(values[i]);
    });
    problems.raise(what_);
    return rows;
  }

 private:
  template <class T>
  std::span<const T> get(const std::string& name, Problems& problems) {
    Array<T> array(0);
    if (!take(table_, name, problems, array)) return {};
    if (rows_ < 0 && array.ndim() == 1) rows_ = array.shape(0);
    if (array.ndim() != 1 || array.shape(0) != rows_) {
      problems.add(name + ": expected a one-dimensional array of length " + std::to_string(rows_));
      return {};
    }
    held_.append(array);
    return {array.data(), static_cast<std::size_t>(rows_)};
  }

  template <class T>
  void fill(std::span<const T>& to, const std::string& name, Problems& problems) {
    to = get<T>(name, problems);
  }
  // Of a point: the name, followed by x, y and z.
  template <class T>
  void fill(std::array<std::span<const T>, 3>& to, const std::string& name, Problems& problems) {
    for (std::size_t axis = 0; axis < 3; ++axis) fill(to[axis], name + "xyz"[axis], problems);
  }

  py::dict table_;
  const char* what_;
  py::ssize_t rows_;
  py::list held_;
};

}  // namespace cgemit::bindings
