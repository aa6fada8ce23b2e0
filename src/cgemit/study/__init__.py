"""Studies of the chain's tables: resolutions, pulls and the flatness of the chi-square probability."""

from cgemit.statistics.chi2 import Flatness, chi2_flatness, chi2_probability
from cgemit.statistics.estimate import Resolution, measure
from cgemit.statistics.forms import FormFit, fit_form
from cgemit.statistics.fractions import Fraction
from cgemit.statistics.resolutions import Curve, pulls, resolution, resolution_against, resolutions
from cgemit.statistics.widths import GaussianFit, Pulls, Resolutions, gaussian_fit
from cgemit.study.analytic_scan import AnalyticScan, scan_analytic
from cgemit.study.cluster_residuals import DeltaFractions, delta_displacements, delta_fractions
from cgemit.study.cosmic_halves import Cosmics, cosmics
from cgemit.study.finding_metrics import Finding, FindingRates, finding
from cgemit.study.loop_links import LoopLinks, loop_links
from cgemit.study.optimizer import Background, Confirmation, Optimization, OptimizeError, optimize
from cgemit.study.paper import Reproduction, reproduce
from cgemit.study.robustness import Outcome, run_scenario
from cgemit.study.scans import Scan, scan
from cgemit.study.scenarios import SCENARIOS, Scenario
from cgemit.study.sweeps import Space, Sweep, grid, latin_hypercube, sobol, sweep

__all__ = [
    "SCENARIOS",
    "AnalyticScan",
    "Background",
    "Confirmation",
    "Cosmics",
    "Curve",
    "DeltaFractions",
    "Finding",
    "FindingRates",
    "Flatness",
    "FormFit",
    "Fraction",
    "GaussianFit",
    "LoopLinks",
    "Optimization",
    "OptimizeError",
    "Outcome",
    "Pulls",
    "Reproduction",
    "Resolution",
    "Resolutions",
    "Scan",
    "Scenario",
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
    "latin_hypercube",
    "loop_links",
    "measure",
    "optimize",
    "pulls",
    "reproduce",
    "resolution",
    "resolution_against",
    "resolutions",
    "run_scenario",
    "scan",
    "scan_analytic",
    "sobol",
    "sweep",
]
