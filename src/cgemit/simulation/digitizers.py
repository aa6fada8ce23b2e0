"""Digitizers: the halves of readouts that make digis of true crossings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.detector import ReadoutGroup, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import drift_columns, w_values
from cgemit.detector.induction import WAY, induced_charges
from cgemit.detector.readouts import (
    AnalogReadout,
    BinaryReadout,
    PositionReadout,
    Precision,
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
    def digitize(self, group: ReadoutGroup, truths: Table, steps: Table, seed: int) -> Table:
        """Return the table ``digis`` of the crossings, by event, layer, sheet and view.

        Parameters
        ----------
        group : ReadoutGroup
            Layers with this readout. Layers and strips (gid) have the numbers of the whole detector in all tables.
        truths, steps : Table
            Of its layers. Steps are linked to the truths and in their order.
        seed : int
            Key of the random numbers.
        """


class BinaryDigitizer(Digitizer):
    """Fires the strips that the projected path touches (arXiv:1504.02570); nothing is drawn."""

    readout: BinaryReadout

    def digitize(self, group: ReadoutGroup, truths: Table, steps: Table, seed: int) -> Table:
        """Return the fired strips, see `Digitizer.digitize`."""
        digis = _core.simulation.read_out_strips(
            compiled(group.detector), dict(truths.columns), dict(steps.columns), gain=self.readout.gain,
            w_values=w_values(group.detector), threshold=self.readout.threshold, gains=gain_table(group.detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)


class ProjectionDigitizer(Digitizer):
    """Integrates a charge profile along the projected path over each strip, and adds noise.

    The second model of arXiv:1504.02570, without drift physics.
    """

    readout: ProjectionReadout

    def digitize(self, group: ReadoutGroup, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold, see `Digitizer.digitize`."""
        readout = self.readout
        digis = _core.simulation.read_out_profiles(
            compiled(group.detector), dict(truths.columns), dict(steps.columns), gain=readout.gain,
            w_values=w_values(group.detector), sigma=readout.sigma, threshold=readout.threshold, noise=readout.noise,
            seed=seed, gains=gain_table(group.detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)


class PositionDigitizer(Digitizer):
    """Measures one X and one V position of each crossing, as exactly as the readout says; steps move nothing."""

    readout: PositionReadout

    def digitize(self, group: ReadoutGroup, truths: Table, steps: Table, seed: int) -> Table:
        """Return the positions, see `Digitizer.digitize`."""
        rows = [self.readout.precision(layer.precision) for layer in group.layers]
        digis = _core.simulation.smear_positions(
            compiled(group.detector), dict(truths.columns), gain=self.readout.gain, w_values=w_values(group.detector),
            errors=group.columns(Precision._fields, rows), seed=seed,
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)


class AnalogDigitizer(Digitizer):
    """Follows every ionization electron to the strips, and filters their currents as the chip of the readout does."""

    readout: AnalogReadout

    @property
    def needs_steps(self) -> bool:
        """True: electrons start where the particle ionized."""
        return True

    def digitize(self, group: ReadoutGroup, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold with charge and time, see `Digitizer.digitize`."""
        digis = _core.simulation.read_out_analog(
            compiled(group.detector), dict(truths.columns), dict(steps.columns), **self.core_arguments(group),
            seed=seed, gains=gain_table(group.detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)

    def core_arguments(self, group: ReadoutGroup) -> dict[str, Any]:
        """Return the arguments of the compiled digitization by name, except tables, seed and gains.

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        readout, detector, numbers = self.readout, group.detector, group.numbers
        holes = np.array([layer.hole_pitch if readout.holes else 0.0 for layer in group.cgem])
        drift = drift_columns(detector, numbers) | {"hole_pitch": holes}
        induced, reach = induced_charges(detector, readout.diffusion, readout.lorentz, numbers)
        return {
            # The core checks all layers. Others have numbers that it accepts, and induce nothing.
            "drift": {name: group.among_all(column, fill=1.0) for name, column in drift.items()}
            | {"w_value": w_values(detector)},
            "physics": {
                "survival": readout.survival,
                "gain": readout.gain,
                "polya": readout.polya if readout.gain_fluctuation else np.inf,
                "diffusion": readout.diffusion,
                "first_gain": readout.first_gain,
                "lorentz": readout.lorentz,
            },
            "chip": chip_arguments(readout),
            "share_spread": readout.share_spread,
            "way": WAY,
            "induced": (group.among_all(induced, 2, fill=0.0), reach),
        }
