"""Analog readouts: ionization electrons drift and multiply, a chip measures charge and time of each strip."""

from __future__ import annotations

from typing import Any

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import drift_columns, w_values
from cgemit.detector.induction import WAY, induced_charges
from cgemit.detector.readouts import AnalogReadout, chip_arguments
from cgemit.simulation.digitizers.digitizer import Digitizer
from cgemit.tables import Table


class AnalogDigitizer(Digitizer):
    """Follows every ionization electron to the strips, and filters their currents as the chip of the readout does."""

    readout: AnalogReadout

    @property
    def needs_steps(self) -> bool:
        """True: electrons start where the particle ionized."""
        return True

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold with charge and time, see `Digitizer.digitize`."""
        digis = _core.read_out_analog(
            compiled(detector), dict(truths.columns), dict(steps.columns), **self.core_arguments(detector), seed=seed,
            gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)

    def core_arguments(self, detector: Detector) -> dict[str, Any]:
        """Return the arguments of the compiled digitization by name, except tables, seed and gains.

        Parameters
        ----------
        detector : Detector

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        one = self.readout
        layers = {
            "hole_pitch": np.array([layer.hole_pitch if one.holes else 0.0 for layer in detector.cgem]),
            "w_value": w_values(detector),
        }
        return {
            "drift": drift_columns(detector) | layers,
            "physics": {
                "survival": one.survival,
                "gain": one.gain,
                "polya": one.polya if one.gain_fluctuation else np.inf,
                "diffusion": one.diffusion,
                "first_gain": one.first_gain,
                "lorentz": one.lorentz,
            },
            "chip": chip_arguments(one),
            "share_spread": one.share_spread,
            "way": WAY,
            "induced": induced_charges(detector, one.diffusion, one.lorentz),
        }
