"""Digitization: truths become fired strips, passages of drift cells drift distances (docs/methods/digitize.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.kinds import NotNegative, Positive
from cgemit.settings import SettingsData
from cgemit.tables import Table

Readout = Literal["binary", "gaussian"]

#: Drift distance (mm) against drift time (ns) of the outer drift chamber's cells: medians of reconstructed hits of
#: BESIII (BOSS 7.2.0 files published with pybes3), with the wire itself put at time 0. Straight lines between the
#: points; the outermost ones are continued.
XT_DISTANCE = np.array([0.0, 0.5, 1.2, 2.0, 2.8, 3.45, 4.7, 5.75, 6.9, 7.9, 8.3])
XT_TIME = np.array([0.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0])


@dataclass(frozen=True, kw_only=True)
class DigitizeSettings(SettingsData):
    """How CGEM layers and wires are read out.

    Attributes
    ----------
    readout : str
        ``"binary"``: touched strips fire (arXiv:1504.02570). ``"gaussian"``: no strips, positions at mid-gap are
        smeared with `sigma_x` and `sigma_v`.
    gain : float
        Electrons on the anode per electron of ionization; effective gain of the triple GEM.
    w_value : float
        keV of deposited energy per electron of ionization; 25.9 eV in Ar/iC4H10 90/10 (HEED).
    threshold : float
        fC; a truth whose total charge is smaller fires nothing (binary).
    sigma_x : float
        mm, error of X = r_readout dphi (gaussian). Default: RMS of the binary read-out for 1 GeV/c muons, 5 mm gap.
    sigma_v : float
        mm, error of V (gaussian). Default: the same, pitch/sqrt(24) at 0.65 mm.
    reveal_sides : bool
        Whether wire hits tell on which side of the wire the particle passed.

    Raises
    ------
    ValueError
        Listing every value that makes no sense.
    """

    readout: Readout = "binary"
    gain: Positive = 12_000.0
    w_value: Positive = 0.0259
    threshold: NotNegative = 1.7
    sigma_x: Positive = 0.1387
    sigma_v: Positive = 0.1327
    reveal_sides: bool = False


def digitize(
    detector: Detector,
    truths: Table,
    wire_truths: Table,
    settings: DigitizeSettings | None = None,
    seed: int = 0,
    *,
    steps: Table | None = None,
) -> dict[str, Table]:
    """Read out the CGEM layers and the wires.

    Parameters
    ----------
    detector : Detector
    truths : Table
        Of kind ``truths``.
    wire_truths : Table
        Of kind ``wire_truths``, of the same events.
    settings : DigitizeSettings or None
    seed : int
        Key of the random numbers. They depend on seed, event, particle, layer and wire, on nothing else.
    steps : Table or None
        Of kind ``steps``, linked to `truths` and in their order: delta electrons deposit where they went (binary).
        Without it, all energy of a truth lies between entry and exit.

    Returns
    -------
    dict of str to Table
        ``digis`` and ``wire_hits``; with the read-out ``gaussian``, `digis` is empty and there are ``clusters``.

    Raises
    ------
    ValueError
        If a layer or wire is not in the detector, a value is not finite, or a step does not belong to its truth or has
        values that no step has.
    """
    settings = settings or DigitizeSettings()
    core = compiled(detector)
    columns = dict(truths.columns)
    events = (truths.n_events, truths.first_event)
    hits = _core.read_out_wires(
        core, dict(wire_truths.columns), xt_distance=XT_DISTANCE, xt_time=XT_TIME,
        reveal_sides=settings.reveal_sides, seed=seed,
    )  # fmt: skip
    tables = {"wire_hits": Table("wire_hits", hits, *events)}
    if settings.readout == "binary":
        digis = _core.read_out_strips(
            core, columns, dict((Table.empty("steps", *events) if steps is None else steps).columns),
            gain=settings.gain, w_value=settings.w_value, threshold=settings.threshold,
        )  # fmt: skip
        return {"digis": Table("digis", digis, *events), **tables}
    smeared = _core.smear_positions(
        core, columns, gain=settings.gain, w_value=settings.w_value,
        sigma_x=settings.sigma_x, sigma_v=settings.sigma_v, seed=seed,
    )  # fmt: skip
    return {"digis": Table.empty("digis", *events), **tables, "clusters": Table("clusters", smeared, *events)}
