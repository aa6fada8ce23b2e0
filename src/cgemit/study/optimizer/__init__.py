"""Optimization: the best designs of one objective, or the front of several."""

from cgemit.study.optimizer.confirm import Confirmation
from cgemit.study.optimizer.geometry import Background
from cgemit.study.optimizer.result import Optimization
from cgemit.study.optimizer.run import OptimizeError, optimize

__all__ = ["Background", "Confirmation", "Optimization", "OptimizeError", "optimize"]
