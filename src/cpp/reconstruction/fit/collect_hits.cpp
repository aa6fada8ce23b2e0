#include "reconstruction/fit/collect_hits.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <tuple>

#include "readout/cluster_rows.hpp"

namespace cgemit {

namespace {

struct Entry {
  std::uint8_t kind;
  std::int8_t side;
  std::int32_t surface, layer, channel, size;
  double value, sigma, k, x;
  std::int64_t row;

  // The row comes last, so that the order of the hits does not depend on the order of the tables.
  auto order() const { return std::tuple(surface, channel, kind, std::bit_cast<std::int64_t>(value), row); }
  bool repeats(const Entry& before) const { return kind == before.kind && row == before.row; }
};

class Collector {
 public:
  Collector(const Detector& detector, const CandidateInput& candidates, const ClusterInput& clusters,
            const WireInput& wires)
      : layers_(detector.layers),
        rules_(detector),
        candidates_(candidates),
        clusters_(clusters),
        wires_(wires) {}

  CollectedHits run() {
    count();
    for (std::size_t i = 0; i < candidates_.mass.size(); ++i) {
      const double mass = candidates_.mass[i];
      if (!(mass > 0 && mass < HUGE_VAL))
        problems_.add("candidates row " + std::to_string(i) + ": mass: got " + to_text(mass) +
                      ", expected a finite number above 0, GeV/c2");
    }
    for (std::size_t i = 0; i + 1 < first_.size(); ++i) collect(i);
    if (!problems_.empty()) {
      const HitView view{hits_.kind,  hits_.layer, hits_.channel, hits_.size, hits_.value,
                         hits_.sigma, hits_.k,     hits_.x,       hits_.side, hits_.hit};
      add_problems(rules_, view, problems_);
      problems_.raise("hits of candidates");
    }
    return std::move(hits_);
  }

 private:
  // Lists the hits of each candidate, and makes room for them.
  void count() {
    const std::size_t n = candidates_.event.size();
    first_.assign(n + 1, 0);
    hits_.offsets.assign(n + 1, 0);
    std::vector<std::uint8_t> there(candidates_.view.size());
    for (std::size_t i = 0; i < there.size(); ++i) {
      if (!is_there(i)) continue;
      there[i] = 1;
      const auto after = static_cast<std::size_t>(candidates_.candidate[i]) + 1;
      ++first_[after];
      hits_.offsets[after] += candidates_.view[i] == point_view ? 2 : 1;
    }
    for (std::size_t i = 1; i <= n; ++i) {
      first_[i] += first_[i - 1];
      hits_.offsets[i] += hits_.offsets[i - 1];
    }
    chosen_.resize(first_.back());
    std::vector<std::size_t> next(first_.begin(), first_.end() - 1);
    for (std::size_t i = 0; i < there.size(); ++i) {
      if (there[i] != 0)
        chosen_[next[static_cast<std::size_t>(candidates_.candidate[i])]++] = i;
      else
        explain(i);
    }
    const auto room = static_cast<std::size_t>(hits_.offsets.back());
    hits_.kind.resize(room);
    hits_.side.resize(room);
    for (auto* values : {&hits_.layer, &hits_.channel, &hits_.size}) values->resize(room);
    for (auto* values : {&hits_.value, &hits_.sigma, &hits_.k, &hits_.x}) values->resize(room);
    hits_.hit.resize(room);
  }

  void collect(std::size_t candidate) {
    entries_.clear();
    for (std::size_t i = first_[candidate]; i < first_[candidate + 1]; ++i) add(chosen_[i]);
    sort(candidate);
    if (!clusters_.corr_xv.empty() && problems_.empty()) part_views();
    auto i = static_cast<std::size_t>(hits_.offsets[candidate]);
    for (const Entry& entry : entries_) {
      hits_.kind[i] = entry.kind;
      hits_.side[i] = entry.side;
      hits_.layer[i] = entry.layer;
      hits_.channel[i] = entry.channel;
      hits_.size[i] = entry.size;
      hits_.value[i] = entry.value;
      hits_.sigma[i] = entry.sigma;
      hits_.k[i] = entry.k;
      hits_.x[i] = entry.x;
      hits_.hit[i] = entry.row;
      ++i;
    }
  }

