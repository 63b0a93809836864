"""Maximum causal entropy: the reward under which what the expert did is likeliest, for an expert who errs at random.

Ziebart, Bagnell and Dey (2010), for discounted rewards and an infinite horizon. The objectives and their gradients are
in `causal_entropy`; penalties, the signs of weights, and who minimises in `descent`: SciPy's L-BFGS-B where everything
is concrete, and any optimiser of optax, followed by a projection on the signs, if one is given and inside programs.

Penalties and tolerances are for features in units of what each can do per step, so that a feature in thousands and one
in thousandths are treated alike; the weights that are returned are those of the features as they are.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.arguments import check_features, checked_expectations
from jaxhom.apprenticeship.causal_entropy import Evidence, frequencies_of, scaled_features
from jaxhom.apprenticeship.descent import Fit, Problem, fit_in_program, fit_on_host
from jaxhom.apprenticeship.learned import Learned
from jaxhom.models.demonstrations import Demonstrations, require_demonstrations
from jaxhom.models.inputs import as_model, require_features
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import feature_expectations
from jaxhom.planning.optimal import optimal_policy
from jaxhom.planning.soft_optimal import soft_optimal_policy
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float


def max_causal_entropy(
    mdp: MDP,
    demonstrations: Demonstrations | None = None,
    *,
    expectations: Float[ArrayLike, "*B K"] | None = None,
    nonnegative: bool = True,
    l1: float = 0.0,
    l2: float = 1e-3,
    optimizer: Any = None,
    initial_weights: Float[ArrayLike, " K"] | None = None,
    tolerance: float | None = None,
    max_iterations: int = 1000,
    progress: bool = False,
) -> Learned:
    """Finds reward weights by maximum causal entropy, from demonstrations or from feature expectations.

    With pi_w the soft optimal policy of the reward features @ w (`soft_optimal_policy`, temperature 1), it minimises

        -log likelihood per step of the demonstrations, mean of -log pi_w(a | s), or, given expectations Vhat,
        (1 - discount) (initial . V_w - w . Vhat),

    plus l1 |u|_1 + l2 / 2 |u|_2^2, u = scale w. The second is convex, and without penalties its optimum is the policy
    of largest causal entropy whose feature expectations are Vhat (at least Vhat where weights are non-negative).
    `scale` is what each feature can do per step; a feature that is constant has weight 0. What demonstrations do in
    absorbing states is no decision, and not counted.

    Works under `jit` and `vmap`, in demonstrations or expectations and all numbers of the model; options are constants.
    Objective, soft policy and greedy policy have no derivatives through the fit: for those, differentiate
    `soft_optimal_policy`.

    Args:
      mdp: the model, with K >= 1 features.
      demonstrations: M trajectories, whose likelihood counts.
      expectations: [K] or [B, K], in the units of `feature_expectations`, to match instead: of Monte Carlo, or of a
        generalized policy. They need not be any policy's, but without l2 weights then grow without end.
      nonnegative: whether weights must not be negative, as LPAL's; free otherwise.
      l1: penalty on the sum of |u|: features that explain little get weight 0.
      l2: penalty on the sum of squares; it keeps weights finite where demonstrations never err.
      optimizer: an `optax.GradientTransformation`, with or without extra arguments (`optax.lbfgs()` too); SciPy's
        L-BFGS-B if None, or `optax.adam(0.1)` inside a program.
      initial_weights: [K], where to begin; zero if None.
      tolerance: largest entry of the projected gradient by u to settle for; default 1e-6, or 1e-4 in float32.
      max_iterations: of the optimiser.
      progress: show a progress bar.

    Returns:
      `Learned`: `policy` is the soft one, to be compared with an expert who errs; `greedy_policy` is optimal for the
      weights, and usually worth more. `objective` is with penalties, `gradient_norm` as in `tolerance`; SOLVED says
      that it is within it. The likelihood is not quite convex where chance plays a part: a minimum may be a local one.

    Raises:
      ValueError: unless one of demonstrations and expectations is given; on wrong shapes, a model without features or
        with such small ones that weights overflow, negative penalties, demonstrations without a decision, initial
        weights that are negative where they must not be.

    Source: Ziebart, Bagnell and Dey 2010; Ziebart 2010, sections 5 and 6.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4, num_regions=4)
      >>> expert = jaxhom.optimal_policy(grid.mdp, grid.mdp.features[..., 3])
      >>> walks = jaxhom.sample_demonstrations(jax.random.key(0), grid.mdp, expert.policy, 2, 10)
      >>> learned = jaxhom.max_causal_entropy(grid.mdp, walks)
      >>> int(learned.weights.argmax()), jaxhom.Status(int(learned.status)).name
      (3, 'SOLVED')
    """
    mdp = as_model(mdp)
    evidence, is_batch = _evidence(mdp, demonstrations, expectations)
    features, scale = scaled_features(mdp)
    if evidence.expectations is not None:
        evidence = Evidence(expectations=_scaled(evidence.expectations, scale))
    tolerance = _default_tolerance(mdp) if tolerance is None else checks.require_number("tolerance", tolerance)
    checks.require_positive("tolerance", tolerance)
    problem = Problem(
        nonnegative=checks.require_switch("nonnegative", nonnegative),
        l1=_penalty("l1", l1),
        l2=_penalty("l2", l2),
        tolerance=tolerance,
        max_iterations=checks.require_count("max_iterations", max_iterations),
    )
    start = _start(mdp, initial_weights, scale, problem.nonnegative)
    on_host = optimizer is None and checks.is_at_hand(mdp, evidence, start)
    with one_blas_thread() if on_host else contextlib.nullcontext():
        if on_host:
            fit = fit_on_host(mdp, features, evidence, start, problem, progress)
        else:
            fit = fit_in_program(mdp, features, evidence, start, problem, optimizer)
        found = _learned(mdp, features, scale, fit)
    if not is_batch:
        xp = checks.arrays_of(found)
        found = jax.tree.map(lambda leaf: xp.asarray(leaf)[0], found)
    return jax.tree.map(checks.to_device, found)


def _evidence(mdp: MDP, demonstrations, expectations) -> tuple[Evidence, bool]:
    """What is fitted to, with a leading axis [B] of lanes, and whether that was given."""
    require_features(mdp)
    if (demonstrations is None) == (expectations is None):
        raise ValueError("give either demonstrations or expectations")
    if not checks.is_traced(mdp):
        check_features(mdp)
    if expectations is not None:
        expectations = checked_expectations(mdp, expectations)
        is_batch = expectations.ndim == 2
        return Evidence(expectations=expectations if is_batch else expectations[None]), is_batch
    require_demonstrations(demonstrations).validate(mdp, "warn")
    frequencies = frequencies_of(mdp, demonstrations)
    if not checks.is_traced(frequencies) and not np.asarray(frequencies).any():
        raise ValueError("demonstrations hold no decision: no step, or none outside absorbing states")
    return Evidence(frequencies=frequencies[None]), False


def _scaled(array, scale):
    """Expectations in units of scaled features; those of constant features are 0."""
    xp = checks.arrays_of(array, scale)
    return xp.where(xp.isinf(scale), 0.0, xp.asarray(array) / scale)


def _default_tolerance(mdp: MDP) -> float:
    return 1e-6 if mdp.dtype == jnp.float64 else 1e-4


def _penalty(name: str, value: float) -> float:
    checks.refuse_traced(**{name: value})
    checks.require_positive(name, value, or_zero=True)
    return checks.require_number(name, value)


def _start(mdp: MDP, weights, scale, nonnegative: bool):
    """Initial weights of scaled features, [K]."""
    if weights is None:
        return np.zeros(mdp.num_features, mdp.dtype)
    if not checks.is_traced(weights):
        weights = checks.require_floats("initial_weights", checks.as_host_array("initial_weights", weights))
        good = (weights >= 0) | (not nonnegative)
        checks.require_all("initial_weights", weights, good, "must not be negative unless nonnegative=False")
    expected = (mdp.num_features,)
    checks.require_shape("initial_weights", weights, str(expected), np.shape(weights) == expected)
    xp = checks.arrays_of(weights, scale)
    return xp.where(xp.isinf(scale), 0.0, xp.asarray(weights) * xp.where(xp.isinf(scale), 1.0, scale))


def _learned(mdp: MDP, features, scale, fit: Fit) -> Learned:
    """The policies of the weights, with leading axis [B]."""
    xp = checks.arrays_of(mdp, features, scale, fit.weights)
    scaled = xp.asarray(fit.weights).astype(mdp.dtype)
    reward = xp.einsum("sak,bk->bsa", xp.asarray(features), scaled).astype(mdp.dtype)
    soft, greedy = soft_optimal_policy(mdp, reward), optimal_policy(mdp, reward)
    weights = (scaled / scale).astype(mdp.dtype)
    if xp is np and not np.isfinite(weights).all():
        raise ValueError(f"features are too small for weights in {mdp.dtype}: multiply them by a constant")
    statuses = xp.stack([xp.asarray(part) for part in (fit.status, soft.status, greedy.status)])
    is_first_bad = xp.argmax(statuses != Status.SOLVED, axis=0)
    return Learned(
        policy=soft.policy,
        greedy_policy=greedy.policy,
        weights=weights,
        expectations=feature_expectations(mdp, soft.policy),
        objective=xp.asarray(fit.objective).astype(mdp.dtype),
        gradient_norm=xp.asarray(fit.gradient_norm).astype(mdp.dtype),
        iterations=xp.asarray(fit.iterations).astype(np.int32),
        status=xp.take_along_axis(statuses, is_first_bad[None], axis=0)[0].astype(np.int32),
    )
