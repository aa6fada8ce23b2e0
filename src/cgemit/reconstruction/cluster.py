"""Clustering: digis of any readout become clusters (docs/methods/cluster.md, docs/methods/readout.md)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.detector import Detector, ReadoutGroup, load
from cgemit.detector.channels import checked
from cgemit.detector.gas import most_lost
from cgemit.detector.readouts import (
    AnalogReadout,
    BinaryReadout,
    ChargeReadout,
    PositionReadout,
    ProjectionReadout,
    Readout,
    names_of,
    part_of,
)
from cgemit.helix import wrap_angle
from cgemit.reconstruction.cluster_errors import read_error_factors, with_factors
from cgemit.reconstruction.clusterers.binary import BinaryClusterer
from cgemit.reconstruction.clusterers.charge import ChargeClusterer, ChargeTimeClusterer, ProjectionClusterer
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings
from cgemit.reconstruction.clusterers.gaussian import PositionClusterer
from cgemit.tables import Table
from cgemit.tables.schema import XV_CLUSTER
from cgemit.tables.table import made_by, merged

#: Clusterers by the class of their readout; they serve the classes that extend it, too.
CLUSTERERS: dict[type[Readout], type[Clusterer]] = {
    BinaryReadout: BinaryClusterer,
    PositionReadout: PositionClusterer,
    AnalogReadout: ChargeTimeClusterer,
    ProjectionReadout: ProjectionClusterer,
}


def clusterer_of(readout: Readout) -> Clusterer:
    """Return the clusterer of a readout.

    Raises
    ------
    ValueError
        If there is none.
    """
    return part_of(readout, CLUSTERERS)(readout)


def charge_clusterer(readout: ChargeReadout) -> ChargeClusterer:
    """Return the clusterer of a readout that measures charge.

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


def warn_of_losses(detector: Detector) -> None:
    """Warn of layers whose gaps are so thin that crossings have no clusters for lack of electrons."""
    lost = [(layer, most_lost(layer)) for layer in detector.cgem]
    thin = [
        f"{layer.label} {loss:.0%} (drift_gap {layer.drift_gap:g} mm)"
        for layer, loss in lost
        if loss > _LOSS_OF_A_WARNING
    ]
    if thin:
        warnings.warn(
            f"{detector.name}: crossings without clusters of readout {detector.readout_text}, for lack of "
            f"ionization: {', '.join(thin)}; readout gaussian needs none",
            stacklevel=3,
        )


#: Strips that a warning of wrong times needs, and the share of them that is in no cluster.
_LEAST_STRIPS, _MOST_OUTSIDE = 20, 0.9


def _warn_of_times(group: ReadoutGroup, digis: Table, clusters: Table) -> None:
    """Warn if nearly all strips are in no cluster, since their times are not those of the drift gap."""
    inside = int(clusters["size"][clusters["view"] != XV_CLUSTER].sum())
    outside = len(digis) - inside
    if len(digis) < _LEAST_STRIPS or outside <= _MOST_OUTSIDE * len(digis):
        return
    low, high = float(digis["time"].min()), float(digis["time"].max())
    warnings.warn(
        f"cluster: {outside} of {len(digis)} strips are in no cluster: their times are {low:.0f} to {high:.0f} ns, "
        f"and readout {group.readout.name} counts from the start of the event; strip_times finds it",
        stacklevel=5,
    )