  std::span<const std::int64_t> events(std::int8_t view) const {
    return view == wire_view ? wires_.event : clusters_.event;
  }

  // Whether a hit refers to a candidate and to a row of its kind, all of the same event.
  bool is_there(std::size_t i) const {
    const std::int8_t view = candidates_.view[i];
    if (view < 0 || view > point_view) return false;
    const auto candidate = static_cast<std::size_t>(candidates_.candidate[i]),
               row = static_cast<std::size_t>(candidates_.hit[i]);  // negative: beyond any size
    const auto table = events(view);
    if (candidate >= candidates_.event.size() || row >= table.size()) return false;
    const std::int64_t event = candidates_.event[candidate];
    const bool is_kind =
        view == wire_view || clusters_.view[row] == std::min(view, static_cast<std::int8_t>(2));
    return is_kind && event == candidates_.hit_event[i] && event == table[row];
  }

  void explain(std::size_t i) {
    const std::int8_t view = candidates_.view[i];
    const std::int64_t candidate = candidates_.candidate[i], row = candidates_.hit[i];
    const auto add = [&](const std::string& name, std::int64_t got, const std::string& expected) {
      problems_.add("candidate_hits row " + std::to_string(i) + ": " + name + ": got " + std::to_string(got) +
                    ", expected " + expected);
    };
    const auto below = [](std::size_t n) { return "0 to " + std::to_string(n) + " (excluded)"; };
    const bool known = static_cast<std::size_t>(candidate) < candidates_.event.size();
    if (!known) add("candidate", candidate, below(candidates_.event.size()) + ", rows of candidates");
    if (view < 0 || view > point_view) return add("view", view, "0 (X), 1 (V), 2 (wire) or 3 (XV cluster)");
    const auto table = events(view);
    const std::string name = view == wire_view ? "wire_hits" : "clusters";
    if (static_cast<std::size_t>(row) >= table.size())
      return add("hit", row, below(table.size()) + ", rows of " + name);
    const auto at = static_cast<std::size_t>(row);
    if (view != wire_view && clusters_.view[at] != std::min(view, static_cast<std::int8_t>(2)))
      add("view", view,
          "that of clusters row " + std::to_string(row) + ", whose view is " +
              std::to_string(clusters_.view[at]));
    if (table[at] != candidates_.hit_event[i])
      add("event", candidates_.hit_event[i],
          "that of " + name + " row " + std::to_string(row) + ", " + std::to_string(table[at]));
    if (known && candidates_.event[static_cast<std::size_t>(candidate)] != candidates_.hit_event[i])
      add("event", candidates_.hit_event[i],
          "that of candidates row " + std::to_string(candidate) + ", " +
              std::to_string(candidates_.event[static_cast<std::size_t>(candidate)]));
  }

  void add(std::size_t i) {
    const std::int8_t view = candidates_.view[i];
    const std::int64_t number = candidates_.hit[i];
    const auto row = static_cast<std::size_t>(number);
    const auto put = [&](Entry entry) {
      entry.surface = rules_.surface(entry.kind, entry.layer);
      entries_.push_back(entry);
    };
    if (view == wire_view) {
      put({2, wires_.side[row], 0, wires_.layer[row], wires_.wire[row], 0, wires_.drift[row],
           wires_.sigma[row], 0, 0, number});
      return;
    }
    const std::int32_t layer = clusters_.layer[row], sheet = clusters_.sheet[row];
    const double x = clusters_.x[row], v = clusters_.v[row];
    const double err_x = clusters_.err_x[row], err_v = clusters_.err_v[row];
    if (view == 0) return put({0, 0, 0, layer, sheet, clusters_.size[row], x, err_x, 0, 0, number});
    if (view == 1) return put({1, 0, 0, layer, sheet, clusters_.size[row], v, err_v, 0, 0, number});
    // The strips of an XV cluster belong to two others, so its errors are its own.
    const double covariance = clusters_.cov_xv.empty() ? 0 : clusters_.cov_xv[row];
    put({0, 0, 0, layer, sheet, 0, x, err_x, 0, 0, number});
    if (err_x > 0 && !(std::abs(covariance) < err_x * err_v)) {
      problems_.add("clusters row " + std::to_string(number) + ": cov_xv: got " + to_text(covariance) +
                    ", expected less in size than err_x err_v, " + to_text(err_x * err_v));
    }
    const double k = covariance == 0 ? 0 : covariance / (err_x * err_x);
    const double sigma = k == 0 ? err_v : std::sqrt(err_v * err_v - k * covariance);
    put({1, 0, 0, layer, sheet, 0, k == 0 ? v : v - k * x, sigma, k, k == 0 ? 0 : x, number});
  }

