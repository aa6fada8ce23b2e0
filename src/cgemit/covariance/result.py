"""Covariances of a grid of points as numpy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.covariance.budget import Budget, budget_of
from cgemit.covariance.mixture import core_width, mean
from cgemit.covariance.tracks import QUANTITIES, Tracks, variances
from cgemit.detector import Detector
from cgemit.digitize.readout import Readout
from cgemit.fit import FitStatus
from cgemit.tables.convert import data_frame

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Covariance:
    """Covariances of (dr, phi0, kappa, dz, tanl) at the origin, or where tracks leave a cylinder, for a grid of tracks.

    Arrays have the shape of the arguments of `analytic`, broadcast. What varies within a point (azimuth, position of
    the strips under the track, ranges of p and cos(theta)) is sampled, so that the residuals of a point are a mixture
    of Gaussians: ``sigma`` is the core of the mixture, as `resolution` measures it (Gaussian within 3 of its sigmas),
    ``rms`` the root of the mean variance.

    Attributes
    ----------
    detector : Detector
    particle : str
    readout : Readout
        Of the CGEM layers.
    p, cos_theta, phi : ndarray, float64, GeV/c, 1, rad
        Means of the samples of each point, at the origin; `phi` (azimuth of the momentum) is NaN where it is averaged.
    radius : ndarray, float64, mm
        Of the cylinder; NaN at the origin. All matter inside it has acted, and none outside. The pivot is the point of
        the track there, so that dr and dz are the displacements across the flight and along the beam.
    status : ndarray, int8
        `FitStatus`: ok if any sample of the point has a covariance, else that of most samples.
    reached : ndarray, float64
        Fraction of the samples with a covariance.
    n_clusters, n_wires : ndarray, float64
        Mean number of clusters and wire hits of these samples.
    cov : ndarray, shape + (5, 5) float64
        Mean covariance of these samples: mm, rad, (GeV/c)^-1.
    """

    detector: Detector
    particle: str
    readout: Readout
    p: Floats
    cos_theta: Floats
    phi: Floats
    radius: Floats
    status: npt.NDArray[np.int8]
    reached: Floats
    n_clusters: Floats
    n_wires: Floats
    cov: Floats
    _tracks: Tracks
    _samples: Floats  # (points, samples, 15), NaN without a covariance

    def sigma(self, quantity: str) -> Floats:
        """Return the core resolution: the Gaussian within 3 of its sigmas.

        Parameters
        ----------
        quantity : str
            ``"dr"`` mm, ``"phi0"`` rad, ``"kappa"`` (GeV/c)^-1, ``"dz"`` mm, ``"tanl"``, ``"theta"`` rad, ``"p"`` GeV/c
            or ``"pt"`` GeV/c.

        Returns
        -------
        ndarray, float64
            NaN where no sample has a covariance.

        Raises
        ------
        ValueError
            If the quantity is not known.
        """
        return self.sigmas([quantity])[quantity]

    def sigmas(self, quantities: Sequence[str]) -> dict[str, Floats]:
        """Return the core resolutions of several quantities by name, faster than one by one; see `sigma`."""
        variances = np.array([self.variances(name) for name in quantities])
        widths = core_width(variances.reshape(-1, self._tracks.samples)).reshape(-1, *self.p.shape)
        return dict(zip(quantities, widths, strict=True))

    def rms(self, quantity: str) -> Floats:
        """Return the root of the mean variance; see `sigma`."""
        variances = self.variances(quantity)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(mean(variances, ~np.isnan(variances))))

    def variances(self, quantity: str) -> Floats:
        """Return the variance of every sample, shape + (samples,); NaN without a covariance."""
        tracks = self._tracks
        found = variances(self._samples.reshape(-1, 15), tracks.kappa, tracks.tanl, quantity)
        return found.reshape(*self.p.shape, tracks.samples)

    def budget(self, quantity: str) -> Budget:
        """Return the exact split of the mean variance by measurement and scatterer.

        Parameters
        ----------
        quantity : str
            As in `sigma`.

        Returns
        -------
        Budget
            Whose terms sum to the square of `rms`.

        Raises
        ------
        ValueError
            As `sigma`; for covariances elsewhere than at the origin.
        """
        self.only_at_origin("budget")
        return budget_of(self._tracks, quantity, self.detector, self.particle, self.p, self.cos_theta, self.reached)

    def only_at_origin(self, what: str) -> None:
        """Raise ValueError unless these are covariances at the origin; `what` is what is wanted."""
        if not np.all(np.isnan(self.radius)):
            raise ValueError(f"{what}: got covariances at a radius; expected covariances at the origin")

    def __getattr__(self, name: str) -> Floats:
        """Return ``sigma_p`` for ``sigma("p")``, ``rms_dr`` for ``rms("dr")``."""
        kind, _, quantity = name.partition("_")
        if kind in ("sigma", "rms") and quantity in QUANTITIES:
            return self.sigma(quantity) if kind == "sigma" else self.rms(quantity)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted([*super().__dir__(), *(f"{kind}_{name}" for kind in ("sigma", "rms") for name in QUANTITIES)])

    def table(self) -> dict[str, npt.NDArray[Any]]:
        """Return one row per point as columns: arguments, status, core and RMS of every quantity in native units."""
        columns: dict[str, npt.NDArray[Any]] = {"p": self.p.ravel(), "cos_theta": self.cos_theta.ravel()}
        columns |= {"phi": self.phi.ravel(), "radius": self.radius.ravel(), "status": self.status.ravel()}
        columns["reached"] = self.reached.ravel()
        columns |= {"n_clusters": self.n_clusters.ravel(), "n_wires": self.n_wires.ravel()}
        for name in QUANTITIES:
            columns[f"sigma_{name}"], columns[f"rms_{name}"] = self.sigma(name).ravel(), self.rms(name).ravel()
        return columns

    def to_pandas(self) -> Any:
        """Return `table` as a pandas DataFrame."""
        return data_frame(self.table())

    def __repr__(self) -> str:
        columns = self.p, self.cos_theta, self.sigma("dr"), self.sigma("dz"), self.sigma("p"), self.status
        rows = [
            f"  p {p:.4g} GeV/c, cos(theta) {c:.3g}: sigma(d_rho) {1e3 * dr:.4g} um, sigma(d_z) {dz:.4g} mm, "
            f"sigma(p) {1e3 * sp:.4g} MeV/c" + ("" if s == 0 else f" [{FitStatus(int(s)).name}]")
            for p, c, dr, dz, sp, s in zip(*(np.ravel(one) for one in columns), strict=True)
        ]
        more = [f"  ... {len(rows) - 12} more"] if len(rows) > 12 else []
        head = f"<{self.detector.name}, {self.particle}, read-out {self.readout.name}"
        radii = np.unique(self.radius[~np.isnan(self.radius)])
        if len(radii):
            head += f", on cylinders of {', '.join(f'{radius:g}' for radius in radii)} mm"
        return "\n".join([head, *rows[:12], *more]) + ">"
