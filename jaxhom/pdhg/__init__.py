"""Batched restarted PDHG for saddle-point problems, and the projections that the problems share."""

from jaxhom.pdhg.engine import SOLVER, PDHGState, Problem, init, solve, step
from jaxhom.status import Status

__all__ = ["SOLVER", "PDHGState", "Problem", "Status", "init", "solve", "step"]
