"""The files of resolution scans: one table, one summary and one picture of all detectors and methods."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from cgemit.detector import Detector
from cgemit.io.folders import SUMMARY, new_folder
from cgemit.record import gun_data, record, write_record
from cgemit.statistics.curves import Line
from cgemit.statistics.formatting import write_csv
from cgemit.statistics.forms import FormFit
from cgemit.study.samples import Order, momentum_of
from cgemit.values import InTurn
from cgemit.version import VERSION


class AnyScan(Protocol):
    """What the files need of a scan, simulated or analytic."""

    @property
    def method(self) -> str:
        """``"mc"`` or ``"analytic"``."""

    @property
    def detector(self) -> Detector:
        """The detector."""

    @property
    def orders(self) -> Sequence[Order]:
        """Detector, gun, settings and number of events at each momentum asked for."""

    @property
    def lines(self) -> list[Line]:
        """Resolutions of d_rho, d_z and p against momentum."""

    @property
    def fits(self) -> list[FormFit]:
        """The usual forms, fitted to them."""

    @property
    def seed(self) -> int:
        """Seed of the events."""

    @property
    def seconds(self) -> float:
        """Wall time."""

    @property
    def hits(self) -> str:
        """How hits came to their tracks; empty without events."""

    @property
    def removed(self) -> Mapping[str, Mapping[str, int]]:
        """Tracks that did not fit, by sample and status."""

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of the CSV table."""


def summary_of(scans: Sequence[AnyScan]) -> dict[str, Any]:
    """Return what `summary.json` holds: the curves of all detectors and methods, for the same gun."""
    simulated = [scan for scan in scans if scan.method == "mc"]
    first = scans[0].orders[0]
    cos_theta = first.gun.cos_theta
    if isinstance(cos_theta, InTurn):
        cos_theta = list(cos_theta.values)
    inputs: dict[str, Any] = {
        "detectors": list(_detectors(scans)), "particle": first.gun.particle, "cos_theta": cos_theta,
        "momenta": [momentum_of(order) for order in scans[0].orders],
    }  # fmt: skip
    if simulated:
        inputs["events"] = simulated[0].orders[0].n_events
    methods = {scan.method for scan in scans}
    inputs |= {"method": methods.pop() if len(methods) == 1 else "both", "settings": first.settings.to_dict()}
    if simulated:
        inputs["hits"] = simulated[0].hits
    return {
        "program": "cgemit",
        "version": VERSION,
        "inputs": inputs,
        "seed": scans[0].seed,
        "timings": {"total_s": sum(scan.seconds for scan in scans)},
        "removed": {label: dict(counts) for scan in scans for label, counts in scan.removed.items()},
        "curves": [line.as_json() for scan in scans for line in scan.lines],
        "fits": [fit.as_json() for scan in scans for fit in scan.fits],
    }


def save_scans(
    scans: Sequence[AnyScan], folder: str | os.PathLike[str], *, overwrite: bool = False, command: str = ""
) -> Path:
    """Write what `Scan.save` writes, for several detectors and methods: one table and one picture of all.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Same gun and momenta; detectors of distinct names, each with one scan of a method. Of several detectors, each
        is written to a file of its own, ``detector-1-NAME.toml``.
    folder : path
    overwrite : bool
    command : str
        Command line for run.json, if there was one.

    Raises
    ------
    OutputExistsError
        If the folder holds files and `overwrite` is false.
    """
    from cgemit.draw.curves import draw_resolutions

    detectors = _detectors(scans)
    with new_folder(folder, overwrite=overwrite) as place:
        write_csv(place / "resolution.csv", columns_of(scans))
        for number, (name, detector) in enumerate(detectors.items(), start=1):
            which = f"-{number}-" + re.sub(r"[^\w.-]+", "-", name)[:60] if len(detectors) > 1 else ""
            (place / f"detector{which}.toml").write_text(detector.to_toml(), encoding="utf-8")
        labels = ("σ(d_ρ)", "σ(d_z)", "σ(p)")
        panels = list(zip(labels, zip(*(scan.lines for scan in scans), strict=True), strict=True))
        draw_resolutions(panels, "p").save(place / "resolution")
        write_record(_record(scans, command), place)
        (place / SUMMARY).write_text(json.dumps(summary_of(scans), indent=2) + "\n", encoding="utf-8")
    return Path(folder)


def columns_of(scans: Sequence[AnyScan]) -> dict[str, list[Any]]:
    """Return the columns of the CSV table; cells are empty where a method has no such number.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
    """
    tables = [scan.columns() for scan in scans]
    names = dict.fromkeys(name for table in tables for name in table)
    sizes = [len(next(iter(table.values()))) for table in tables]
    return {
        name: [cell for table, size in zip(tables, sizes, strict=True) for cell in table.get(name, [""] * size)]
        for name in names
    }


def fits_text(scans: Sequence[AnyScan]) -> str:
    """Return the fits of the usual forms to some scans, one a line; empty with fewer than three momenta.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Of one detector.
    """
    kinds = {"mc": "simulated", "analytic": "analytic"}
    return "\n".join(f"{kinds[scan.method]}: {fit}" for scan in scans for fit in scan.fits)


def _detectors(scans: Sequence[AnyScan]) -> dict[str, Detector]:
    return {scan.detector.name: scan.detector for scan in scans}


def _record(scans: Sequence[AnyScan], command: str) -> dict[str, Any]:
    """Return what `run.json` holds: settings and detectors, and the gun of each sample and line."""
    source = []
    for scan in scans:
        for order in scan.orders:
            about: dict[str, Any] = {"label": order.label, "detector": order.detector.name, "gun": gun_data(order.gun)}
            about |= {"events": order.n_events, "seed": order.seed}
            source.append(about if scan.method == "mc" else about | {"method": scan.method})
    return record(
        detectors=_detectors(scans), settings=scans[0].orders[0].settings, seed=scans[0].seed, source=source,
        command=command,
    )  # fmt: skip
