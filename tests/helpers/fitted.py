"""Samples whose answers are known: random numbers, and tables of well fitted tracks."""

import numpy as np

from cgemit.tables import PARAMETERS, SCHEMAS, Table

N = 20_000


def rng(seed=1):
    """Return a generator of random numbers."""
    return np.random.default_rng(seed)


def make_tracks(n=N, seed=1, **columns):
    """Return well fitted tracks whose pulls are standard normal and whose chi-square is right."""
    random = rng(seed)
    zeros = {c.name: np.zeros((n, *c.shape), c.dtype) for c in SCHEMAS["tracks"]}
    zeros["match"] = zeros["other_mass"] = np.zeros(n, np.int8)
    values = {
        "event": np.arange(n),
        "charge": np.ones(n, np.int8),
        "ndf": np.full(n, 20),
        "chi2": random.chisquare(20, n),
    }
    for name in PARAMETERS:
        values[f"pull_{name}"] = random.standard_normal(n)
        values[f"res_{name}"] = 0.001 * values[f"pull_{name}"]
    tanl, charge = random.uniform(-2, 2, n), np.where(np.arange(n) % 2, 1.0, -1.0)
    values |= {"truth_tanl": tanl, "truth_p": np.full(n, 1.0), "truth_kappa": charge * np.sqrt(1 + tanl**2)}
    return Table("tracks", zeros | values | columns, n)
