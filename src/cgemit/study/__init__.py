"""Studies of the chain's tables: resolutions, pulls and the flatness of the chi-square probability."""

from cgemit.analysis.clusters import DeltaFractions, delta_displacements, delta_fractions
from cgemit.analysis.cosmics import Cosmics, cosmics
from cgemit.analysis.finding import Finding, FindingRates, LoopLinks, finding, loop_links
from cgemit.analysis.hits import (
    HitResiduals,
    LayerCrossings,
    LayerEfficiencies,
    ResidualTable,
    hit_residuals,
    layer_crossings,
    layer_efficiencies,
    strip_status,
)
from cgemit.analysis.resolutions import (
    Curve,
    Flatness,
    FormFit,
    Pulls,
    Resolutions,
    chi2_flatness,
    chi2_probability,
    fit_form,
    pulls,
    resolution,
    resolution_against,
    resolutions,
)
from cgemit.analysis.vertices import PairMasses, pair_masses
from cgemit.analysis.widths import Fraction, GaussianFit, Resolution, gaussian_fit, measure
from cgemit.detector.inventory import Background
from cgemit.study.monitor import RunMonitor, monitor
from cgemit.study.optimize.result import Confirmation, Optimization
from cgemit.study.optimize.run import optimize
from cgemit.study.optimize.search import Search
from cgemit.study.paper.results import Reproduction
from cgemit.study.paper.run import reproduce
from cgemit.study.scan import AnalyticScan, Scan, scan, scan_analytic
from cgemit.study.sweep.evaluate import Evaluation
from cgemit.study.sweep.result import Sweep
from cgemit.study.sweep.run import sweep
from cgemit.study.sweep.space import PlanError, Space, grid, latin_hypercube, sobol

__all__ = [
    "AnalyticScan",
    "Background",
    "Confirmation",
    "Cosmics",
    "Curve",
    "DeltaFractions",
    "Evaluation",
    "Finding",
    "FindingRates",
    "Flatness",
    "FormFit",
    "Fraction",
    "GaussianFit",
    "HitResiduals",
    "LayerCrossings",
    "LayerEfficiencies",
    "LoopLinks",
    "Optimization",
    "PairMasses",
    "PlanError",
    "Pulls",
    "Reproduction",
    "ResidualTable",
    "Resolution",
    "Resolutions",
    "RunMonitor",
    "Scan",
    "Search",
    "Space",
    "Sweep",
    "chi2_flatness",
    "chi2_probability",
    "cosmics",
    "delta_displacements",
    "delta_fractions",
    "finding",
    "fit_form",
    "gaussian_fit",
    "grid",
    "hit_residuals",
    "latin_hypercube",
    "layer_crossings",
    "layer_efficiencies",
    "loop_links",
    "measure",
    "monitor",
    "optimize",
    "pair_masses",
    "pulls",
    "reproduce",
    "resolution",
    "resolution_against",
    "resolutions",
    "scan",
    "scan_analytic",
    "sobol",
    "strip_status",
    "sweep",
]
