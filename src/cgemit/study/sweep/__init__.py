"""Sweeps: many variants of a detector evaluated by any executor, kept in files, joined to one table."""

from cgemit.study.sweep.evaluate import Evaluation
from cgemit.study.sweep.result import Sweep
from cgemit.study.sweep.run import sweep
from cgemit.study.sweep.space import PlanError, Space, grid, latin_hypercube, sobol

__all__ = ["Evaluation", "PlanError", "Space", "Sweep", "grid", "latin_hypercube", "sobol", "sweep"]
