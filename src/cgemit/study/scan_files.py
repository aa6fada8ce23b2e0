"""The files of resolution scans: one table, one summary and one picture of all detectors and methods."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Protocol

from cgemit.detector import Detector
from cgemit.finders import finder_name
from cgemit.gun_data import gun_data
from cgemit.io.folders import SUMMARY, new_folder
from cgemit.record import record, write_record
from cgemit.statistics.curves import Line
from cgemit.statistics.formatting import Tabular, html_table, text_table, write_csv
from cgemit.statistics.forms import FormFit
from cgemit.study.samples import Order, angle_of, momentum_name, momentum_of
from cgemit.study.scan_table import difference_columns
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
    def all_lines(self) -> list[Line]:
        """Resolutions of all quantities."""

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
    def readout(self) -> str:
        """The read-out of the CGEM layers; empty for a detector without them."""

    @property
    def removed(self) -> Mapping[str, Mapping[str, int]]:
        """Tracks that did not fit, by sample and status."""

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of the CSV table."""


class ScanBase(Tabular):
    """What simulated and analytic scans share: their text, their summary and their files."""

    @property
    def readout(self: AnyScan) -> str:
        """The read-out of the CGEM layers; empty for a detector without them."""
        first = self.orders[0]
        return str(first.settings.digitize.readout.name) if first.detector.cgem else ""

    def summary(self: AnyScan) -> dict[str, Any]:
        """Return what `summary.json` holds."""
        return summary_of([self])

    def save(self: AnyScan, folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write resolution.csv, summary.json, run.json, the detector and the curves as PNG and PDF.

        Parameters
        ----------
        folder : path
        overwrite : bool

        Raises
        ------
        OutputExistsError
            If the folder holds files and `overwrite` is false.
        """
        return save_scans([self], folder, overwrite=overwrite)

    def note(self) -> str:
        """Return the momenta at which there are hardly any tracks, and why; empty if there are enough everywhere."""
        raise NotImplementedError

    def _table(self) -> tuple[str, Sequence[str], list[list[str]]]:
        """Return title, head and rows of the text."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return "\n".join([text_table(*self._table()), *filter(None, [self.note()])])

    def _repr_html_(self) -> str:
        note = f"<p>{escape(self.note())}</p>" if self.note() else ""
        return html_table(*self._table()) + note


def summary_of(scans: Sequence[AnyScan]) -> dict[str, Any]:
    """Return what `summary.json` holds: the curves of all detectors and methods, for the same gun."""
    simulated = [scan for scan in scans if scan.method == "mc"]
    first = scans[0].orders[0]
    angle = angle_of(first)[0]
    value = getattr(first.gun, angle)
    particles = list(dict.fromkeys(scan.orders[0].gun.particle for scan in scans))
    inputs: dict[str, Any] = {"detectors": list(_detectors(scans))}
    inputs |= {"particle": particles[0]} if len(particles) == 1 else {"particles": particles}
    inputs[angle] = list(value.values) if isinstance(value, InTurn) else value
    inputs["momenta" if momentum_name(first) == "p" else "pt"] = [momentum_of(order) for order in scans[0].orders]
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
        "curves": [line.as_json() for scan in scans for line in scan.all_lines],
        "fits": [fit.as_json() for scan in scans for fit in scan.fits],
    }


def save_scans(
    scans: Sequence[AnyScan], folder: str | os.PathLike[str], *, overwrite: bool = False, command: str = ""
) -> Path:
    """Write what `Scan.save` writes, for several detectors and methods: one table and one picture of all.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Same angles and momenta; each detector and particle with one scan of a method, detectors of distinct names. Of
        several detectors, each is written to a file of its own, ``detector-1-NAME.toml``.
    folder : path
    overwrite : bool
    command : str
        Command line for run.json, if there was one.

    Raises
    ------
    OutputExistsError
        If the folder holds files and `overwrite` is false.
    """
    from cgemit.draw.scans import resolutions

    detectors = _detectors(scans)
    with new_folder(folder, overwrite=overwrite) as place:
        write_csv(place / "resolution.csv", columns_of(scans))
        for number, (name, detector) in enumerate(detectors.items(), start=1):
            which = f"-{number}-" + re.sub(r"[^\w.-]+", "-", name)[:60] if len(detectors) > 1 else ""
            (place / f"detector{which}.toml").write_text(detector.to_toml(), encoding="utf-8")
        resolutions(scans).save(place / "resolution")
        write_record(_record(scans, command), place)
        (place / SUMMARY).write_text(json.dumps(summary_of(scans), indent=2) + "\n", encoding="utf-8")
    return Path(folder)


def columns_of(scans: Sequence[AnyScan]) -> dict[str, list[Any]]:
    """Return the columns of the CSV table; cells are empty where a method has no such number.

    Simulated scans beside one of another detector and the same particle have columns of the differences to the first.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
    """
    pairs = [(scan, base_of(scan, scans)) for scan in scans]
    tables = [
        scan.columns() | ({} if base is None else difference_columns(scan.orders, base.orders))  # type: ignore[arg-type]
        for scan, base in pairs
    ]
    names = dict.fromkeys(name for table in tables for name in table)
    sizes = [len(next(iter(table.values()))) for table in tables]
    return {
        name: [cell for table, size in zip(tables, sizes, strict=True) for cell in table.get(name, [""] * size)]
        for name in names
    }


def base_of(scan: AnyScan, scans: Sequence[AnyScan]) -> AnyScan | None:
    """Return the simulated scan of the first detector with the same particle and events; None for itself."""
    if scan.method != "mc":
        return None
    particle = scan.orders[0].gun.particle
    first = next(one for one in scans if one.method == "mc" and one.orders[0].gun.particle == particle)
    return None if first is scan else first


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
            about |= {} if order.finder == "truth" else {"finder": finder_name(order.finder)}
            source.append(about if scan.method == "mc" else about | {"method": scan.method})
    return record(
        detectors=_detectors(scans), settings=scans[0].orders[0].settings, seed=scans[0].seed, source=source,
        command=command,
    )  # fmt: skip
