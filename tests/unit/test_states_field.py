"""States in field maps: the uniform field's in a constant map, one track everywhere in vacuum, Jacobians by scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled, load, slabs
from cgemit.reconstruction.fit import FitStatus
from cgemit.reconstruction.states import StateStatus, Surface
from fields import HARMONIC, harmonic_by_hand, small_map
from oracles import LIGHT
from tracks import MUON, hits_on, without_matter

UNIFORM = load("besiii-cgem-design")
EVEN = UNIFORM.with_field({"kind": "harmonic", "bz": "-1 T", "b": "0 /m2", "tolerance": "1e-9 mm"})
# A field that falls by a third: terms that a weak gradient would hide count.
FALLING = {"bz": -0.98, "b": 0.6e-6, "q": -0.251e-12}
UNEVEN = UNIFORM.with_field(
    {"kind": "harmonic", "bz": "-0.98 T", "b": "0.6 /m2", "q": "-0.251 /m4", "tolerance": "1e-9 mm"}
)
COIL = UNIFORM.with_field(
    {"kind": "solenoid", "bz": "-1 T", "coil_radius": "1490 mm", "half_length": "1770 mm", "tolerance": "1e-9 mm"}
)
ORIGIN = np.zeros(3)
# dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
HELICES = np.array([(0.3, 0.4, 1.0, 5.0, 0.02), (-0.5, -2.9, -0.2, -20.0, 1.1), (-20.0, 1.7, -1 / 0.2, 30.0, -0.7)])
SIGMA = np.array([0.2, 1e-3, 3e-3, 0.3, 1e-3])
EVERY_RADIUS = (31.5, 100.0, 424.0, 790.0)
CYLINDER = int(Surface.cylinder)


def covariances(n, seed=1):
    """Return covariances whose parameters have errors of the usual sizes, all correlated."""
    root = np.random.default_rng(seed).normal(size=(n, 5, 5)) * SIGMA[:, None] / 2
    return root @ root.transpose(0, 2, 1)


def go(core, radius, helices=HELICES, cov=None, pivot=ORIGIN):
    """Take helices to a cylinder by the compiled module."""
    n = len(helices)
    cov = np.reshape(covariances(n) if cov is None else cov, (n, 25))
    return _core.extrapolate(
        core, pivot=np.broadcast_to(pivot, (n, 3)), helix=helices, cov=cov,
        mass=np.full(n, MUON), radius=radius, share=np.zeros(n), target_share=0.0,
    )  # fmt: skip


def on(core, start, radius):
    """Take what `go` returned to another cylinder."""
    return go(core, radius, start["helix"], start["cov"], start["pivot"])


def assert_close(found, expected, place=1e-9, parameters=1e-9, cov=1e-8):
    """Compare points in mm, helices with SIGMA = 1 and covariances by their diagonal."""
    assert np.all(found["status"] == StateStatus.ok)
    np.testing.assert_allclose(found["pivot"], expected["pivot"], rtol=0, atol=place)
    difference = found["helix"] - expected["helix"]
    difference[:, 1] = np.remainder(difference[:, 1] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(difference / SIGMA).max() < parameters
    sigma = np.sqrt(np.diagonal(expected["cov"], axis1=1, axis2=2))
    assert np.abs((found["cov"] - expected["cov"]) / (sigma[:, :, None] * sigma[:, None, :])).max() < cov


@pytest.mark.parametrize("matter", [False, True])
@pytest.mark.parametrize("radius", EVERY_RADIUS)
def test_extrapolation_in_a_constant_map_is_that_of_the_uniform_field(radius, matter):
    """Outward and back in, through all matter or none."""
    uniform, constant = (compiled(d) if matter else without_matter(d) for d in (UNIFORM, EVEN))
    expected, found = go(uniform, radius), go(constant, radius)
    assert_close(found, expected, parameters=1e-8)
    assert_close(on(constant, found, 25.0), on(uniform, expected, 25.0), parameters=1e-8)


def fitted_states(core, detector, surfaces, offset=0.0):
    """Return smoothed states of tracks about HELICES whose hits lie `offset` sigma beside them, in turn."""
    hits = [hits_on(detector, helix) for helix in HELICES]
    columns = {name: np.concatenate([one[name] for one in hits]) for name in hits[0]}
    predicted = [
        _core._testing.reference(core, helix, MUON, one)["predicted"] for helix, one in zip(HELICES, hits, strict=True)
    ]
    beside = np.concatenate([np.cos(np.arange(len(one))) for one in predicted])
    reference = HELICES + np.array([0, np.pi / 2, 0, 0, 0])
    return _core.states(
        core, hit_offsets=np.cumsum([0, *map(len, predicted)]),
        hits=columns | {
            "used": np.ones(len(beside), np.uint8), "used_variance": columns["sigma"] ** 2,
            "used_value": np.concatenate(predicted) + offset * columns["sigma"] * beside,
        },
        reference=reference, prior=np.tile(np.diag([200.0, 0.5, 5.0, 1000.0, 2.0]).ravel() ** 2, (len(HELICES), 1)),
        kinks=np.zeros((len(HELICES), 2 * len(slabs(detector)))),
        mass=np.full(len(HELICES), MUON), fitted=np.ones(len(HELICES), np.uint8),
        targets={
            "surface": np.array([surface for surface, _ in surfaces], np.int8),
            "radius": np.array([radius for _, radius in surfaces]), "share": np.zeros(len(surfaces)),
        },
    )  # fmt: skip


SURFACES = [(0, 0.0), (1, 0.0), *((CYLINDER, radius) for radius in (*EVERY_RADIUS, 800.0)), (int(Surface.hit), 0.0)]


@pytest.mark.parametrize("density", [0.0, 1.0])
def test_states_in_a_constant_map_are_those_of_the_uniform_field(density):
    """Of the same fit, at the origin, on every cylinder and at every hit, with residuals.

    With matter, a displaced track loses its momentum after the same path in one, on the same cylinder in the other.
    """
    expected, found = (
        fitted_states(without_matter(detector, density), UNIFORM, SURFACES, offset=0.5) for detector in (UNIFORM, EVEN)
    )
    assert np.abs(expected["residual"][expected["hit"] >= 0]).max() > 0.05
    exact = density == 0
    assert_close(found, expected, *((1e-9, 1e-8, 1e-8) if exact else (1e-4, 1e-3, 1e-3)))
    for name in ("residual", "err"):
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-8 if exact else 1e-4)


@pytest.mark.parametrize("detector", [UNEVEN, COIL], ids=["harmonic", "solenoid"])
def test_there_and_back(detector):
    """Without matter, a state that went out and came back is what it was."""
    core = without_matter(detector)
    for outer in (424.0, 790.0):
        start = go(core, 31.5)
        assert_close(on(core, on(core, start, outer), 31.5), start, 1e-7, 1e-7, 1e-7)


@pytest.mark.parametrize("detector", [UNEVEN, COIL], ids=["harmonic", "solenoid"])
def test_in_vacuum_all_surfaces_have_one_track(detector):
    """Smoothed states, by derivatives from the origin, are the state at the origin moved there."""
    core = without_matter(detector)
    states = fitted_states(core, detector, SURFACES)
    at = {surface: {name: states[name][states["target"] == i] for name in states} for i, surface in enumerate(SURFACES)}
    origin = at[0, 0.0]
    assert_close(on(core, at[1, 0.0], 100.0), on(core, origin, 100.0), 1e-7, 1e-7, 1e-7)
    for radius in (*EVERY_RADIUS, 800.0):
        assert_close(at[CYLINDER, radius], on(core, origin, radius), 1e-7, 1e-7, 1e-7)
    hits = at[int(Surface.hit), 0.0]
    outward = on(core, hits, 800.0)
    expected = on(core, {name: origin[name][hits["track"]] for name in origin}, 800.0)
    assert_close(outward, expected, 1e-6, 1e-6, 1e-6)


def integrated(parameters, end, radius):
    """Helix of a track by scipy: where it leaves a cylinder, or closest to the axis through `end` if there is one."""
    dr, phi0, kappa, dz, tanl = parameters
    start = [dr * np.cos(phi0), dr * np.sin(phi0), dz, *(np.array([-np.sin(phi0), np.cos(phi0), tanl]) / abs(kappa))]
    total = np.linalg.norm(start[3:])

    def motion(_, s):
        force = LIGHT * np.sign(kappa) * np.cross(s[3:] / total, harmonic_by_hand(*s[:3], **FALLING))
        return np.concatenate([s[3:] / total, force])

    def arrived(path, s):
        if end is None:
            return s[0] ** 2 + s[1] ** 2 - radius**2
        return (s[0] - end[0]) * s[3] + (s[1] - end[1]) * s[4] if path > 0.9 * radius else -1.0

    arrived.terminal, arrived.direction = True, 1
    events = solve_ivp(motion, (0, 3 * radius), start, "DOP853", rtol=1e-12, atol=1e-12, events=arrived, max_step=50)
    x, y, z, px, py, pz = events.y_events[0][0]
    pivot, pt = np.array([x, y, z]) if end is None else end, np.hypot(px, py)
    azimuth = np.arctan2(-px, py)
    across = (x - pivot[0]) * np.cos(azimuth) + (y - pivot[1]) * np.sin(azimuth)
    return pivot, np.array([across, azimuth, np.sign(kappa) / pt, z - pivot[2], pz / pt])


@pytest.mark.parametrize("number", range(len(HELICES)))
@pytest.mark.parametrize("radius", [100.0, 424.0])
def test_jacobian_by_numerical_differentiation(number, radius):
    """Point, helix and covariance are those of tracks that scipy integrates, the covariance by their differences."""
    helix, cov = HELICES[number : number + 1], covariances(1, seed=number)
    found = go(without_matter(UNEVEN), radius, helix, cov)
    end, expected = integrated(helix[0], None, radius)
    columns = []
    for i, step in enumerate(0.02 * SIGMA):
        ahead, behind = (integrated(helix[0] + sign * step * np.eye(5)[i], end, radius)[1] for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    jacobian = np.stack(columns, axis=1)
    truth = {"pivot": end[None], "helix": expected[None], "cov": (jacobian @ cov[0] @ jacobian.T)[None]}
    assert_close(found, truth, 1e-7, 1e-6, 1e-6)
    # The uniform field's Jacobian would not do.
    even = go(without_matter(UNEVEN.with_overrides({"field.kind": "uniform"})), radius, helix, cov)["cov"][0]
    assert np.abs(even / truth["cov"][0] - 1).max() > 1e-3


def test_a_way_out_of_the_map_has_its_status(tmp_path):
    """Beyond the edge there is no state; below the closest approach there is none either, for another reason."""
    detector = UNIFORM.with_field(small_map(tmp_path))
    settings = cg.Settings(fit=cg.FitSettings(states=("origin", 10.0, "beam_pipe", 300.0, 600.0, "hits")))
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3), vertex=(0.0, 15.0, 0.0))
    result = cg.run(detector, gun, 20, seed=2, settings=settings)
    assert np.all(result.tracks["status"] == FitStatus.ok)
    states = result.states
    at = states["surface"] == Surface.cylinder
    inside = at & (states["r"] == 10.0)
    outside = at & (states["r"] == 600.0)
    assert {*states["status"][inside]} == {StateStatus.ok, StateStatus.does_not_reach}
    assert np.all(states["status"][outside] == StateStatus.left_field)
    assert np.all(states["status"][~inside & ~outside] == StateStatus.ok)
    assert np.isnan(states["x"][outside]).all()
    start = states[at & (states["r"] == 300.0)]
    assert np.all(cg.extrapolate(detector, start, 501.0)["status"] == StateStatus.left_field)
    assert np.all(cg.extrapolate(detector, start, 499.0)["status"] == StateStatus.ok)
    assert {*cg.extrapolate(detector, start, 10.0)["status"]} == {StateStatus.ok, StateStatus.does_not_reach}
    # One that begins outside.
    beyond = cg.extrapolate(detector.with_field(HARMONIC), start, 600.0)
    assert np.all(cg.extrapolate(detector, beyond, 300.0)["status"] == StateStatus.left_field)
    # The map ends in z, too.
    steep = start.with_columns(tanl=np.full(len(start), 20.0))
    assert np.all(cg.extrapolate(detector, steep, 499.0)["status"] == StateStatus.left_field)


@pytest.mark.parametrize("field", [HARMONIC, "finite-solenoid"])
def test_states_of_a_run_hold_together(field):
    """Points on their cylinders, positive definite covariances, and pulls of hits as in the residuals table."""
    radii = (10.0, 50.0, 250.0, 500.0, 900.0)
    settings = cg.Settings(fit=cg.FitSettings(states=("origin", "beam_line", *radii, "hits"), residuals=True))
    gun = cg.Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.8, 0.8), vertex_sigma=(1.0, 1.0, 5.0))
    result = cg.run(UNIFORM.with_field(field), gun, 30, seed=5, settings=settings)
    states = result.states
    good = states[states["status"] == StateStatus.ok]
    assert len(good) > 0.95 * len(states)
    cylinders = good[good["surface"] == Surface.cylinder]
    np.testing.assert_allclose(np.hypot(cylinders["x"], cylinders["y"]), cylinders["r"])
    sigma = np.sqrt(np.diagonal(good["cov"], axis1=1, axis2=2))
    assert np.linalg.eigvalsh(good["cov"] / (sigma[:, :, None] * sigma[:, None, :])).min() > 1e-4
    origin = states[states["surface"] == Surface.origin]
    for name in ("dr", "kappa", "dz", "tanl"):
        np.testing.assert_allclose(origin[name], result.tracks[name], rtol=1e-9, atol=1e-9)
    hits = states[(states["surface"] == Surface.hit) & (states["status"] == StateStatus.ok)]
    rows = result.residuals
    keys = (np.stack([table[name] for name in ("track", "view", "hit")], axis=1) for table in (hits, rows))
    np.testing.assert_array_equal(*keys)
    np.testing.assert_allclose(hits["pull"], rows["pull"], rtol=0, atol=1e-5)
