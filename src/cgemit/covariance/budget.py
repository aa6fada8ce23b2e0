"""The error budget: the exact split of a variance by measurement and scatterer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.covariance.tracks import QUANTITIES, Tracks
from cgemit.detector import Detector
from cgemit.detector.parts import CgemLayer
from cgemit.detector.slabs import slabs
from cgemit.statistics.formatting import html_table, text_table
from cgemit.tables.convert import data_frame

Floats = npt.NDArray[np.float64]

By = Literal["source", "part", "material", "cause"]
#: Causes of uncertainty.
MEASUREMENT, SCATTERING, STRAGGLING, PRIOR = "measurement", "scattering", "straggling", "prior"


@dataclass(frozen=True)
class Source:
    """What makes one term of the budget.

    Attributes
    ----------
    name : str
        Of the term, such as ``"L1 X"`` or ``"L1 foils scattering"``.
    part : str
        Of the detector.
    cause : str
        ``"measurement"``, ``"scattering"``, ``"straggling"`` or ``"prior"`` (of the filter, negligible).
    materials : tuple of (str, float)
        Of a scatterer, each with its share of the term: of X/X0 for scattering, of Landau's xi for straggling.
    """

    name: str
    part: str
    cause: str
    materials: tuple[tuple[str, float], ...] = ()


def sources(detector: Detector) -> tuple[Source, ...]:
    """Return the terms of a detector's budgets, in the order of the core.

    Parameters
    ----------
    detector : Detector
    """
    found = [Source(f"{layer.label} {view}", layer.label, MEASUREMENT) for layer in detector.cgem for view in "XV"]
    chamber = detector.drift_chamber
    if chamber is not None:
        found += [Source(f"wires {layer.number}", "wires", MEASUREMENT) for layer in chamber.layers]
    for slab in slabs(detector):
        first = slab.shells[0]
        of_layer = first.group in ("cathode", "drift", "foils", "anode")
        inside = [layer.label for layer in detector.cgem if of_layer and _contains(layer, first.r_in)]
        part = inside[0] if inside else first.group
        name = f"{part} {first.group}" if inside else f"{first.group} {first.r_in:.5g} mm"
        for cause, weight in ((SCATTERING, "x0"), (STRAGGLING, "xi")):
            total = getattr(slab, weight)
            shares: dict[str, float] = {}
            for shell in slab.shells:
                material = shell.material.name
                shares[material] = shares.get(material, 0.0) + getattr(shell, weight) / total
            found.append(Source(f"{name} {cause}", part, cause, tuple(shares.items())))
    return (*found, Source("prior", "prior", PRIOR))


def _contains(layer: CgemLayer, radius: float) -> bool:
    shells = list(layer.shells())
    return min(s.r_in for s in shells) <= radius + 1e-9 and radius < max(s.r_out for s in shells)


@dataclass(frozen=True, eq=False, repr=False)
class Budget:
    """The variance of one quantity, split exactly by its sources.

    Attributes
    ----------
    quantity, unit : str
        Variances are in the square of `unit`.
    sources : tuple of Source
    p, cos_theta : ndarray, float64
        Of the points.
    variances : ndarray, shape of the points + (sources,) float64
        They sum to the mean variance of each point.
    detector, particle : str
    """

    quantity: str
    unit: str
    sources: tuple[Source, ...]
    p: Floats
    cos_theta: Floats
    variances: Floats
    detector: str
    particle: str

    @property
    def total(self) -> Floats:
        """Mean variance of each point."""
        return np.asarray(self.variances.sum(axis=-1))

    def grouped(self, by: By = "part") -> dict[str, Floats]:
        """Return the variances of groups of sources.

        Parameters
        ----------
        by : str
            ``"source"``, ``"part"`` (CGEM layers, wires, walls ...), ``"material"`` (measurements are a group of their
            own; a scatterer of several materials counts for each by its share of X/X0, or of xi for straggling) or
            ``"cause"``.

        Returns
        -------
        dict of str to ndarray, float64
            Shape of the points; the groups sum to `total`.

        Raises
        ------
        ValueError
            If `by` is none of these.
        """
        groups: dict[str, Floats] = {}
        for number, source in enumerate(self.sources):
            for name, share in _groups(source, by):
                groups[name] = groups.get(name, np.zeros(self.p.shape)) + share * self.variances[..., number]
        return groups

    def table(self, by: By = "source") -> dict[str, npt.NDArray[Any]]:
        """Return one row per point and group as columns: variance, its share, and its root."""
        groups = self.grouped(by)
        n = self.p.size
        variance = np.stack([value.ravel() for value in groups.values()], axis=1)
        with np.errstate(invalid="ignore"):
            share, root = variance / self.total.reshape(-1, 1), np.sqrt(variance)
        return {
            "p": np.repeat(self.p.ravel(), len(groups)), "cos_theta": np.repeat(self.cos_theta.ravel(), len(groups)),
            by: np.tile(np.array(list(groups)), n), "variance": variance.ravel(), "share": share.ravel(),
            "sigma": root.ravel(),
        }  # fmt: skip

    def to_pandas(self, by: By = "source") -> Any:
        """Return `table` as a pandas DataFrame."""
        return data_frame(self.table(by))

    def _rows(self) -> Iterator[list[str]]:
        groups = self.grouped("part")
        order = sorted(groups, key=lambda name: -float(np.nan_to_num(groups[name]).sum()))
        total = self.total.ravel()
        for i in range(min(self.p.size, 6)):
            for name in order[:8]:
                value = float(groups[name].ravel()[i])
                yield [f"{self.p.ravel()[i]:.4g}", name, f"{value**0.5:.4g}", f"{100 * value / total[i]:.1f} %"]

    def _title(self) -> str:
        return f"{self.detector}, {self.particle}: budget of {self.quantity}"

    def _head(self) -> list[str]:
        return ["p [GeV/c]", "part", f"sigma [{self.unit}]" if self.unit else "sigma", "of variance"]

    def __repr__(self) -> str:
        return text_table(self._title(), self._head(), list(self._rows()))

    def _repr_html_(self) -> str:
        return html_table(self._title(), self._head(), list(self._rows()))


def _groups(source: Source, by: By) -> list[tuple[str, float]]:
    """Return the groups to which a source belongs, with its share in each."""
    if by == "source":
        return [(source.name, 1.0)]
    if by == "part":
        return [(source.part, 1.0)]
    if by == "cause":
        return [(source.cause, 1.0)]
    if by == "material":
        return list(source.materials) or [(source.cause, 1.0)]
    raise ValueError(f"by: got {by!r}; expected one of source, part, material, cause")


def budget_of(
    tracks: Tracks, quantity: str, detector: Detector, particle: str, p: Floats, cos_theta: Floats, reached: Floats
) -> Budget:
    """Return the budget of a quantity for the points of some tracks.

    Parameters
    ----------
    tracks : Tracks
    quantity : str
    detector : Detector
    particle : str
    p, cos_theta, reached : ndarray, float64
        Of the points, as in `Covariance`.

    Raises
    ------
    ValueError
        If the quantity is not known, or depends on a parameter that varies within a point.
    """
    rows = tracks.gradients(quantity).reshape(-1, tracks.samples, 5)
    if np.any(np.ptp(rows, axis=1) > 1e-12 * np.abs(rows).max(axis=1)):
        raise ValueError(f"budget of {quantity}: got a range of p or cos(theta); expected fixed values")
    weights = rows[:, 0]
    sums = tracks.run(budget=True)["budget"]  # (points, terms, 6)
    variance = np.einsum("pi,pti->pt", weights**2, sums[..., :5])
    variance += 2 * (weights[:, 2] * weights[:, 4])[:, None] * sums[..., 5]
    variance = np.maximum(variance, 0)  # a term is a square; where its parts cancel, rounding may leave -1e-16 of all
    names = sources(detector)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = variance / np.round(reached.reshape(-1, 1) * tracks.samples)
    shape = (*p.shape, len(names))
    return Budget(quantity, QUANTITIES[quantity], names, p, cos_theta, variance.reshape(shape), detector.name, particle)
