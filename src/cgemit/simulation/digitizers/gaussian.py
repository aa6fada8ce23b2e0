"""Gaussian read-out: positions smeared with given errors, so that the exact result of the later stages is known."""

from __future__ import annotations

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.gas import w_values
from cgemit.detector.readouts import GaussianReadout
from cgemit.simulation.digitizers.digitizer import Digitizer
from cgemit.tables import Table


class GaussianDigitizer(Digitizer):
    """Measures one X and one V position of each crossing; steps move nothing."""

    readout: GaussianReadout

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the positions, see `Digitizer.digitize`."""
        digis = _core.smear_positions(
            compiled(detector), dict(truths.columns), gain=self.readout.gain, w_values=w_values(detector),
            sigma_x=self.readout.sigma_x, sigma_v=self.readout.sigma_v, seed=seed,
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)
