"""Simulated and analytic resolutions side by side."""

from __future__ import annotations

from cgemit.statistics.formatting import text_table, with_error
from cgemit.study.analytic_scan import AnalyticScan
from cgemit.study.samples import fitted, momentum_name
from cgemit.study.scan_table import counts_text, shot_text
from cgemit.study.scans import QUOTED_PARAMETERS, Scan

_HEAD = ("sigma(d_rho) [um]", "sigma(d_z) [mm]", "sigma(p) [MeV/c]")


def compared(simulated: Scan, line: AnalyticScan) -> str:
    """Return a table of simulated and analytic core widths side by side, with their ratio.

    Parameters
    ----------
    simulated : Scan
    line : AnalyticScan
        Of the same detector and momenta.
    """
    first = line.orders[0]
    cells = [[f"{p:g}" for p in line.momenta]]
    head = [f"{momentum_name(first)} [GeV/c]"]
    for name, text, points in zip(QUOTED_PARAMETERS, _HEAD, simulated.lines, strict=True):
        expected = line.at(name)
        head += [text, "analytic", "ratio"]
        cells.append([with_error(*pair) for pair in zip(points.y, points.y_error, strict=True)])
        cells.append([with_error(value, 0.0) for value in expected])
        ratios = zip(points.y / expected, points.y_error / expected, strict=True)
        cells.append([with_error(*pair) for pair in ratios])
    head += ["fitted", "not fitted"]
    cells.append([f"{fitted(sample)}/{sample.n_events}" for sample in simulated.samples])
    cells.append([counts_text(sample.removed) for sample in simulated.samples])
    title = (
        f"{first.detector.name}, {shot_text(first)}: core widths, simulated "
        f"({simulated.samples[0].n_events} events at each momentum) and analytic, ratio simulated/analytic"
    )
    table = text_table(title, head, [list(row) for row in zip(*cells, strict=True)])
    return "\n".join([table, *filter(None, [simulated.note(), line.note()])])
