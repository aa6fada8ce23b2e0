"""Chunks in two threads give what one thread gives, with every kind of kernel; run under the thread sanitizer, too."""

from __future__ import annotations

import numpy as np
import pytest

from cgemit.chain.executor import Workers
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings

GUN = Gun("mu-", p=(0.15, 1.5), cos_theta=(-0.9, 0.9)) + Gun("e+", p=0.3, cos_theta=(-0.5, 0.5))
KINDS = {
    "default": Settings(fit=FitSettings(residuals=True)),
    "smeared, sides known": Settings(
        simulate=SimulateSettings(fluctuations="gaussian"),
        digitize=DigitizeSettings(readout="gaussian", reveal_sides=True),
        fit=FitSettings(cluster_errors="cluster"),
    ),
    "holes, every step": Settings(simulate=SimulateSettings(foil="lattice", sublayers=True, steps=True)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_two_threads_on_one_detector(kind: str) -> None:
    """Eight chunks at a time on one compiled detector: the same bytes as all events in one call."""
    one, two = (
        run("besiii-cgem-design", GUN, 80, seed=7, settings=KINDS[kind], workers=Workers(threads=threads, chunk=chunk))
        for threads, chunk in ((1, 80), (2, 10))
    )
    assert len(one.tracks) == 160
    for name, table in one.tables.items():
        assert table == two.tables[name], name
    assert np.any(one.tracks["status"] == 0)
