"""Clusters of strips with charge, or with charge and time (docs/methods/readout.md)."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector import ReadoutGroup, compiled
from cgemit.detector.core import strip_gains, strip_lists
from cgemit.detector.gas import drift_columns
from cgemit.detector.readouts import AnalogReadout, ChargeReadout, ProjectionReadout
from cgemit.reconstruction.cluster_errors import (
    COS_THETA,
    ErrorInputs,
    Expected,
    chip_delays,
    error_inputs,
    expected_errors,
)
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings
from cgemit.tables import Table
from cgemit.units import LIGHT


class ChargeClusterer(Clusterer):
    """Makes clusters whose positions and errors come from the charge of their strips."""

    readout: ChargeReadout

    @property
    def lorentz(self) -> bool:
        """Whether electrons drift at the Lorentz angle."""
        return False

    @abstractmethod
    def strip_rules(self, group: ReadoutGroup) -> dict[str, Any]:
        """Return how strips with charge and time become clusters, as arguments of the core.

        Returns
        -------
        dict
            ``timing``: velocity (mm/ns), tan_lorentz, shift (rad) and delay (ns), each (layers,) float64. ``missing``,
            ``edge``, ``margin`` (ns): see `AnalogReadout`. ``timed``: whether strips have times.
        """

    def check(self, group: ReadoutGroup) -> None:
        """Raise an error if a layer's gas or field has no table of electron transport."""
        self._inputs(group)

    def _inputs(self, group: ReadoutGroup) -> ErrorInputs:
        return error_inputs(group.detector, self.readout, group.numbers)

    def cluster(
        self, group: ReadoutGroup, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return the clusters, see `Clusterer.cluster`; of the settings only `bridge` applies.

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        columns = self.columns(group, digis, self._inputs(group), settings.bridge, directions)
        tracks = np.empty((0, 2)) if directions is None else directions
        # X and V of a crossing come from the same electrons.
        layer = columns["layer"]
        alone, tracked = (self._correlation(group, of_track)[layer] for of_track in (False, True))
        along = np.zeros(len(alone), np.bool_)
        along[: len(tracks)] = np.isfinite(tracks[: len(along), 0])
        columns["corr_xv"] = np.where(along, tracked, alone)
        return Table("clusters", columns, **digis.cover)

    def columns(
        self, group: ReadoutGroup, digis: Table, inputs: ErrorInputs, bridge: int = 0, directions: Floats | None = None
    ) -> dict[str, Any]:
        """Return the columns of the clusters, without the correlation of X and V.

        Parameters
        ----------
        group : ReadoutGroup
        digis : Table
        inputs : ErrorInputs
            Of the layers of the group.
        bridge : int
            See `ClusterSettings`.
        directions : (clusters, 2) float64 or None
            See `Clusterer.cluster`.
        """
        tracks = np.empty((0, 2)) if directions is None else directions
        detector, rules = group.detector, self.strip_rules(group)
        delays = chip_delays(detector, self.readout, group.numbers)
        # By layer, or by view and then layer.
        by_layer = {name: group.among_all(column) for name, column in rules.pop("timing").items()}
        planes = {name: group.among_all(column, 2) for name, column in inputs.planes.items()}
        of_layers = ("values", "charges_apart", "times_apart", "log_numbers")
        shares = {name: group.among_all(inputs.shares[name]) for name in of_layers}
        delayed = {name: group.among_all(delays[name], 2) for name in ("charges", "delays")}
        columns: dict[str, Any] = _core.reconstruction.find_charge_time_clusters(
            compiled(detector), dict(digis.columns), **rules, timing=by_layer, chip=inputs.chip, planes=planes,
            shares=inputs.shares | shares, delays=delays | delayed, estimator=self.readout.estimator,
            masked=strip_lists(detector).masked, bridge=bridge, gain=strip_gains(detector),
            valley=self.readout.valley, slopes=tracks[:, 0], paths=tracks[:, 1],
        )  # fmt: skip
        return columns

    def _expected(self, group: ReadoutGroup, of_track: bool) -> Expected:
        return expected_errors(group.detector, self.readout, self.readout.estimator, of_track, group.numbers)

    def _correlation(self, group: ReadoutGroup, of_track: bool) -> Floats:
        """Return the mean over cos(theta) of the correlation of X and V, for clusters of unknown angle.

        (layers of the detector,) float64, NaN for those of other groups.
        """
        values = self._expected(group, of_track).correlation
        steps = np.diff(COS_THETA) / (COS_THETA[-1] - COS_THETA[0])
        return group.among_all(0.5 * (values[:, 1:] + values[:, :-1]) @ steps)

    def expected_errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return the errors of clusters by cos(theta), see `Clusterer.expected_errors`.

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        found = self._expected(group, self.follows_tracks)
        return found.sigma_x, found.sigma_v

    def expected_correlations(self, group: ReadoutGroup) -> Floats:
        """Return the correlation of the errors of X and V by cos(theta), see `Clusterer.expected_correlations`."""
        return self._expected(group, self.follows_tracks).correlation


class ProjectionClusterer(ChargeClusterer):
    """Takes the centroid of the charge: there is no time, and no drift."""

    readout: ProjectionReadout

    def strip_rules(self, group: ReadoutGroup) -> dict[str, Any]:
        """Return rules that leave time out, with the shift that layers state, see `ChargeClusterer.strip_rules`."""
        layers = len(group.layers)
        shift = np.array([(layer.lorentz_shift or 0.0) / layer.r_readout for layer in group.layers])
        return {
            "timing": {name: np.zeros(layers) for name in ("tan_lorentz", "delay")}
            | {"velocity": np.ones(layers), "shift": shift},
            "missing": 0,
            "edge": 0.0,
            "margin": math.inf,
            "timed": False,
        }


class ChargeTimeClusterer(ChargeClusterer):
    """Takes the centroid of the charge, a line through the drift gap, or the line through the charge."""

    readout: AnalogReadout

    @property
    def follows_tracks(self) -> bool:
        """Whether the readout asks for a second pass."""
        return self.readout.second_pass

    @property
    def lorentz(self) -> bool:
        """Whether electrons drift at the Lorentz angle."""
        return self.readout.lorentz

    def strip_rules(self, group: ReadoutGroup) -> dict[str, Any]:
        """Return the drift of the gas, see `ChargeClusterer.strip_rules`.

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        drift = drift_columns(group.detector, group.numbers)
        flight = np.array([layer.r_mid for layer in group.layers]) / LIGHT
        bend = 1.0 if self.readout.lorentz else 0.0
        return {
            "timing": {
                "velocity": drift["velocity"],
                "tan_lorentz": bend * drift["tan_lorentz"],
                "shift": bend * drift["shift"],
                "delay": drift["delay"] + flight,
            },
            "missing": self.readout.missing,
            "edge": self.readout.edge,
            "margin": self.readout.time_margin,
        }
