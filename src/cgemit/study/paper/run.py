"""The run that reproduces the paper: samples, numbers, figures and files."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from cgemit.analysis.quantities import MAIN
from cgemit.base.files import SUMMARY, check_free, new_folder
from cgemit.base.validate import check_numbers
from cgemit.chain import run
from cgemit.chain.record import write_record
from cgemit.chain.settings import FinderLike, Settings
from cgemit.detector import Detector, load
from cgemit.detector.reader import readout_of
from cgemit.detector.readouts import Readout
from cgemit.particles.gun import Gun
from cgemit.study.evaluation import (
    Point,
    Sample,
    ShowProgress,
    guns_of,
    hardly_fitted,
    points_at,
    record_of,
    run_samples,
    why_unfitted,
)
from cgemit.study.paper.results import COS_THETA, DETECTORS, MOMENTA, THIN_GAP, Inputs, Reproduction, make_rows
from cgemit.study.scan import line_of

_EVENTS, _QUICK_EVENTS, _FEWEST_EVENTS = 20_000, 1_500, 400
_SHARE = 4  # each momentum of the curves gets this part of the events
_DISPLAY_EVENTS = 200  # among which the event that is drawn is looked for


def reproduce(
    output: str | os.PathLike[str] | None = None,
    *,
    events: int | None = None,
    seed: int = 1,
    threads: int | None = None,
    quick: bool = False,
    pdf: bool = False,
    settings: Settings | None = None,
    readout: Readout | str | Mapping[str, Any] | None = None,
    field: str | os.PathLike[str] | None = None,
    finder: FinderLike = "truth",
    overwrite: bool = False,
    command: str = "",
    progress: ShowProgress | None = None,
) -> Reproduction:
    """Reproduce the paper: mu- in its CGEM tracker and in the inner drift chamber.

    Parameters
    ----------
    output : path or None
        Folder for figures, tables, `summary.json`, `run.json` and `report.html`; nothing is written if None.
    events : int, optional
        Events at 1 GeV/c for each detector, at least 400; each of the ten momenta gets a quarter of it. Default
        20 000, or 1500 with `quick`.
    seed : int
    threads : int, optional
        Default: all cores. The numbers do not depend on it.
    quick : bool
        Fewer events.
    pdf : bool
        Whether to write the figures as PDF too.
    settings : Settings, optional
        Of all stages, to try another model of matter.
    readout : Readout, str or mapping, optional
        Of the CGEM layers, as of `cgemit.run`.
    field : str or path, optional
        Another magnetic field than the detectors' own (see `Detector.with_field`).
    finder : "truth", "ckf" or callable
        How hits come to their tracks, as of `cgemit.run`.
    overwrite : bool
        Whether to replace the results in a folder that holds nothing else.
    command : str
        Command line for run.json, if there was one.
    progress : callable, optional
        Called with the share that is done (0 to 1) and what is running.

    Returns
    -------
    Reproduction

    Raises
    ------
    OutputExistsError
        If the folder holds files and `overwrite` is false.
    ValueError
        If events, seed or threads are no such numbers, there is no such field, or too few tracks are fitted at 1 GeV/c.

    Examples
    --------
    >>> study = cg.study.reproduce(events=400)  # 20 000 by default
    >>> [(row.id, row.unit) for row in study.results if row.id in ("sigma_dr", "sigma_dz", "sigma_p")]
    [('sigma_dr', 'um'), ('sigma_dz', 'mm'), ('sigma_p', 'MeV/c')]
    """
    events = events if events is not None else _QUICK_EVENTS if quick else _EVENTS
    check_numbers("study", seed, threads, events=(events, _FEWEST_EVENTS, 2**31 - 1))
    if output is not None:
        check_free(output, overwrite=overwrite)
    inputs = Inputs(
        events, events // _SHARE, seed, threads, quick, settings or Settings(), None if field is None else str(field),
        finder, None if readout is None else readout_of(readout),
    )  # fmt: skip
    if output is None:
        return _measure(inputs, progress)
    # Loading what draws takes half a second: beside the runs, between which a core is idle.
    loading = threading.Thread(target=import_module, args=("cgemit.study.paper.figures",), daemon=True)
    loading.start()
    study = _measure(inputs, progress)
    loading.join()  # processes that draw are copies of this one only if it has no other threads
    return _write(study, Path(output), pdf, overwrite, command, progress)


def _measure(inputs: Inputs, progress: ShowProgress | None) -> Reproduction:
    start = time.perf_counter()
    cgem, idc = (_load(name, inputs.field, inputs.readout) for name in DETECTORS)
    thin = cgem.with_overrides({f"cgem.{layer.label}.drift_gap": f"{THIN_GAP:g} mm" for layer in cgem.cgem})
    gun = Gun("mu-", p=1.0, cos_theta=COS_THETA)
    main = [
        Point(
            f"{name}, 1 GeV/c sample", detector, gun, inputs.events, inputs.seed, inputs.settings, finder=inputs.finder
        )
        for name, detector in ((cgem.name, cgem), (idc.name, idc), (f"{cgem.name} with a {THIN_GAP:g} mm gap", thin))
    ]
    scans = [_scan_points(detector, inputs) for detector in (cgem, idc)]
    # Of all events that many are in the samples at 1 GeV/c, which come first: without them there is nothing to show.
    part = 0.85 * len(main) * inputs.events / sum(order.n_events for order in [*main, *scans[0], *scans[1]])
    samples = run_samples(main, threads=inputs.threads, progress=_share(progress, 0.0, part))
    if few := hardly_fitted(samples):
        raise ValueError("\n".join(f"{sample.label}: {why_unfitted([sample])}" for sample in few))
    named = dict(zip(("cgem", "idc", "gap"), samples, strict=True))
    samples += run_samples([*scans[0], *scans[1]], threads=inputs.threads, progress=_share(progress, part, 0.85))
    curve_samples = {"cgem": tuple(samples[3 : 3 + len(MOMENTA)]), "idc": tuple(samples[3 + len(MOMENTA) :])}
    lines = [line_of(scan, name) for name in MAIN for scan in curve_samples.values()]
    # Events have the same random numbers however many are run: these are the first ones of the sample.
    display = run.run(
        cgem, gun, _DISPLAY_EVENTS, inputs.seed, settings=inputs.settings, finder=inputs.finder, workers=inputs.threads
    )
    timings = {"run_s": time.perf_counter() - start, **_stage_seconds(samples)}
    rows = make_rows(named)
    return Reproduction(tuple(rows), tuple(lines), inputs, named, curve_samples, display, timings)


def _load(name: str, field: str | None, readout: Readout | None) -> Detector:
    """Return a detector under its own name, whatever its field and readout."""
    found = load(name) if field is None else replace(load(name).with_field(field), name=name)
    return found if readout is None else found.with_readout(readout)


def _scan_points(detector: Detector, inputs: Inputs) -> list[Point]:
    guns = guns_of("mu-", {"p": MOMENTA, "cos_theta": [COS_THETA]})
    return points_at(
        [detector] * len(guns), guns, events=inputs.events_per_momentum, seed=inputs.seed, settings=inputs.settings,
        finder=inputs.finder,
    )  # fmt: skip


def _share(progress: ShowProgress | None, low: float, high: float) -> ShowProgress | None:
    if progress is None:
        return None
    return lambda fraction, label: progress(low + (high - low) * fraction, label)


def _stage_seconds(samples: Sequence[Sample]) -> dict[str, float]:
    stages = samples[0].timings.keys() - {"wall"}
    return {f"{stage}_thread_s": sum(s.timings[stage] for s in samples) for stage in sorted(stages)}


def _write(
    study: Reproduction, output: Path, pdf: bool, overwrite: bool, command: str, progress: ShowProgress | None
) -> Reproduction:
    """Write all files, and return the study with its folder and the time that writing took."""
    # matplotlib is loaded only where pictures are drawn; the import takes as long as a thousand events.
    from cgemit.study.paper.figures import write_figures
    from cgemit.study.paper.report import paper_report

    start = time.perf_counter()
    with new_folder(output, overwrite=overwrite) as folder:
        write_figures(study, folder, pdf, _share(progress, 0.85, 1.0))
        seconds = time.perf_counter() - start
        timings = {**study.timings, "figures_s": seconds, "total_s": study.timings["run_s"] + seconds}
        study = replace(study, timings=timings, folder=output)
        (folder / "report.html").write_text(paper_report(study, folder), encoding="utf-8")
        write_record(record_of(study.every_sample, study.inputs.seed, command), folder)
        (folder / SUMMARY).write_text(json.dumps(study.summary(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return study