@checked("digis", ignore=("gid",))
def cluster(
    detector: Detector | str | Mapping[str, Any],
    digis: Table,
    settings: ClusterSettings | None = None,
    *,
    readout: Readout | str | Mapping[str, Any] | None = None,
    directions: Floats | None = None,
    clusters: Table | None = None,
) -> Table:
    """Join digis to X and V clusters, and X and V clusters that belong together to XV clusters.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    digis : Table
        Of kind ``digis``.
    settings : ClusterSettings or None
    readout : Readout, str, mapping or None
        Of all CGEM layers, instead of those of the detector, such as ``TigerReadout(estimator="centroid")``: the one
        with which the digis were made.
    directions : (clusters, 2) float64 or None
        Of fitted tracks, see `Clusterer.cluster`.
    clusters : Table or None
        To whose rows the directions belong: those of the same digis without directions. None: they are made first if
        they are needed.

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
    >>> clusters = cg.cluster(r.detector, r.digis)
    >>> len(clusters) == len(r.clusters), np.unique(clusters["view"]).tolist()
    (True, [0, 1, 2])
    """
    detector, settings = load(detector), ClusterSettings.of(settings)
    if readout is not None:
        detector = detector.with_readout(readout)

    def of_group(group: ReadoutGroup, digis: Table, directions: Floats | None) -> Table:
        clusters = clusterer_of(group.readout).cluster(group, digis, settings, directions)
        if isinstance(group.readout, AnalogReadout):
            _warn_of_times(group, digis, clusters)
        if settings.error_factors:
            clusters = with_factors(detector, clusters, read_error_factors(settings.error_factors))
        return made_by(f"readout {group.readout.name}", "clusters", clusters, digis)

    groups = detector.groups
    if len(groups) == 1:
        return in_layers(detector, of_group(groups[0], digis, directions))
    if directions is None:
        return in_layers(detector, merged([of_group(group, digis[group.owns(digis)], None) for group in groups]))
    if clusters is None:
        clusters = cluster.unchecked(detector, digis, settings)
    found = [of_group(group, digis[group.owns(digis)], directions[group.owns(clusters)]) for group in groups]
    return in_layers(detector, merged(found))


def in_layers(detector: Detector, clusters: Table) -> Table:
    """Return clusters of displaced sheets with `v` and `z` in the axes of their layers; others as they are.

    Strips of a sheet that is shifted by dz along the beam have V = X cos + (z_ref - z + dz) sin of the stereo angle.

    Parameters
    ----------
    detector : Detector
    clusters : Table
        In the axes of their sheets.
    """
    layers = detector.layers
    if not any(any(layer.sheet_z) for layer in layers):
        return clusters
    shift = np.zeros(len(clusters))
    for number, layer in enumerate(layers):
        mine = clusters["layer"] == number
        shift[mine] = np.array(layer.sheet_z)[clusters["sheet"][mine]]
    sine = np.array([layer.sin_stereo for layer in layers])[clusters["layer"]]
    # Columns of a view that is not measured are no numbers, and stay so.
    return clusters.with_columns(v=clusters["v"] - shift * sine, z=clusters["z"] + shift)


def read_by(detector: Detector, described: Detector, clusters: Table) -> Table:
    """Return the clusters that another description makes of the same strips.

    Parameters
    ----------
    detector : Detector
        With other Lorentz shifts, scales along the beam, and positions of the sheets in their layers.
    described : Detector
        That made the clusters.
    clusters : Table
    """
    x, v, phi, z = (clusters[name].copy() for name in ("x", "v", "phi", "z"))
    changed = False
    for layer_number, (old, new) in enumerate(zip(described.layers, detector.layers, strict=True)):
        shift = (new.lorentz_shift or 0.0) - (old.lorentz_shift or 0.0)
        same = (old.sheet_z, old.sheet_phi, old.z_scale) == (new.sheet_z, new.sheet_phi, new.z_scale)
        if not shift and same:
            continue
        changed = True
        rows = np.flatnonzero(clusters["layer"] == layer_number)
        sheet = clusters["sheet"][rows]
        turned = np.subtract(new.sheet_phi, old.sheet_phi)[sheet]
        before, after = (np.array(one.sheet_z)[sheet] for one in (old, new))
        x[rows] -= shift
        v[rows] -= shift * np.cos(new.stereo) + after * new.sin_stereo - before * old.sin_stereo
        z[rows] = (z[rows] - before) * ((1 + new.z_scale) / (1 + old.z_scale)) + after
        phi[rows] = wrap_angle(phi[rows] - shift / new.r_readout + turned)
    return clusters.with_columns(x=x, v=v, phi=phi, z=z) if changed else clusters
