"""Maximum causal entropy: the reward under which what the expert did is likeliest, for an expert who errs at random.

Ziebart, Bagnell and Dey (2010), for discounted rewards and an infinite horizon. The objectives and their gradients are
in `causal_entropy`; here are the penalties, the signs of weights, and who minimises: SciPy's L-BFGS-B where everything
is concrete, and any optimiser of optax, followed by a projection on the signs, if one is given and inside programs.

Penalties and tolerances are for features in units of what each can do per step, so that a feature in thousands and one
in thousandths are treated alike; the weights that are returned are those of the features as they are.
"""

from __future__ import annotations

import contextlib
import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.arguments import check_features, checked_expectations
from jaxhom.apprenticeship.causal_entropy import (
    Evidence,
    HostObjective,
    frequencies_of,
    objective_in_program,
    scaled_features,
)
from jaxhom.apprenticeship.learned import Learned
from jaxhom.models.demonstrations import Demonstrations, require_demonstrations
from jaxhom.models.inputs import as_model, require_features
from jaxhom.models.mdp import MDP
from jaxhom.planning.host_chains import host_model
from jaxhom.planning.occupancy import feature_expectations
from jaxhom.planning.optimal import optimal_policy
from jaxhom.planning.soft_optimal import soft_optimal_policy
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_STEP = 0.1  # of Adam, which is what programs use where no optimiser is given; in units of scaled weights


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
      ValueError: unless one of demonstrations and expectations is given; on wrong shapes, a model without features,
        negative penalties, demonstrations without a decision, initial weights that are negative where they must not be.

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
    problem = _Problem(
        nonnegative=bool(nonnegative),
        l1=_penalty("l1", l1),
        l2=_penalty("l2", l2),
        tolerance=tolerance,
        max_iterations=checks.require_count("max_iterations", max_iterations),
    )
    start = _start(mdp, initial_weights, scale, problem.nonnegative)
    on_host = optimizer is None and checks.is_at_hand(mdp, evidence, start)
    with one_blas_thread() if on_host else contextlib.nullcontext():
        if on_host:
            fit = _fit_on_host(mdp, features, evidence, start, problem, progress)
        else:
            fit = _fit_in_program(mdp, features, evidence, start, problem, optimizer)
        found = _learned(mdp, features, scale, fit, problem)
    if not is_batch:
        xp = checks.arrays_of(found)
        found = jax.tree.map(lambda leaf: xp.asarray(leaf)[0], found)
    return jax.tree.map(checks.to_device, found)


class _Problem(NamedTuple):
    """Signs, penalties, and when to stop.

    What is minimised over are `variables`: weights that must be non-negative, or are free; with a penalty l1, which has
    a kink at 0, free weights are differences of two that must be non-negative.
    """

    nonnegative: bool
    l1: float
    l2: float
    tolerance: float
    max_iterations: int

    @property
    def is_split(self) -> bool:
        return self.l1 > 0 and not self.nonnegative

    @property
    def is_bounded(self) -> bool:
        return self.nonnegative or self.is_split

    def variables(self, xp, weights):
        """[K] or [2 K]."""
        return xp.concatenate([xp.maximum(weights, 0), xp.maximum(-weights, 0)]) if self.is_split else weights

    def weights(self, variables):
        """[K], of scaled features."""
        if not self.is_split:
            return variables
        half = len(variables) // 2
        return variables[:half] - variables[half:]

    def penalty(self, variables):
        """Of variables; linear where they are bounded."""
        weights = self.weights(variables)
        return 0.5 * self.l2 * (weights @ weights) + (self.l1 * variables.sum() if self.is_bounded else 0.0)

    def penalty_gradient(self, variables):
        """Likewise."""
        return self.l2 * self.spread(self.weights(variables)) + (self.l1 if self.is_bounded else 0.0)

    def spread(self, gradient):
        """A gradient by weights as one by variables; in NumPy."""
        return np.concatenate([gradient, -gradient]) if self.is_split else gradient

    def projected(self, xp, variables, gradient):
        """The largest entry of the gradient that signs do not forbid to follow."""
        step = variables - gradient
        return xp.abs(variables - (xp.maximum(step, 0) if self.is_bounded else step)).max()


class _Fit(NamedTuple):
    """Weights of scaled features [B, K], and per lane the objective, the gradient's norm, iterations and status."""

    weights: Any
    objective: Any
    gradient_norm: Any
    iterations: Any
    status: Any


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


def _fit_on_host(mdp: MDP, features, evidence: Evidence, start, problem: _Problem, progress: bool) -> _Fit:
    """Lane by lane by L-BFGS-B, which lets variables be bounded."""
    from scipy.optimize import minimize
    from tqdm import tqdm

    model, fits = host_model(mdp), []
    for lane in range(len(jax.tree.leaves(evidence)[0])):
        one = jax.tree.map(lambda leaf, lane=lane: leaf[lane], evidence)
        objective = HostObjective(mdp, model, features, one)

        def penalised(variables, objective=objective):
            value, gradient = objective(problem.weights(variables))
            return value + problem.penalty(variables), problem.spread(gradient) + problem.penalty_gradient(variables)

        variables = problem.variables(np, np.asarray(start, np.float64))
        with tqdm(desc="maximum causal entropy", unit="step", disable=not progress, leave=False) as bar:
            result = minimize(
                penalised,
                variables,
                jac=True,
                method="L-BFGS-B",
                bounds=[(0, None)] * len(variables) if problem.is_bounded else None,
                callback=lambda _, bar=bar: bar.update(),
                options={"maxiter": problem.max_iterations, "maxfun": 20 * problem.max_iterations, "maxcor": 30}
                | {"gtol": 0.5 * problem.tolerance, "ftol": 0.0},
            )
        norm = float(problem.projected(np, result.x, result.jac))
        limited = Status.ITERATION_LIMIT if result.nit >= problem.max_iterations else Status.STALLED
        status = Status.SOLVED if norm <= problem.tolerance else limited
        fits.append(_Fit(problem.weights(result.x), result.fun, norm, result.nit, int(status)))
    return _Fit(*map(np.asarray, zip(*fits, strict=True)))