  void sort(std::size_t candidate) {
    const auto before = [](const Entry& a, const Entry& b) { return a.order() < b.order(); };
    if (!std::ranges::is_sorted(entries_, before)) std::ranges::sort(entries_, before);
    for (std::size_t j = 1; j < entries_.size(); ++j) {
      if (!entries_[j].repeats(entries_[j - 1])) continue;
      problems_.add("candidates row " + std::to_string(candidate) + ": got " +
                    (entries_[j].kind == 2 ? "wire_hits" : "clusters") + " row " +
                    std::to_string(entries_[j].row) + " twice, expected once");
    }
  }

  // Whether X and V of one sheet cross on it, or hardly beyond its ends. At a seam of a sheet with itself
  // they may be from the two sides of the seam, which share no electrons.
  bool cross(const Entry& x, const Entry& v) const {
    constexpr double margin = 10;  // mm
    const int index = rules_.index(x.kind, x.layer);
    if (index < 0) return false;
    const MeasuringLayer& layer = layers_[static_cast<std::size_t>(index)];
    return layer.ends.hold(crossing_z(layer, x.value, v.value), margin);
  }

  // Takes from each V cluster what it has in common with the X cluster of the same crossing: one with no
  // other cluster of the sheet in the candidate.
  void part_views() {
    const auto alike = [&](std::size_t a, std::size_t b) {
      return entries_[a].surface == entries_[b].surface && entries_[a].channel == entries_[b].channel;
    };
    for (std::size_t j = 1; j < entries_.size(); ++j) {
      const Entry& x = entries_[j - 1];
      Entry& v = entries_[j];
      const bool pair = x.kind == 0 && v.kind == 1 && alike(j - 1, j) && (j < 2 || !alike(j - 2, j)) &&
                        (j + 1 == entries_.size() || !alike(j, j + 1));
      if (!pair || x.row == v.row || !cross(x, v)) continue;  // of one row: an XV cluster
      const double rho = clusters_.corr_xv[static_cast<std::size_t>(v.row)];
      if (!(std::abs(rho) < 1)) {
        problems_.add("clusters row " + std::to_string(v.row) + ": corr_xv: got " + to_text(rho) +
                      ", expected a number between -1 and 1");
      } else if (rho != 0 && x.sigma > 0) {
        v.k = rho * v.sigma / x.sigma;
        v.x = x.value;
        v.value -= v.k * x.value;
        v.sigma *= std::sqrt(1 - rho * rho);
      }
    }
  }

  const std::vector<MeasuringLayer>& layers_;
  HitRules rules_;
  const CandidateInput& candidates_;
  const ClusterInput& clusters_;
  const WireInput& wires_;
  std::vector<std::size_t> first_, chosen_;  // rows of the hits of each candidate, and where they begin
  std::vector<Entry> entries_;               // of one candidate
  CollectedHits hits_;
  Problems problems_;
};

}  // namespace

CollectedHits collect_hits(const Detector& detector, const CandidateInput& candidates,
                           const ClusterInput& clusters, const WireInput& wires) {
  return Collector(detector, candidates, clusters, wires).run();
}

}  // namespace cgemit
