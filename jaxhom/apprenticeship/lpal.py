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

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.certificate import Certifier
from jaxhom.apprenticeship.columns import solve_by_columns
from jaxhom.apprenticeship.interior_point import solve_by_interior_point
from jaxhom.apprenticeship.pdhg import solve_by_pdhg
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.presolve import default_tolerance, reduce_expectations
from jaxhom.apprenticeship.quickest import solve_by_the_quickest
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.sensitivity import with_derivatives, without_tangents
from jaxhom.apprenticeship.solution import Found, LPALMethod, LPALSolution
from jaxhom.models.inputs import as_model, check_policy
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

METHODS: dict[str, Callable[[Request], Found]] = {
    "auto": solve_by_the_quickest,
    "columns": solve_by_columns,
    "interior_point": solve_by_interior_point,
    "pdhg": solve_by_pdhg,
}

FORMER_METHODS = {"flow": "pdhg"}

_LARGEST = 2.0**-20  # share of the largest number of a type: what sums of expectations may need stays within it
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

    Works on the host: not under `jit` or `vmap`, for which expectations come in batches. Under `jax.grad` and
    `jax.jvp`, `margin` and `margin_bound` have the derivative of the best margin with respect to expectations and to
    the model's probability, initial, features and discount (`jaxhom.apprenticeship.sensitivity`); policy, occupancy
    and weights are constants there.

    Raises:
      ValueError: on wrong shapes, expectations that are not finite, an initial policy whose rows are not
        distributions or that does what is not allowed, a warm start that is none, a model without features, numbers so
        large that their sums over time overflow, an unknown method, a model too large for method "pdhg"; under jit or
        vmap; on second derivatives.

    Source: Syed, Bowling and Schapire 2008; Boularias and Chaib-draa 2010, eqs. (2)-(5).

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> expert = jaxhom.optimal_policy(mdp, mdp.features[..., 3])
      >>> solution = jaxhom.lpal(mdp, jaxhom.feature_expectations(mdp, expert.policy), tolerance=0.01)
      >>> print(bool(solution.margin_bound - solution.margin <= 0.01))
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
      mdp: the model, with K >= 1 features; as in `lpal`, not under `jit` or `vmap`, but under `grad`.

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
        if not self._mdp.num_features:
            raise ValueError("the model has no features: build it with features=[S, A, K], K >= 1")
        concrete = without_tangents(self._mdp)
        _refuse_traced(concrete)
        _check_features(concrete)
        self._model = PreparedModel(concrete)

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
        given = expectations
        expectations, initial_policy, warm_start = without_tangents((expectations, initial_policy, warm_start))
        _refuse_traced(expectations, initial_policy, warm_start)
        host = _checked_expectations(self._model.given, expectations)
        batch = np.atleast_2d(host).astype(np.float64)
        policy, weights = _checked_start(self._model.given, batch, initial_policy, warm_start)
        if max_iterations is not None:
            max_iterations = checks.require_count("max_iterations", max_iterations)
        request = _presolved(self._model, batch, tolerance)
        request = request.replace(policy=policy, weights=weights, limit=max_iterations, progress=progress)
        solution = request.certified(METHODS[method](request))
        if checks.is_traced(self._mdp, given):
            given = jnp.atleast_2d(jnp.asarray(given, self._mdp.dtype))
            solution = with_derivatives(jax.tree.map(checks.to_device, solution), self._mdp, given)
        if host.ndim == 1:
            solution = jax.tree.map(lambda leaf: leaf[0], solution)
        return jax.device_put(solution)


def _presolved(model: PreparedModel, expectations: Float[np.ndarray, "B K"], tolerance) -> Request:
    """The request for a batch: in units in which features are about 1, and expectations within reach."""
    reduction = reduce_expectations(model.reach, expectations)
    if tolerance is None:
        tolerance = default_tolerance(model.reach, reduction)
    else:
        checks.require_positive("tolerance", tolerance)
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), len(expectations))
    share = 1.0 if model.given.dtype == jnp.float64 else _FLOAT32_GOAL
    return Request(
        model=model,
        expectations=reduction.expectations / model.unit,
        tolerance=share * tolerance / model.unit,
        certifier=Certifier(model.sides, expectations, tolerance, reduction, model.unit),
        lanes=np.arange(len(expectations)),
    )


# ------------------------------------------------------------------------------------------------------------- checks


def _checked_method(method: str) -> str:
    """A method of the table; under its former name with a warning."""
    if isinstance(method, str) and method in FORMER_METHODS:
        warnings.warn(f"method={method!r} is now called {FORMER_METHODS[method]!r}", DeprecationWarning, stacklevel=3)
        return FORMER_METHODS[method]
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method must be one of {tuple(METHODS)}, got {method!r}")
    return method


def _refuse_traced(*trees) -> None:
    if checks.is_traced(*trees):
        raise ValueError("lpal adds columns on the host: call it outside jit and vmap, in batches [B, K]")


def _check_features(mdp: MDP) -> None:
    """Small enough for sums over time in the model's type."""
    features, largest = np.asarray(mdp.features), _largest(mdp) * (1.0 - float(mdp.discount))
    if max(features.max(), -features.min()) > largest:
        message = f"is too large for sums over time in {mdp.dtype} at this discount"
        checks.require_all("features", features, np.abs(features) <= largest, message)


def _checked_expectations(mdp: MDP, expectations) -> Float[np.ndarray, "*B K"]:
    """Expectations [K] or [B, K], small enough for margins in the model's type."""
    host = checks.as_host_array("expectations", expectations)
    good = host.ndim in (1, 2) and host.shape[-1] == mdp.num_features and host.size > 0
    checks.require_shape("expectations", host, f"({mdp.num_features},) or (B, {mdp.num_features})", good)
    host = checks.require_floats("expectations", host)
    checks.require_all("expectations", host, np.abs(host) <= _largest(mdp), f"is too large for margins in {mdp.dtype}")
    return host


def _largest(mdp: MDP) -> float:
    return _LARGEST * float(np.finfo(mdp.dtype).max)


def _checked_start(mdp: MDP, batch: Float[np.ndarray, "B K"], initial_policy, warm_start):
    """Policies [B, S, A] and weights [B, K] to begin with, or None."""
    weights = None
    if warm_start is not None:
        if not isinstance(warm_start, LPALSolution):
            raise ValueError(f"warm_start must be an LPALSolution, got {type(warm_start).__name__}")
        initial_policy = warm_start.policy if initial_policy is None else initial_policy
        weights = _for_each_lane("warm_start.weights", warm_start.weights, batch)
    if initial_policy is not None:
        policy = check_policy(mdp, initial_policy, "initial_policy")
        initial_policy = _for_each_lane("initial_policy", policy, batch)
    return initial_policy, weights


def _for_each_lane(name: str, guess, batch: Float[np.ndarray, "B K"]) -> np.ndarray:
    """Distributions [..., n], one for all lanes of the batch or one for each, as [B, ..., n]."""
    guess = checks.as_host_array(name, guess)
    lane_ndim = 1 if name.endswith("weights") else 2
    lane_shape = batch.shape[1:] if lane_ndim == 1 else guess.shape[-2:]
    good = guess.shape[-lane_ndim:] == lane_shape and guess.shape[:-lane_ndim] in ((), (len(batch),))
    checks.require_shape(name, guess, f"({len(batch)}, {'K' if lane_ndim == 1 else 'S, A'})", good)
    guess = checks.require_distribution(name, guess)
    return np.broadcast_to(guess, (len(batch), *lane_shape))
