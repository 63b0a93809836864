"""LPAL: apprenticeship learning by linear programming (Syed, Bowling and Schapire 2008).

Given expectations Vhat of the expert's features, find the policy with the largest margin,

    v* = max_pi min_i V_i(pi) - Vhat_i = max_pi min_{w in simplex} w . (V(pi) - Vhat)

(Boularias and Chaib-draa 2010, eqs. 2-5). Rewards are non-negative combinations of the features, so a policy of
margin v is worth at least the expert's value plus v times the sum of the weights.

`columns` plays the game over policies, `flow` runs PDHG on the linear program itself (`flow_factor` prepares its
projection on the flow), `interior_point` a sparse interior-point method on the same, and `quickest` chooses; all end in
`certificate`, which computes the true margin of the policy that is returned and the best upper bound. `presolve` takes
out what no policy can reach, `sensitivity` gives the margin its derivatives.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.certificate import Certifier, LPALSolution
from jaxhom.apprenticeship.columns import solve_by_columns
from jaxhom.apprenticeship.flow import solve_by_flow
from jaxhom.apprenticeship.interior_point import solve_by_interior_point
from jaxhom.apprenticeship.presolve import default_tolerance, reduce_expectations
from jaxhom.apprenticeship.quickest import solve_by_the_quickest
from jaxhom.apprenticeship.sensitivity import with_derivatives, without_tangents
from jaxhom.models.inputs import as_model, check_policy
from jaxhom.models.mdp import MDP

_METHODS = {
    "auto": solve_by_the_quickest,
    "columns": solve_by_columns,
    "flow": solve_by_flow,
    "interior_point": solve_by_interior_point,
}

_LARGEST = 2.0**-20  # share of the largest number of a type: what sums of expectations may need stays within it
_FLOAT32_GOAL = 0.5  # share of the tolerance that methods aim for: the rest is for what the model's rounding hides

__all__ = ["LPALSolution", "lpal"]


def lpal(
    mdp: MDP,
    expectations: jax.Array,
    *,
    initial_policy: jax.Array | None = None,
    warm_start: LPALSolution | None = None,
    tolerance: float | None = None,
    method: str = "auto",
    max_iterations: int | None = None,
    progress: bool = False,
) -> LPALSolution:
    """Finds the policy whose feature expectations exceed the given ones by the largest margin.

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
      method: "columns"; "interior_point", one lane at a time, for models whose graph is a narrow band (grids) and any
        number of features; "auto" for the quicker of these two, or both together;
        or "flow" for PDHG on the linear program with exact projections on the flow, all lanes at once: an independent
        second opinion, slower, for models whose graph is a narrow band or that have up to a few thousand states.
      max_iterations: what to stop after, per lane, whichever method runs; `status` is then ITERATION_LIMIT. It counts
        columns, that is best responses ("columns", default 500), interior-point steps ("interior_point", 100), both
        together ("auto", 500) or PDHG iterations ("flow", in sixteens; 20,000, one to seven thousand are usual).
      progress: show a progress bar of the largest gap.

    Returns:
      `LPALSolution`, with a leading axis [B] if the expectations have one. Its bounds hold whatever the status: they
      are computed in float64 from the policy and the weights that are returned, rounding included. STALLED says that
      rounding keeps them further apart than the tolerance.
      Under `jax.grad` and `jax.jvp`, but not under jit or vmap, `margin` and `margin_bound` have the derivative of the
      best margin with respect to expectations and to the model's probability, initial, features and discount
      (`jaxhom.apprenticeship.sensitivity`). Policy, occupancy and weights are constants there.

    Raises:
      ValueError: on wrong shapes, expectations that are not finite, an initial policy whose rows are not
        distributions or that does what is not allowed, a warm start that is none, a model without features, numbers so
        large that their sums over time overflow, an unknown method, a model too large for method "flow"; under jit or
        vmap; on second derivatives.

    Source: Syed, Bowling and Schapire 2008; Boularias and Chaib-draa 2010, eqs. (2)-(5).
    """
    if not isinstance(method, str) or method not in _METHODS:
        raise ValueError(f"method must be one of {tuple(_METHODS)}, got {method!r}")
    mdp = as_model(mdp)
    if not mdp.num_features:
        raise ValueError("the model has no features: build it with features=[S, A, K], K >= 1")
    inputs = (mdp, expectations)
    mdp, expectations, initial_policy, warm_start = without_tangents((mdp, expectations, initial_policy, warm_start))
    if checks.is_traced(mdp, expectations, initial_policy, warm_start):
        raise ValueError("lpal adds columns on the host: call it outside jit and vmap, in batches [B, K]")
    host = _checked_expectations(mdp, expectations)
    batch = np.atleast_2d(host).astype(np.float64)
    options = {"progress": progress}
    if max_iterations is not None:
        options["max_iterations"] = checks.require_count("max_iterations", max_iterations)
    if warm_start is not None:
        _require_solution(warm_start)
        if initial_policy is None:
            initial_policy = warm_start.policy
        if method in ("auto", "columns"):
            options["initial_weights"] = _guess("warm_start.weights", warm_start.weights, batch)
    if initial_policy is not None:
        initial_policy = _guess("initial_policy", check_policy(mdp, initial_policy, "initial_policy"), batch)
    solution = _solve(mdp, batch, initial_policy, tolerance, _METHODS[method], options)
    if checks.is_traced(inputs):
        mdp, expectations = inputs
        solution = with_derivatives(solution, mdp, jnp.atleast_2d(jnp.asarray(expectations, mdp.dtype)))
    return solution if host.ndim == 2 else jax.tree.map(lambda leaf: leaf[0], solution)


def _solve(mdp: MDP, expectations: np.ndarray, initial_policy, tolerance, method, options: dict) -> LPALSolution:
    """A batch [B, K], in units in which features are about 1 and expectations within reach."""
    reduction = reduce_expectations(mdp, expectations)
    if tolerance is None:
        tolerance = default_tolerance(mdp, reduction)
    else:
        checks.require_positive("tolerance", tolerance)
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), len(expectations))
    features = np.asarray(mdp.features)
    unit = float(np.exp2(np.floor(np.log2(np.abs(features).max() or 1.0))))  # a power of two changes no digit
    certify = Certifier(mdp, expectations, tolerance, reduction, unit)
    scaled = mdp
    if unit != 1.0:
        scaled = dataclasses.replace(mdp, features=checks.to_device(features / features.dtype.type(unit)))
    goal = tolerance / unit if mdp.dtype == jnp.float64 else _FLOAT32_GOAL * tolerance / unit
    found = method(scaled, reduction.expectations / unit, initial_policy, goal, certify, **options)
    return jax.tree.map(checks.to_device, found)


def _checked_expectations(mdp: MDP, expectations) -> np.ndarray:
    """Expectations [K] or [B, K]; together with the features small enough for sums over time in the model's type."""
    host = checks.as_host_array("expectations", expectations)
    good = host.ndim in (1, 2) and host.shape[-1] == mdp.num_features and host.size > 0
    checks.require_shape("expectations", host, f"({mdp.num_features},) or (B, {mdp.num_features})", good)
    host = checks.require_floats("expectations", host)
    largest, message = _LARGEST * float(np.finfo(mdp.dtype).max), f"is too large for margins in {mdp.dtype}"
    checks.require_all("expectations", host, np.abs(host) <= largest, message)
    features, largest = np.asarray(mdp.features), largest * (1.0 - float(mdp.discount))
    if max(features.max(), -features.min()) > largest:
        message = f"is too large for sums over time in {mdp.dtype} at this discount"
        checks.require_all("features", features, np.abs(features) <= largest, message)
    return host


def _require_solution(warm_start) -> None:
    if not isinstance(warm_start, LPALSolution):
        raise ValueError(f"warm_start must be an LPALSolution, got {type(warm_start).__name__}")


def _guess(name: str, guess, batch: np.ndarray) -> np.ndarray:
    """Distributions [..., n], one for all lanes of the batch or one for each, as [B, ..., n]."""
    guess = checks.as_host_array(name, guess)
    lane_ndim = 1 if name.endswith("weights") else 2
    lane_shape = batch.shape[1:] if lane_ndim == 1 else guess.shape[-2:]
    good = guess.shape[-lane_ndim:] == lane_shape and guess.shape[:-lane_ndim] in ((), (len(batch),))
    checks.require_shape(name, guess, f"({len(batch)}, {'K' if lane_ndim == 1 else 'S, A'})", good)
    guess = checks.require_distribution(name, guess)
    return np.broadcast_to(guess, (len(batch), *lane_shape))
