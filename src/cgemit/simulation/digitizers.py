"""Digitizers: the halves of readouts that make digis of true crossings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import drift_columns, w_values
from cgemit.detector.induction import WAY, induced_charges
from cgemit.detector.parts import MeasurementLayer
from cgemit.detector.readouts import (
    AnalogReadout,
    BinaryReadout,
    GaussianReadout,
    ProjectionReadout,
    Readout,
    chip_arguments,
)
from cgemit.tables import Table


@dataclass(frozen=True)
class Digitizer(ABC):
    """Makes the digis of a readout; `cgemit.simulation.digitize.DIGITIZERS` finds it by the readout's class.

    Attributes
    ----------
    readout : Readout
    """

    readout: Readout

    @property
    def needs_steps(self) -> bool:
        """Whether it starts from the ionization clusters of ``SimulateSettings(steps=True)``."""
        return False

    @abstractmethod
    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the table ``digis`` of the crossings, by event, layer, sheet and view.

        Parameters
        ----------
        detector : Detector
        truths, steps : Table
            Steps are linked to the truths and in their order.
        seed : int
            Key of the random numbers.
        """


class BinaryDigitizer(Digitizer):
    """Fires the strips that the projected path touches (arXiv:1504.02570); nothing is drawn."""

    readout: BinaryReadout

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the fired strips, see `Digitizer.digitize`."""
        digis = _core.read_out_strips(
            compiled(detector), dict(truths.columns), dict(steps.columns), gain=self.readout.gain,
            w_values=w_values(detector), threshold=self.readout.threshold, gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)


class ProjectionDigitizer(Digitizer):
    """Integrates a charge profile along the projected path over each strip, and adds noise.

    The second model of arXiv:1504.02570, without drift physics.
    """

    readout: ProjectionReadout

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold, see `Digitizer.digitize`."""
        one = self.readout
        digis = _core.read_out_profiles(
            compiled(detector), dict(truths.columns), dict(steps.columns), gain=one.gain, w_values=w_values(detector),
            sigma=one.sigma, threshold=one.threshold, noise=one.noise, seed=seed, gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)


class GaussianDigitizer(Digitizer):
    """Measures one X and one V position of each crossing with given errors; steps move nothing."""

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
