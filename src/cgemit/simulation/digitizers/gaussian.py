"""Gaussian readout: positions smeared with given errors, so that the exact result of the later stages is known."""

from __future__ import annotations

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.gas import w_values
from cgemit.detector.parts import MeasurementLayer
from cgemit.detector.readouts import GaussianReadout
from cgemit.simulation.digitizers.digitizer import Digitizer
from cgemit.tables import Table


class GaussianDigitizer(Digitizer):
    """Measures one X and one V position of each crossing; steps move nothing."""

    readout: GaussianReadout

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the positions, see `Digitizer.digitize`."""
        one = np.ones(len(detector.layers))
        errors = {"sigma_x": self.readout.sigma_x * one, "sigma_v": self.readout.sigma_v * one}
        digis = _core.smear_positions(
            compiled(detector), dict(truths.columns), gain=self.readout.gain, w_values=w_values(detector),
            errors=errors | {"efficiency": one, "sigma_time": 0.0 * one}, seed=seed, first_place=0,
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)


def measured_positions(detector: Detector, truths: Table, seed: int) -> Table:
    """Return the positions that measurement layers measure; a layer without an error measures middles of strips.

    Parameters
    ----------
    detector : Detector
    truths : Table
        Crossings of measurement layers.
    seed : int
    """
    found = np.zeros((4, len(detector.layers)))
    for number, layer in enumerate(detector.layers):
        if isinstance(layer, MeasurementLayer):
            found[:, number] = layer.sigma_x, layer.sigma_v, layer.efficiency, layer.sigma_time
    digis = _core.smear_positions(
        compiled(detector), dict(truths.columns), gain=0.0, w_values=w_values(detector), seed=seed,
        first_place=len(detector.cgem),  # a Gaussian readout sees CGEM layers alone, numbered from 0
        errors=dict(zip(("sigma_x", "sigma_v", "efficiency", "sigma_time"), found.copy(), strict=True)),
    )  # fmt: skip
    return Table("digis", digis, **truths.cover)
