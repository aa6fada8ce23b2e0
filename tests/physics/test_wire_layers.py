"""Wire layers with drift relations and zero times of their own: raw times, fitted start times, and wrong ones."""

import numpy as np

import cgemit as cg
from tests.helpers.stats import assert_within

PLAIN = cg.load("besiii-cgem")
#: Every second layer is half as fast near the wire, and 12 ns late.
OWN = PLAIN.with_overrides(
    {
        f"drift_chamber.layers.{layer.number}.{key}": value
        for layer in PLAIN.drift_chamber.layers[::2]
        for key, value in (("drift_velocity", "25 um/ns"), ("t0", "12 ns"))
    }
)
RAW = cg.Settings(
    digitize=cg.DigitizeSettings(wire_times="raw"),
    background=cg.BackgroundSettings(start_time=3.0),
    refine=cg.RefineSettings(drift_times="raw", start_time="fitted"),
)


def test_raw_times_and_start_times_of_layers_that_differ() -> None:
    """Chi-square and start times are as those of a chamber with one relation; one relation for all is far off."""
    gun, n = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 150
    plain = cg.run(PLAIN, gun, n, 6, settings=RAW)
    own = cg.run(OWN, gun, n, 6, settings=RAW)
    wrong = cg.run(OWN, gun, n, 6, settings=RAW, fit_detector=PLAIN)
    ratio = [float((one.tracks["chi2"] / one.tracks["ndf"]).mean()) for one in (plain, own, wrong)]
    assert abs(ratio[1] - ratio[0]) < 0.06
    assert ratio[2] > 2 * ratio[0]
    pulls = []
    for one in (plain, own):
        assert (one.start_times["status"] == 0).sum() > 0.97 * n
        true = cg.simulation.background.start_times(one.start_times["event"], 3.0, 6)
        pulls.append((one.start_times["start_time"] - true) / one.start_times["err_start_time"])
        assert_within(pulls[-1].mean(), 0.0, pulls[-1].std() / np.sqrt(n))
    assert abs(pulls[1].std() - pulls[0].std()) < 0.15


def test_a_zero_time_that_the_fit_does_not_know_moves_the_drift_distances() -> None:
    """Residuals of the late layers are v t0 = 0.3 mm towards larger distances: 25 um/ns times 12 ns."""
    late = {f"drift_chamber.layers.{layer.number}.t0": "12 ns" for layer in PLAIN.drift_chamber.layers[::2]}
    real = PLAIN.with_overrides({"drift_chamber.drift_velocity": "25 um/ns"})
    gun, n = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 100
    settings = cg.Settings(fit=cg.FitSettings(outlier_pull=0.0, residuals=True))
    made = cg.run(real.with_overrides(late), gun, n, 6, fit_detector=real, settings=settings)
    numbers = [layer.number for layer in PLAIN.drift_chamber.layers[::2]]
    wire = made.residuals["view"] == 2
    hit, side = made.residuals["hit"][wire], made.residuals["side"][wire]
    is_late = np.isin(made.wire_hits["layer"][hit], numbers)
    off = (made.residuals["residual"][wire] * side)[(np.abs(side) == 1) & is_late]
    others = (made.residuals["residual"][wire] * side)[(np.abs(side) == 1) & ~is_late]
    assert abs(np.median(off) - 0.3) < 0.05
    assert abs(np.median(others)) < 0.05
