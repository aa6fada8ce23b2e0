"""Weighted least squares of a helix in cylinders that scatter: covariance at the origin, written without the package.

Scattering is that of G. R. Lynch and O. I. Dahl, Nucl. Instrum. Methods B 58 (1991) 6, eqs. 2 to 6, with F = 0.98; the
momentum stays the same. A row is (radius mm, X/X0, views, element); a view is (stereo angle rad, sigma mm).
"""

import math

import numpy as np

F = 0.98
MUON = 0.1056583755
#: Z, A and radiation length, g/mol and g/cm2 (Particle Data Group).
MATTER = {"Be": (4, 9.012, 65.19), "C": (6, 12.011, 42.70), "Si": (14, 28.085, 21.82), "Al": (13, 26.982, 24.01)}


def helices(parameters, radii, bz, kinks):
    """Return r phi and z of helices where they cross radii outward, mm, (rows, n) each.

    `parameters` (5, n) are d_rho, phi0, kappa, d_z, tan(lambda); `kinks` (rows, 2, n) turn a helix behind each radius
    by two angles, horizontally and along the dip.
    """
    d, phi, kappa, z, tanl = (np.array(one) for one in parameters)
    x, y, psi = d * np.cos(phi), d * np.sin(phi), phi + np.pi / 2
    found = []
    for r, (aside, up) in zip(radii, kinks, strict=True):
        w = -0.299792458e-3 * bz * kappa
        s = r - np.hypot(x, y)
        for _ in range(60):
            half = 0.5 * w * s
            chord = s * np.sinc(half / np.pi)
            px, py = x + chord * np.cos(psi + half), y + chord * np.sin(psi + half)
            now = np.hypot(px, py)
            step = (r - now) * now / (px * np.cos(psi + w * s) + py * np.sin(psi + w * s))
            s = s + step
            if np.abs(step).max() < 1e-11 * r:
                break
        else:
            raise ValueError(f"a helix does not reach {r:g} mm")
        x, y, psi, z = px, py, psi + w * s, z + s * tanl
        found.append((r * np.arctan2(y, x), z))
        dip = np.arctan(tanl)
        psi = psi + aside / np.cos(dip)
        kappa = kappa * np.cos(dip) / np.cos(dip + up)
        tanl = np.tan(dip + up)
    return np.array(found).transpose(1, 0, 2)


class Fit:
    """The fit of one muon of negative charge from the origin, phi0 = 0.3; rows behind the last view change nothing."""

    def __init__(self, rows, p, cos_theta, bz):
        rows = rows[: 1 + max(i for i, row in enumerate(rows) if row[2])]
        self.rows, self.p, sine = rows, p, math.sqrt(1 - cos_theta**2)
        self.at = np.array([0.0, 0.3, -1 / (p * sine), 0.0, cos_theta / sine])
        self.beta = p / math.hypot(p, MUON)
        radii = np.array([row[0] for row in rows])
        across = 0.5 * 0.299792458e-3 * bz / (p * sine) * radii
        self.path = 1 / sine
        self.slant = self.path / np.sqrt(1 - across**2)
        steps = np.array([1e-4, 1e-6, 1e-6, 1e-4, 1e-6])
        n = len(rows)
        changes = np.concatenate([np.diag(steps), np.zeros((5, 2 * n))], axis=1)
        kinks = np.concatenate([np.zeros((n, 2, 5)), 1e-6 * np.eye(2 * n).reshape(n, 2, 2 * n)], axis=2)
        up, down = (helices(self.at[:, None] + sign * changes, radii, bz, sign * kinks) for sign in (1, -1))
        slopes = (up - down) / (2 * np.concatenate([steps, np.full(2 * n, 1e-6)]))
        measured = [(i, *view) for i, row in enumerate(rows) for view in row[2]]
        of = np.array([math.cos(a) * slopes[0, i] - math.sin(a) * slopes[1, i] for i, a, _ in measured])
        self.design, self.kicks = of[:, :5], of[:, 5:].T.reshape(n, 2, -1)
        self.noise = np.diag([sigma**2 for *_, sigma in measured])
        z, a, x0 = (np.array([MATTER[row[3]][i] for row in rows]) for i in range(3))
        grams = np.array([row[1] for row in rows]) * self.slant * x0
        self.chi_c2 = 0.157e-6 * z * (z + 1) * grams / a / (p * self.beta) ** 2
        self.chi_a2 = 2.007e-11 * z ** (2 / 3) * (1 + 3.34 * (z / 137.036 / self.beta) ** 2) / p**2

    def covariance(self, acting, by_hits):
        """Return the covariance at the origin.

        `acting`: (chi_c p beta)^2 of the matter that acts with a row, GeV2; `by_hits`: variance by hits over that by
        scattering, over (p beta)^2.
        """
        return self._solved(acting, by_hits)[0]

    def _solved(self, acting, by_hits):
        """Return the covariance, and the part of each row in its diagonal."""
        acting = acting * (1 + by_hits * (self.p * self.beta) ** 2)
        v = 0.5 * acting / (self.p * self.beta) ** 2 * self.path / self.chi_a2 / (1 - F)
        thetas2, variance = self.chi_c2 / (1 + F**2) * ((1 + v) / v * np.log1p(v) - 1), self.noise.copy()
        for theta2, (aside, up) in zip(thetas2, self.kicks, strict=True):
            variance += theta2 * (np.outer(up, up) + np.outer(aside, aside))
        weighted = self.design.T @ np.linalg.inv(variance)
        cov = np.linalg.inv(weighted @ self.design)
        gain = cov @ weighted
        return cov, ((self.kicks @ gain.T) ** 2).sum(axis=1) * thetas2[:, None]

    def acting(self):
        """Return (chi_c p beta)^2 of the matter that acts with each row, GeV2, and what hits add, for `covariance`.

        For a parameter with the variance V by scattering, of which V_i is of row i, it is that of the row times V/V_i.
        The mean of its logarithms over the parameters has the weights V_i/cov. It is at most that before the last row,
        on a straight line across the beam. Hits add the mean of ln(cov/V).
        """
        own = self.chi_c2 * (self.p * self.beta) ** 2 / self.slant
        cov, parts = self._solved(np.full(len(own), own.sum()), 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.where(parts > 0, np.log(parts.sum(axis=0) / parts), 0.0)
        weights = parts / np.diag(cov)
        mean = (weights * logs).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300)
        more = (weights * np.log(np.diag(cov) / parts.sum(axis=0))).sum(axis=1) / np.maximum(
            weights.sum(axis=1), 1e-300
        )
        together = np.clip(own * np.exp(mean), own, np.maximum(own, own[:-1].sum()))
        return together, np.expm1(more) / (self.p * self.beta) ** 2