def _fit_in_program(mdp: MDP, features, evidence: Evidence, start, problem: _Problem, optimizer) -> _Fit:
    """All lanes by an optimiser of optax, in one loop."""
    import optax

    optimizer = optax.adam(_STEP) if optimizer is None else optimizer
    if not (callable(getattr(optimizer, "init", None)) and callable(getattr(optimizer, "update", None))):
        raise ValueError(f"optimizer must be an optax.GradientTransformation, got {checks.in_one_line(optimizer)}")
    optimizer = optax.with_extra_args_support(optimizer)
    arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, mdp.dtype), (features, start))
    evidence = jax.tree.map(lambda leaf: jnp.asarray(leaf, mdp.dtype), evidence)
    return _descend(mdp, *arrays, evidence, problem=problem, optimizer=optimizer)


@functools.partial(jax.jit, static_argnames=("problem", "optimizer"))
def _descend(mdp: MDP, features, start, evidence: Evidence, *, problem: _Problem, optimizer) -> _Fit:
    fit = functools.partial(_descend_one, *jax.lax.stop_gradient((mdp, features, start)), problem, optimizer)
    return jax.vmap(fit)(jax.lax.stop_gradient(evidence))


class _Descent(NamedTuple):
    """What the loop of an optimiser carries."""

    variables: jax.Array
    memory: Any
    value: jax.Array
    objective: jax.Array
    gradient: jax.Array
    best: tuple[jax.Array, jax.Array, jax.Array]
    iterations: jax.Array


def _descend_one(mdp: MDP, features, start, problem: _Problem, optimizer, evidence: Evidence) -> _Fit:
    """One lane: steps of the optimiser, each projected on the signs; the best variables of the way are returned."""
    import optax

    def penalised(variables, value):
        objective, value = objective_in_program(mdp, features, evidence, problem.weights(variables), value)
        return objective + problem.penalty(variables), value

    evaluate = jax.value_and_grad(penalised, has_aux=True)

    def norm(state):
        return problem.projected(jnp, state.variables, state.gradient)

    def look(state):
        (objective, value), gradient = evaluate(state.variables, state.value)
        state = state._replace(objective=objective, value=value, gradient=gradient)
        is_better = objective < state.best[0]
        found = objective, norm(state), state.variables
        return state._replace(best=jax.tree.map(lambda new, old: jnp.where(is_better, new, old), found, state.best))

    def keep_going(state):
        return (state.best[1] > problem.tolerance) & (state.iterations < problem.max_iterations)

    def step(state):
        extra = {"value": state.objective, "grad": state.gradient, "value_fn": lambda x: penalised(x, state.value)[0]}
        updates, memory = optimizer.update(state.gradient, state.memory, state.variables, **extra)
        variables = optax.apply_updates(state.variables, updates)
        variables = jnp.maximum(variables, 0.0) if problem.is_bounded else variables
        return look(state._replace(variables=variables, memory=memory, iterations=state.iterations + 1))

    variables = problem.variables(jnp, start)
    infinite = jnp.asarray(jnp.inf, mdp.dtype)
    first = _Descent(
        variables,
        optimizer.init(variables),
        jnp.zeros(mdp.num_states, mdp.dtype),
        infinite,
        variables,
        (infinite, infinite, variables),
        jnp.int32(0),
    )
    end = jax.lax.while_loop(keep_going, step, look(first))
    objective, gradient_norm, variables = end.best
    limited = jnp.where(end.iterations >= problem.max_iterations, Status.ITERATION_LIMIT, Status.STALLED)
    status = jnp.where(gradient_norm <= problem.tolerance, Status.SOLVED, limited)
    return _Fit(problem.weights(variables), objective, gradient_norm, end.iterations, status)


def _learned(mdp: MDP, features, scale, fit: _Fit, problem: _Problem) -> Learned:
    """The policies of the weights, with leading axis [B]."""
    xp = checks.arrays_of(mdp, features, scale, fit.weights)
    scaled = xp.asarray(fit.weights).astype(mdp.dtype)
    reward = xp.einsum("sak,bk->bsa", xp.asarray(features), scaled).astype(mdp.dtype)
    soft, greedy = soft_optimal_policy(mdp, reward), optimal_policy(mdp, reward)
    statuses = xp.stack([xp.asarray(part) for part in (fit.status, soft.status, greedy.status)])
    is_first_bad = xp.argmax(statuses != Status.SOLVED, axis=0)
    return Learned(
        policy=soft.policy,
        greedy_policy=greedy.policy,
        weights=(scaled / scale).astype(mdp.dtype),
        expectations=feature_expectations(mdp, soft.policy),
        objective=xp.asarray(fit.objective).astype(mdp.dtype),
        gradient_norm=xp.asarray(fit.gradient_norm).astype(mdp.dtype),
        iterations=xp.asarray(fit.iterations).astype(np.int32),
        status=xp.take_along_axis(statuses, is_first_bad[None], axis=0)[0].astype(np.int32),
    )
