"""Binary readout: touched strips fire (arXiv:1504.02570)."""

from __future__ import annotations

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import w_values
from cgemit.detector.readouts import BinaryReadout
from cgemit.simulation.digitizers.digitizer import Digitizer
from cgemit.tables import Table


class BinaryDigitizer(Digitizer):
    """Fires the strips that the projected path touches; nothing is drawn."""

    readout: BinaryReadout

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the fired strips, see `Digitizer.digitize`."""
        digis = _core.read_out_strips(
            compiled(detector), dict(truths.columns), dict(steps.columns), gain=self.readout.gain,
            w_values=w_values(detector), threshold=self.readout.threshold, gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)
