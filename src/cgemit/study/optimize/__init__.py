"""Optimization: the best designs of one objective, or the front of several."""

from cgemit.detector.inventory import Background
from cgemit.study.optimize.result import Confirmation, Optimization
from cgemit.study.optimize.run import optimize
from cgemit.study.optimize.search import Search

__all__ = ["Background", "Confirmation", "Optimization", "Search", "optimize"]
