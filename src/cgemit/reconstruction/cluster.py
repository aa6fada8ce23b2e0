"""Clustering: digis of any readout become clusters (docs/methods/cluster.md, docs/methods/readout.md)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.detector import CgemLayer, Detector, load
from cgemit.detector.channels import checked
from cgemit.detector.core import StripView, strip_view
from cgemit.detector.gas import most_lost
from cgemit.detector.readouts import (
    READOUTS,
    AnalogReadout,
    BinaryReadout,
    ChargeReadout,
    GaussianReadout,
    ProjectionReadout,
    Readout,
    names_of,
    part_of,
)
from cgemit.reconstruction.clusterers.binary import BinaryClusterer
from cgemit.reconstruction.clusterers.charge import ChargeClusterer, ChargeTimeClusterer, ProjectionClusterer
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings, Floats
from cgemit.reconstruction.clusterers.gaussian import GaussianClusterer, clusters_of_positions
from cgemit.tables import Table
from cgemit.tables.table import made_by

#: Clusterers by the class of their readout; they serve the classes that extend it, too.
CLUSTERERS: dict[type[Readout], type[Clusterer]] = {
    BinaryReadout: BinaryClusterer,
    GaussianReadout: GaussianClusterer,
    AnalogReadout: ChargeTimeClusterer,
    ProjectionReadout: ProjectionClusterer,
}


def clusterer_of(readout: Readout | str) -> Clusterer:
    """Return the clusterer of a readout.

    Parameters
    ----------
    readout : Readout or str
        A name stands for the readout with its defaults.

    Raises
    ------
    ValueError
        If there is no such readout.
    """
    if isinstance(readout, str):
        if readout not in READOUTS:
            raise ValueError(f"readout: got {readout!r}, expected one of {names_of()}")
        readout = READOUTS[readout]()
    return part_of(readout, CLUSTERERS)(readout)


def charge_clusterer(readout: ChargeReadout) -> ChargeClusterer:
    """Return the clusterer of a readout that measures charge.

    Parameters
    ----------
    readout : ChargeReadout

    Raises
    ------
    ValueError
        If its strips have no charge.
    """
    clusterer = clusterer_of(readout)
    if not isinstance(clusterer, ChargeClusterer):
        raise ValueError(f"readout: got {readout.name!r}, expected one of {names_of(ChargeReadout)}")
    return clusterer


#: Probability of no clusters above which a layer is worth a warning.
_LOSS_OF_A_WARNING = 0.01


def warn_of_losses(detector: Detector, readout: Readout) -> None:
    """Warn of layers whose gaps are so thin that crossings have no clusters for lack of electrons.

    Parameters
    ----------
    detector : Detector
    readout : Readout
    """
    lost = [(layer, most_lost(layer, readout.least_electrons)) for layer in detector.cgem]
    thin = [
        f"{layer.label} {loss:.0%} (drift_gap {layer.drift_gap:g} mm)"
        for layer, loss in lost
        if loss > _LOSS_OF_A_WARNING
    ]
    if thin:
        warnings.warn(
            f"{detector.name}: crossings without clusters of readout {readout.name}, for lack of "
            f"ionization: {', '.join(thin)}; readout gaussian needs none",
            stacklevel=3,
        )


@checked("digis", ignore=("gid",))
def cluster(
    detector: Detector | str | Mapping[str, Any],
    digis: Table,
    settings: ClusterSettings | None = None,
    *,
    readout: Readout | str = "binary",
    directions: Floats | None = None,
) -> Table:
    """Join digis to X and V clusters, and X and V clusters that belong together to XV clusters.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    digis : Table
        Of kind ``digis``.
    settings : ClusterSettings or None
    readout : Readout or str
        With which the digis were made, such as ``TigerReadout(estimator="centroid")``. Its name alone stands for the
        readout with its defaults.
    directions : (clusters, 2) float64 or None
        Of fitted tracks, see `Clusterer.cluster`.

    Returns
    -------
    Table
        Of kind ``clusters``; within an event by layer and sheet, there X, V and XV clusters.

    Raises
    ------
    TypeError, ValueError
        If the settings are something else, a digi is not in the detector, there is no such readout, or a clusterer from
        outside the package makes anything but clusters of the same events.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> clusters = cg.cluster(r.detector, r.digis, readout="binary")
    >>> len(clusters) == len(r.clusters), np.unique(clusters["view"]).tolist()
    (True, [0, 1, 2])
    """
    clusterer, detector, settings = clusterer_of(readout), load(detector), ClusterSettings.of(settings)

    def of_readout(alone: Detector, digis: Table, directions: Floats | None) -> Table:
        found = clusterer.cluster(alone, digis, settings, directions)
        return made_by(f"readout {clusterer.readout.name}", "clusters", found, digis)

    if not detector.layer:
        return of_readout(detector, digis, directions)
    # The readout sees CGEM layers alone; other layers measure positions.
    view = strip_view(detector)
    is_strip = _numbers(view, digis) >= 0
    errors = [(0.0, 0.0) if isinstance(one, CgemLayer) else one.errors for one in detector.layers]
    positions = clusters_of_positions(detector, digis[~is_strip], np.reshape(errors, (-1, 2)))
    strips, own = view.of(digis[is_strip]), None
    if directions is not None:
        own = directions[_numbers(view, _joined(view.back(of_readout(view.detector, strips, None)), positions)) >= 0]
    return _joined(view.back(of_readout(view.detector, strips, own)), positions)


def _numbers(view: StripView, table: Table) -> npt.NDArray[np.int32]:
    """Return the number of each row's layer among the CGEM layers, (rows,) int32; -1 for others."""
    layer = table["layer"]
    wrong = np.flatnonzero((layer < 0) | (layer >= len(view.number)))
    if len(wrong):
        expected = f"a layer of the detector, 0 to {len(view.number) - 1}"
        raise ValueError(f"{table.kind} row {wrong[0]}: layer: got {layer[wrong[0]]}, expected {expected}")
    return np.asarray(view.number[layer])


def _joined(strips: Table, positions: Table) -> Table:
    """Return the clusters of both kinds of layers, by event and layer, with the links from points to their views."""
    of_positions = {name: np.zeros(len(positions), strips[name].dtype) for name in strips} | dict(positions.columns)
    columns = {name: np.concatenate([strips[name], of_positions[name]]) for name in strips}
    for name in ("x_cluster", "v_cluster"):
        columns[name][len(strips) :] += np.where(positions[name] < 0, 0, len(strips))
    order = np.lexsort((columns["layer"], columns["event"]))
    place = np.append(np.argsort(order), -1)
    for name in ("x_cluster", "v_cluster"):
        columns[name] = place[columns[name]].astype(columns[name].dtype)
    return Table("clusters", {name: one[order] for name, one in columns.items()}, meta=strips.meta, **strips.cover)
