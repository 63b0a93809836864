"""Batched restarted PDHG for saddle-point problems, and the projections that the problems share."""

from jaxhom.pdhg.engine import PDHGState, Problem, Status, init, solve, step
from jaxhom.pdhg.queue import solve_many

__all__ = ["PDHGState", "Problem", "Status", "init", "solve", "solve_many", "step"]
