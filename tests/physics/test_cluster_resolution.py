"""Cluster positions of a sample of helices have the resolutions that geometry demands, and errors to match."""

import numpy as np
import pytest

import gem_toy
from cgemit import _core
from cgemit.reconstruction.clusterers.binary import error_table
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from stats import assert_within, fraction_error

PITCH = 0.65


def rms_error(sample):
    """Standard error of the RMS of a sample, from its fourth moment."""
    return np.std(sample**2) / (2 * np.sqrt(np.mean(sample**2)) * np.sqrt(len(sample)))


class Sample:
    """Residuals of the clusters of 1 GeV/c muons from the origin, cos(theta) uniform in +-0.93, in 1 T."""

    def __init__(self, gap, n=60_000):
        layers = gem_toy.design_layers(drift_gap=gap)
        detector = gem_toy.core_detector(cgem=layers)
        truths = gem_toy.muons_through(layers, n, seed=11)
        err_x, err_v = error_table(layers, -1.0, ClusterSettings())
        values = {"gain": 12_000.0, "w_values": np.full(3, 0.0259), "threshold": 1.7}
        digis = _core.simulation.read_out_strips(detector, truths, gem_toy.no_steps(), **values)
        found = _core.reconstruction.find_clusters(detector, digis, err_x=err_x, err_v=err_v, by_charge=False)
        self.layers, self.truths = layers, truths
        self.x = self.view(found, 0)
        self.v = self.view(found, 1)

    def view(self, found, view):
        """Residual, size, layer and error of the clusters whose truth lies on the sheet with its whole segment."""
        rows = {name: column[found["view"] == view] for name, column in found.items()}
        truth, layer, sheet = rows["truth"], rows["layer"], rows["sheet"]
        r, edge = self.layers["r_readout"][layer], self.layers["phi_first"][layer, sheet]
        width = self.layers["strips_x"][layer] * PITCH
        centre = edge + 0.5 * width / r
        phi = self.truths["phi"][truth]
        from_centre = r * np.angle(np.exp(1j * (phi - centre)))
        far = np.maximum(np.abs(self.truths["entry_z"][truth]), np.abs(self.truths["exit_z"][truth]))
        whole = (np.abs(from_centre) < 0.5 * width - 1.0) & (far < self.layers["z_max"][layer])
        if view == 0:
            residual = r * np.angle(np.exp(1j * (rows["phi"] - phi)))
        else:
            stereo = self.layers["stereo"][layer]
            z_ref = np.copysign(self.layers["z_max"][layer], stereo)
            x = 0.5 * width + from_centre
            residual = rows["v"] - x * np.cos(stereo) - (z_ref - self.truths["z"][truth]) * np.sin(stereo)
        error = rows["err_x" if view == 0 else "err_v"]
        return {"residual": residual, "size": rows["size"], "layer": layer, "error": error, "whole": whole}


@pytest.fixture(scope="module", params=[5.0, 3.0], ids=["5 mm", "3 mm"])
def sample(request):
    """A sample for each drift gap, with its expected X RMS (um) and single-strip fraction."""
    expected = {5.0: (138.7, 0.805), 3.0: (156.7, 0.884)}
    return Sample(request.param), *expected[request.param]


def test_x_resolution_and_single_strips(sample):
    """An independent projection of arXiv:1504.02570: 138.7 um and 0.805 for 5 mm, 156.7 um and 0.884 for 3 mm."""
    made, rms, single = sample
    residual = 1e3 * made.x["residual"][made.x["whole"]]
    fraction = np.mean(made.x["size"] == 1)
    # That calculation quotes 0.5 um; its fraction has three digits.
    assert_within(np.sqrt(np.mean(residual**2)), rms, np.hypot(rms_error(residual), 0.5))
    assert_within(fraction, single, np.hypot(fraction_error(single, len(residual)), 0.0005))


def test_v_resolution_is_that_of_two_independent_edges(sample):
    """Pitch/sqrt(24) = 132.7 um, whatever the gap: first and last strip have independent phases."""
    made, *_ = sample
    residual = 1e3 * made.v["residual"][made.v["whole"]]
    assert_within(np.sqrt(np.mean(residual**2)), 650 / np.sqrt(24), np.hypot(rms_error(residual), 0.3))


def test_pulls_have_unit_width_in_every_size_class(sample):
    """Residual over error by view, layer and number of strips: mean 0, RMS 1."""
    made, *_ = sample
    classes = 0
    for view in (made.x, made.v):
        pull = (view["residual"] / view["error"])[view["whole"]]
        layer, size = view["layer"][view["whole"]], view["size"][view["whole"]]
        for i in range(3):
            for strips in np.unique(size[layer == i]):
                chosen = pull[(layer == i) & (size == strips)]
                if len(chosen) < 100:
                    continue
                classes += 1
                assert_within(np.sqrt(np.mean(chosen**2)), 1.0, rms_error(chosen), what=f"layer {i}, {strips} strips")
                assert_within(chosen.mean(), 0.0, 1 / np.sqrt(len(chosen)), what=f"layer {i}, {strips} strips")
    assert classes >= 25


def test_pull_test_sees_wrong_errors(sample):
    """One error for all sizes, the RMS of the whole sample, fails in the classes."""
    made, *_ = sample
    single = made.x["whole"] & (made.x["size"] == 1)
    pull = made.x["residual"][single] / np.sqrt(np.mean(made.x["residual"][made.x["whole"]] ** 2))
    with pytest.raises(AssertionError):
        assert_within(np.sqrt(np.mean(pull**2)), 1.0, rms_error(pull))
