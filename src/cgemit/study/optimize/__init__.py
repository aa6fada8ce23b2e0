"""Optimization: the best designs of one objective, or the front of several."""

from cgemit.detector.inventory import Background
from cgemit.study.optimize.result import Confirmation, Optimization
from cgemit.study.optimize.run import OptimizeError, optimize

__all__ = ["Background", "Confirmation", "Optimization", "OptimizeError", "optimize"]
