"""Sensors: cylinders that measure positions, such as barrels of silicon; also layers that are matter only."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from cgemit.base.errors import Problem, Problems
from cgemit.detector.keys import UNUSABLE, Key, key, once
from cgemit.detector.layers.layer import READOUT_KEY, Layer, SubLayer, whole
from cgemit.detector.material import Material
from cgemit.detector.readouts import PositionReadout, Precision, Readout
from cgemit.detector.shells import Shell

#: mm, of a sensor whose thickness is not given: a common silicon wafer.
_SENSOR = 0.3
#: Radii, of a layer whose length is not given: the acceptance is |cos(theta)| < 0.93.
_LENGTH = 5.0

#: Values of a measurement layer that a value of a variant replaces.
_REPLACED = {
    "sigma": ("sigma_x", "sigma_v"),
    "pitch": ("sigma_x", "sigma_v", "pitch_x", "pitch_v"),
    "pitch_x": ("sigma_x",),
    "pitch_v": ("sigma_v",),
    "x0": ("thickness",),
    "thickness": ("x0",),
}


@dataclass(frozen=True, kw_only=True, repr=False)
class MeasurementLayer(Layer):
    """A cylinder that measures positions: a silicon barrel, a strip layer of any technology, a wrapper.

    X is r phi. V is z with the default `stereo` of 90 degrees, else the coordinate across strips at that angle to the
    beam. A coordinate is measured if its `sigma` or its `pitch` is given. With a sigma, positions have Gaussian errors
    of this width; with a pitch alone they are middles of strips, and their error is pitch/sqrt(12). A layer that
    measures nothing is matter only.

    On an inclined track a sigma becomes sqrt(sigma^2 + (sigma_tan t)^2), where t is dX/dr or dV/dr of the track.

    Examples
    --------
    >>> silicon = {"radius": "30 mm", "sigma": "5 um", "material": "Si", "thickness": "0.1 mm"}
    >>> det = cg.load({"base": "besiii-idc", "name": "pixel", "layer": {"VTX": silicon}})
    >>> layer = det.layer["VTX"]
    >>> layer.views, layer.sigma_v, layer.length
    (('X', 'V'), 0.005, 150.0)
    """

    group = "layer"
    about = "other layers that measure positions, by label"
    name = "layer"
    readouts = MappingProxyType({PositionReadout.name: PositionReadout})
    usual_readout = PositionReadout()
    extra_keys = MappingProxyType(
        {
            "sigma": Key("length", 1e-4, 100.0, doc="error of both coordinates, for sigma_x and sigma_v"),
            "pitch": Key("length", 1e-3, 100.0, doc="pitch of both coordinates, for pitch_x and pitch_v"),
            "x0": Key("dimensionless", 1e-7, 0.5, doc="thickness of the sensor in radiation lengths, for thickness"),
        }
    )
    sensitive = "sensor"

    radius: float = field(metadata=key("length", "radius of the middle of the sensor", 5.0, 3000.0))
    length: float = field(
        metadata=key("length", "active length along the beam (default: 5 radii)", 10.0, 10_000.0, derived=True)
    )
    material: Material = field(metadata=key("material", "material of the sensor"))
    thickness: float = field(metadata=key("length", "thickness of the sensor", 1e-3, 50.0, derived=True))
    support: tuple[SubLayer, ...] = field(metadata=key("stack", "matter behind the sensor, from inside"), default=())
    sigma_x: float = field(metadata=key("length", "error of X = r phi; 0: see pitch_x", 0.0, 100.0), default=0.0)
    sigma_v: float = field(metadata=key("length", "error of V; 0: see pitch_v", 0.0, 1000.0), default=0.0)
    sigma_tan: float = field(
        metadata=key("length", "what a track at 45 degrees adds to a sigma, in quadrature", 0.0, 100.0), default=0.0
    )
    pitch_x: float = field(metadata=key("length", "pitch of the X strips; 0: none", 0.0, 100.0), default=0.0)
    pitch_v: float = field(metadata=key("length", "pitch of the V strips; 0: none", 0.0, 1000.0), default=0.0)
    stereo: float = field(
        metadata=key("angle", "angle of the V strips to the beam, signed; 90 deg: V is z", -math.pi / 2, math.pi / 2),
        default=math.pi / 2,
    )
    efficiency: float = field(metadata=key("dimensionless", "probability of a hit", 0.0, 1.0), default=1.0)
    ladders: int = field(
        metadata=key("integer", "ladders around the beam, of one width", 0, 10_000, quiet=True), default=0
    )
    ladder_gap: float = field(
        metadata=key("length", "gap between two ladders, where nothing is measured", 0.0, 1000.0, quiet=True),
        default=0.0,
    )
    ladder_phi: float = field(
        metadata=key("angle", "azimuth of the middle of a gap", -2 * math.pi, 2 * math.pi, quiet=True), default=0.0
    )
    sigma_time: float = field(metadata=key("time", "error of the time of a hit", 0.0, 1e6), default=0.0)
    readout: Readout = field(metadata=READOUT_KEY, hash=False)  # one from outside the package may have no hash
    strips_x: int = field(init=False)  # a whole number is around the beam
    strips_v: int = field(init=False)

    def __post_init__(self) -> None:
        around, along = 2 * math.pi * self.radius, self.extent_v
        strips_x = max(1, whole(round, around / self.pitch_x)) if self.pitch_x else 1
        strips_v = max(1, whole(math.ceil, along / self.pitch_v - 1e-9)) if self.pitch_v else 1
        object.__setattr__(self, "strips_x", strips_x)
        object.__setattr__(self, "strips_v", strips_v)

    def text(self) -> str:
        """Return the layer in one line."""
        errors = dict(zip("XV", self.errors, strict=True))
        names = {"X": "r phi", "V": "z" if self.measures_z else f"V at {math.degrees(self.stereo):+.2f} deg"}
        inclined = f" + {1000 * self.sigma_tan:.4g} um tan" if self.sigma_tan else ""
        measured = ", ".join(f"{names[view]} to {1000 * errors[view]:.4g} um{inclined}" for view in self.views)
        x0 = 100 * sum(shell.x0 for shell in self.shells())
        ladders = f", {self.ladders} ladders {self.ladder_gap:g} mm apart" if self.ladders else ""
        return (
            f"r = {self.radius:g} mm, {self.length_text()}, {x0:.3g} % X0 of {self.material.name}, "
            f"{measured or 'measures nothing'}{ladders}{self.moved_text()}"
        )

    @property
    def measures_z(self) -> bool:
        """Whether V is z."""
        return abs(abs(self.stereo) - math.pi / 2) < 1e-9

    @property
    def views(self) -> tuple[str, ...]:
        """Coordinates that are measured: X (r phi), V, both or none."""
        return tuple(view for view, error in zip("XV", self.errors, strict=True) if error > 0)

    @property
    def precision(self) -> Precision:
        """Errors of positions and times that the layer states."""
        return Precision(self.sigma_x, self.sigma_v, self.sigma_time)

    @property
    def measures_points(self) -> bool:
        """True: X and V of a crossing are one measurement."""
        return True

    @property
    def pitches(self) -> tuple[float, float]:
        """Pitches of X and V strips, mm; of positions that no strip measures the width of the layer."""
        return 2 * math.pi * self.radius / self.strips_x, self.pitch_v or self.extent_v

    @property
    def error_slope(self) -> float:
        """Growth of errors with the path in the sensor, projected on X or V; added in quadrature."""
        return self.sigma_tan / self.thickness

    @property
    def r_readout(self) -> float:
        """Radius R of X = R (phi - phi_first), mm."""
        return self.radius

    @property
    def r_gap_in(self) -> float:
        """Inner face of the sensor, mm."""
        return self.radius - 0.5 * self.thickness

    @property
    def r_gap_out(self) -> float:
        """Outer face of the sensor, mm."""
        return self.radius + 0.5 * self.thickness

    @property
    def r_in(self) -> float:
        """Inner face, mm."""
        return self.r_gap_in

    @property
    def r_out(self) -> float:
        """Outer face, support included, mm."""
        return self.r_gap_out + sum(part.thickness for part in self.support)

    @property
    def extent_v(self) -> float:
        """Largest V, mm."""
        return 2 * math.pi * self.radius * math.cos(self.stereo) + self.length * math.sin(abs(self.stereo))

    def stacks(self) -> tuple[tuple[Shell, ...], ...]:
        """Return the sensor, and the support behind it."""
        sensor = Shell("sensor", self.material.name, self.r_gap_in, self.r_gap_out, self.ends, self.material)
        radius, support = sensor.r_out, []
        for row in self.support:
            r_in, radius = radius, radius + row.thickness
            support.append(Shell("support", row.label, r_in, radius, self.ends, row.material))
        return ((sensor,), tuple(support)) if support else ((sensor,),)

    def card_label(self, group: str) -> str:
        """Return the label of the sensor or its support in a Delphes card.

        Parameters
        ----------
        group : str
        """
        return self.label if group == self.sensitive else super().card_label(group)

    def materials(self) -> Iterator[Material]:
        """Yield the material of the sensor and those of its support."""
        yield self.material
        yield from (part.material for part in self.support)

    # What a detector file has of it

    @classmethod
    def complete(cls, path: str, values: dict[str, Any], problems: Problems) -> None:
        """Add length and thickness to the values (native units) where they are missing.

        `sigma`, `pitch` and `x0` are removed: they stand for the values of both coordinates and for a thickness.
        """
        for name in ("sigma", "pitch"):
            both = values.pop(name, None)
            for view in "xv":
                if both is not None and f"{name}_{view}" in values:
                    problems.note(f"{path}.{name}", "also " + f"{name}_{view}", "one of both")
                elif both is not None:
                    values[f"{name}_{view}"] = both
        x0 = values.pop("x0", None)
        if x0 is not None and "thickness" in values:
            problems.note(f"{path}.x0", "also thickness", "one of both")
        elif x0 is not None:
            values["thickness"] = x0 * getattr(values["material"], "x0", UNUSABLE)
        values.setdefault("thickness", _SENSOR)
        values.setdefault("readout", cls.usual_readout)
        values.setdefault("length", _LENGTH * values["radius"])

    @classmethod
    def drop_replaced(cls, base: dict[str, Any], variant: Mapping[str, Any]) -> None:
        """Remove what the values of a variant replace; ``sigma`` and ``pitch`` of a base stand for both coordinates."""
        for both in ("sigma", "pitch"):
            if both in base and any(f"{one}_{view}" in variant for one in ("sigma", "pitch") for view in "xv"):
                base |= dict.fromkeys((f"{both}_x", f"{both}_v"), base.pop(both))
        for name in _REPLACED.keys() & variant.keys():
            for old in _REPLACED[name]:
                base.pop(old, None)
        if "sigma" in variant or "pitch" in variant:
            for both in ("sigma", "pitch"):
                base.pop(both, None)

    def extra_value(self, name: str) -> float | None:
        """Return the thickness in radiation lengths as `x0`."""
        return self.thickness / self.material.x0 if name == "x0" else None

    def stands_for(self, name: str) -> tuple[str, ...]:
        """Return the coordinates that `sigma` or `pitch` stands for."""
        both = [f"{name}_{view}" for view in "xv"] if name in ("sigma", "pitch") else []
        return tuple(one for one in both if getattr(self, one) > 0)

    def may_lack(self, name: str) -> bool:
        """Return True for errors and pitches: one states the other's coordinate, or it is not measured."""
        return name in ("pitch_x", "pitch_v", "sigma_x", "sigma_v")

    @once
    def problems(self) -> list[Problem]:
        """Return a sensor that begins inside the beam line, and wrong sizes, angles and errors of its coordinates."""
        path = self.path
        problems = []
        if self.r_in <= 0:
            problems.append(
                Problem(f"{path}.thickness", f"{self.thickness:g} mm", "an inner face outside the beam line")
            )
        for view in "xv":
            pitch = getattr(self, f"pitch_{view}")
            most = 2 * math.pi * self.radius if view == "x" else self.extent_v
            if pitch > most:
                problems.append(
                    Problem(f"{path}.pitch_{view}", f"{pitch:g} mm", f"at most {most:g} mm, the size of the layer")
                )
            if pitch and getattr(self, f"sigma_{view}"):
                got = f"{pitch:g} mm and sigma_{view} = {getattr(self, f'sigma_{view}'):g} mm"
                expected = "one of them: strips have the error pitch/sqrt(12)"
                problems.append(Problem(f"{path}.pitch_{view}", got, expected))
        if (self.ladders > 0) != (self.ladder_gap > 0):
            got = f"{self.ladders}, and ladder_gap = {self.ladder_gap:g} mm"
            problems.append(Problem(f"{path}.ladders", got, "both above 0, or none of them"))
        elif self.ladders and self.ladders * self.ladder_gap >= 2 * math.pi * self.radius:
            expected = f"less than {2 * math.pi * self.radius / self.ladders:g} mm, the width of a ladder with its gap"
            problems.append(Problem(f"{path}.ladder_gap", f"{self.ladder_gap:g} mm", expected))
        for view in self.views:
            if self.sigma_tan and not getattr(self, f"sigma_{view.lower()}"):
                got = f"{self.sigma_tan:g} mm and no sigma_{view.lower()}"
                problems.append(Problem(f"{path}.sigma_tan", got, "a sigma of each coordinate that is measured"))
        if "V" in self.views and abs(self.stereo) < 1e-3:
            got = f"{1000 * self.stereo:g} mrad"
            problems.append(Problem(f"{path}.stereo", got, "at least 1 mrad, either sign: otherwise V is X"))
        return problems

    def design_keys(self) -> Iterator[str]:
        """Yield radius, thickness, and the error or the pitch of each coordinate that is measured."""
        names = ("radius", "thickness", "sigma_x", "sigma_v", "sigma_tan", "pitch_x", "pitch_v")
        used = {name: getattr(self, name) for name in ("sigma_x", "sigma_v", "sigma_tan")}
        used |= {f"pitch_{view}": 0 if used[f"sigma_{view}"] else getattr(self, f"pitch_{view}") for view in "xv"}
        yield from (f"{self.path}.{name}" for name in names if used.get(name, 1))

    def described(self) -> dict[str, Any]:
        """Return the numbers of the layer that `cgemit show --json` prints."""
        x, v = self.errors
        return {
            "layer": self.label,
            "radius_mm": self.radius,
            "length_mm": self.length,
            "z_min_mm": self.ends[0],
            "z_max_mm": self.ends[1],
            "material": self.material.name,
            "thickness_mm": self.thickness,
            "views": " ".join(self.views),
            "error_x_um": 1000 * x,
            "error_v_um": 1000 * v,
            "error_tan_um": 1000 * self.sigma_tan,
            "pitch_x_um": 1000 * self.pitch_x,
            "pitch_v_um": 1000 * self.pitch_v,
            "stereo_deg": math.degrees(self.stereo),
            "efficiency": self.efficiency,
            "ladders": self.ladders,
            "ladder_gap_mm": self.ladder_gap,
            "sigma_time_ns": self.sigma_time,
        }
