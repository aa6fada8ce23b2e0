"""Interface of a digitizer: the half of a readout that makes digis of true crossings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from cgemit.detector import Detector
from cgemit.detector.readouts import Readout
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
