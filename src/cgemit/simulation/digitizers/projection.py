"""Analog readout without drift physics: charge profiles of the projected path (second model of arXiv:1504.02570)."""

from __future__ import annotations

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import w_values
from cgemit.detector.readouts import ProjectionReadout
from cgemit.simulation.digitizers.digitizer import Digitizer
from cgemit.tables import Table


class ProjectionDigitizer(Digitizer):
    """Integrates a charge profile along the projected path over each strip, and adds noise."""

    readout: ProjectionReadout

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold, see `Digitizer.digitize`."""
        one = self.readout
        digis = _core.read_out_profiles(
            compiled(detector), dict(truths.columns), dict(steps.columns), gain=one.gain, w_values=w_values(detector),
            sigma=one.sigma, threshold=one.threshold, noise=one.noise, seed=seed, gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)
