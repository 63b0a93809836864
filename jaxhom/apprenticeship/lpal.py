"""LPAL: apprenticeship learning by linear programming (Syed, Bowling and Schapire 2008).

Given expectations Vhat of the expert's features, find the policy with the largest margin,

    v* = max_pi min_i V_i(pi) - Vhat_i = max_pi min_{w in simplex} w . (V(pi) - Vhat)

(Boularias and Chaib-draa 2010, eqs. 2-5). Rewards are non-negative combinations of the features, so a policy of
margin v is worth at least the expert's value plus v times the sum of the weights.

A call is checked, presolved (`presolve` takes out what no policy can reach) and handed to a method as a `Request`; what
the method has found is certified: `certificate` computes the true margin of the policy that is returned and the best
upper bound; and `sensitivity` gives the margin its derivatives. A method is a function from `Request` to `Found`, and
a line of `METHODS`. `columns` plays the game over policies, `pdhg` runs a first-order method on the linear program
itself, `interior_point` an interior-point method on the same, and `quickest` chooses.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.arguments import (
    check_features,
    check_tolerance,
    checked_expectations,
    checked_start,
)
from jaxhom.apprenticeship.certificate import Certifier
from jaxhom.apprenticeship.columns import solve_by_columns
from jaxhom.apprenticeship.in_program import ITERATIONS, solve_in_program
from jaxhom.apprenticeship.interior_point import solve_by_interior_point
from jaxhom.apprenticeship.model_in_program import ModelInProgram
from jaxhom.apprenticeship.pdhg import solve_by_pdhg
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.presolve import default_tolerance, reduce_expectations
from jaxhom.apprenticeship.quickest import solve_by_the_quickest
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.sensitivity import with_derivatives, without_tangents
from jaxhom.apprenticeship.solution import Found, LPALMethod, LPALSolution
from jaxhom.models.inputs import as_model, require_features
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float

METHODS: dict[str, Callable[[Request], Found]] = {
    "auto": solve_by_the_quickest,
    "columns": solve_by_columns,
    "interior_point": solve_by_interior_point,
    "pdhg": solve_by_pdhg,
}

FORMER_METHODS = {"flow": "pdhg"}

_FLOAT32_GOAL = 0.5  # share of the tolerance that methods aim for: the rest is for what the model's rounding hides

__all__ = ["LPAL", "LPALMethod", "LPALSolution", "lpal"]


def lpal(
    mdp: MDP,
    expectations: Float[ArrayLike, "*B K"],
    *,
    initial_policy: Float[ArrayLike, "*B S A"] | None = None,
    warm_start: LPALSolution | None = None,
    tolerance: float | Float[ArrayLike, " B"] | None = None,
    method: str = "auto",
    max_iterations: int | None = None,
    progress: bool = False,
) -> LPALSolution:
    """Finds the policy whose feature expectations exceed the given ones by the largest margin.

    It solves max_pi min_i V_i(pi) - expectations_i over all stationary policies.

    Args:
      mdp: the model, with K >= 1 features.
      expectations: [K] or a batch [B, K], discounted feature expectations Vhat of the expert, in the units of
        `feature_expectations` (sums over time, not averages per step). No policy need reach them.
      initial_policy: [S, A] or [B, S, A], a good guess: the policy that the expectations came from, for one.
      warm_start: a former solution for similar expectations or a similar model, of one lane or of as many as there are
        expectations: its weights and, unless `initial_policy` is given, its policy are where to begin.
      tolerance: largest certified gap margin_bound - margin to settle for. By default 1e-5 / (1 - discount) times the
        least that any feature can do which may be the smallest: its range, or twice the distance from its largest value
        to the median of the others where that is less (a cliff is not what gaps are measured by). For features within
        [0, 1] that reach both that is 1e-5 / (1 - discount).
      method: "columns"; "interior_point", for models whose graph is a narrow band (grids) and any number of features;
        "pdhg", a first-order method on the linear program with exact projections on the flow, all lanes at once, for
        models whose graph is a narrow band or that have up to a few thousand states; or "auto" for the quickest of
        them. "pdhg" and "auto" hand lanes that a method does not close on to the others: `decided_by` says who closed
        them. "flow" is the former name of "pdhg", which warns.
      max_iterations: what to stop after, per lane, whichever method runs; `status` is then ITERATION_LIMIT. It counts
        columns, that is best responses ("columns", default 500), interior-point steps ("interior_point", 100), both
        together ("auto", 500), or PDHG iterations, in tens, and what follows them ("pdhg", 250 and 500).
      progress: show a progress bar of the largest gap.

    Returns:
      `LPALSolution`, with a leading axis [B] if the expectations have one. Its bounds hold whatever the status: they
      are computed in float64 from the policy and the weights that are returned, rounding included. STALLED says that
      rounding keeps them further apart than the tolerance.

    Works under `jit`, `vmap` and `grad`, in all arrays of the model but its graph (`next_state`), in expectations and
    starts; options are constants. Inside a program method "pdhg" runs, which is what "auto" means there, in one loop of
    at most 1,000 iterations, with columns in between (`jaxhom.apprenticeship.in_program`); under `vmap` all lanes are
    one batch. Its bounds are in the model's type: in float32 they are as wide as its rounding, some 1e-5 /
    (1 - discount)^2. Close over a model and exchange its arrays by `mdp.replace(...)`: one that is an argument itself
    has a traced graph, and may have up to 4,096 states. With concrete values alone a call inside a program runs at once
    and is a constant.

    Under `jax.grad` and `jax.jvp`, `margin` and `margin_bound` have the derivative of the best margin with respect to
    expectations and to the model's probability, initial, features and discount
    (`jaxhom.apprenticeship.sensitivity`); policy, occupancy and weights are constants there.

    Raises:
      ValueError: on wrong shapes, expectations that are not finite, an initial policy whose rows are not
        distributions or that does what is not allowed, a warm start that is none, a model without features, numbers so
        large that their sums over time overflow, an unknown method, a model too large for method "pdhg"; inside a
        program on a traced option, or on a method that works on the host; on second derivatives.

    Source: Syed, Bowling and Schapire 2008; Boularias and Chaib-draa 2010, eqs. (2)-(5).

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> expert = jaxhom.optimal_policy(mdp, mdp.features[..., 3])
      >>> solution = jaxhom.lpal(mdp, jaxhom.feature_expectations(mdp, expert.policy), tolerance=0.01)
      >>> print(bool(solution.margin_bound - solution.margin <= 0.01))
      True
      >>> import jax
      >>> found = jax.jit(lambda vhat: jaxhom.lpal(mdp, vhat, tolerance=0.01))(solution.margin + jax.numpy.ones(4))
      >>> print(bool(found.margin_bound - found.margin <= 0.01))
      True
    """
    method = _checked_method(method)
    options = {"tolerance": tolerance, "method": method, "max_iterations": max_iterations, "progress": progress}
    return LPAL(mdp).solve(expectations, initial_policy=initial_policy, warm_start=warm_start, **options)


class LPAL:
    """LPAL on a prepared model: many calls over it share what does not depend on the expectations.

    `LPAL(mdp).solve(...)` returns what `lpal(mdp, ...)` returns, to the bit. What a method prepares (a factorisation, a
    sparse program) is made when a call first needs it and kept as long as the handle. One call at a time: the handle is
    not for several threads.

    Args:
      mdp: the model, with K >= 1 features; traced as in `lpal`.

    Raises:
      ValueError: if the model has no features, or features so large that their sums over time overflow.

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> prepared = jaxhom.LPAL(mdp)
      >>> margins = [float(prepared.solve([vhat] * 4).margin) for vhat in (0.0, 10.0)]
      >>> print(round(margins[0] - margins[1], 3))
      10.0
    """

    def __init__(self, mdp: MDP):
        self._mdp = as_model(mdp)
        require_features(self._mdp)
        model = without_tangents(self._mdp)
        if checks.is_traced(model):
            self._model, self._program = None, ModelInProgram.of_traced(model)
        else:
            check_features(model)
            self._model = PreparedModel(model)

    def __repr__(self) -> str:
        return f"LPAL({self._mdp!r})"

    def solve(
        self,
        expectations: Float[ArrayLike, "*B K"],
        *,
        initial_policy: Float[ArrayLike, "*B S A"] | None = None,
        warm_start: LPALSolution | None = None,
        tolerance: float | Float[ArrayLike, " B"] | None = None,
        method: str = "auto",
        max_iterations: int | None = None,
        progress: bool = False,
    ) -> LPALSolution:
        """`lpal` on the prepared model; see there for arguments, results and errors."""
        method = _checked_method(method)
        if max_iterations is not None:
            max_iterations = checks.require_count("max_iterations", max_iterations)
        if tolerance is not None:
            checks.refuse_traced(tolerance=tolerance)
        given = expectations
        expectations, policy, warm_start = without_tangents((expectations, initial_policy, warm_start))
        expectations = checked_expectations(self._mdp, expectations)
        if tolerance is not None:
            check_tolerance(tolerance, expectations)
        batch = expectations if expectations.ndim == 2 else expectations[None]
        is_inside = self._model is None or checks.is_traced(expectations, policy, warm_start)
        if is_inside:
            solution = self._solve_in_program(batch, policy, warm_start, tolerance, method, max_iterations)
        else:
            with checks.at_once():  # inside a program this is a constant
                solution = self._solve_on_host(batch, policy, warm_start, tolerance, method, max_iterations, progress)
        if checks.is_traced(self._mdp, given):
            given = jnp.asarray(given, self._mdp.dtype).reshape(batch.shape)
            solution = with_derivatives(jax.tree.map(checks.to_device, solution), self._mdp, given)
        if expectations.ndim == 1:
            solution = jax.tree.map(lambda leaf: leaf[0], solution)
        return jax.tree.map(checks.to_device, solution)

    def _solve_on_host(
        self, batch: Float[np.ndarray, "B K"], policy, warm_start, tolerance, method: str, limit: int | None, progress
    ) -> LPALSolution:
        policy, weights = checked_start(self._model.given, batch.shape, policy, warm_start)
        request = _presolved(self._model, batch.astype(np.float64), tolerance)
        request = request.replace(policy=policy, weights=weights, limit=limit, progress=progress)
        return request.certified(METHODS[method](request))

    def _solve_in_program(
        self, batch: Float[Array, "B K"], policy, warm_start, tolerance, method: str, limit: int | None
    ) -> LPALSolution:
        if method not in ("auto", "pdhg"):
            raise ValueError(f"method={method!r} works on the host: inside jit and vmap lpal is by method='pdhg'")
        policy, weights = checked_start(self._mdp, batch.shape, policy, warm_start)
        start = {"policy": policy, "weights": weights}
        limit = ITERATIONS if limit is None else limit
        return solve_in_program(self._program, jnp.asarray(batch), tolerance=tolerance, max_iterations=limit, **start)

    @functools.cached_property
    def _program(self) -> ModelInProgram:
        with checks.at_once():
            return ModelInProgram.of_concrete(self._model)


def _presolved(model: PreparedModel, expectations: Float[np.ndarray, "B K"], tolerance) -> Request:
    """The request for a batch: in units in which features are about 1, and expectations within reach."""
    reduction = reduce_expectations(model.reach, expectations)
    if tolerance is None:
        tolerance = default_tolerance(model.reach, reduction)
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), len(expectations))
    share = 1.0 if model.given.dtype == jnp.float64 else _FLOAT32_GOAL
    return Request(
        model=model,
        expectations=reduction.expectations / model.unit,
        tolerance=share * tolerance / model.unit,
        certifier=Certifier(model.sides, expectations, tolerance, reduction, model.unit),
        lanes=np.arange(len(expectations)),
    )


def _checked_method(method: str) -> str:
    """A method of the table; under its former name with a warning."""
    if isinstance(method, str) and method in FORMER_METHODS:
        checks.warn(f"method={method!r} is now called {FORMER_METHODS[method]!r}", DeprecationWarning)
        return FORMER_METHODS[method]
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method must be one of {tuple(METHODS)}, got {method!r}")
    return method
