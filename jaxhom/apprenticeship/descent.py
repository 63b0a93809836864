"""Who minimises: weights under penalties and signs, by L-BFGS-B on the host, or by any optimiser of optax in a program.

What is minimised is an objective of `causal_entropy` plus l1 |u|_1 + l2 / 2 |u|_2^2, u the weights of scaled features.
A lane that ends says how: the largest entry of the gradient that signs do not forbid to follow.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.causal_entropy import Evidence, HostObjective, objective_in_program
from jaxhom.models.mdp import MDP
from jaxhom.planning.host_chains import host_model
from jaxhom.status import Status

_STEP = 0.1  # of Adam, which is what programs use where no optimiser is given; in units of scaled weights


class Problem(NamedTuple):
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
        """Whether variables are two parts of the weights."""
        return self.l1 > 0 and not self.nonnegative

    @property
    def is_bounded(self) -> bool:
        """Whether variables must be non-negative."""
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


class Fit(NamedTuple):
    """Weights of scaled features [B, K], and per lane the objective, the gradient's norm, iterations and status."""

    weights: Any
    objective: Any
    gradient_norm: Any
    iterations: Any
    status: Any


def fit_on_host(mdp: MDP, features, evidence: Evidence, start, problem: Problem, progress: bool) -> Fit:
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
        fits.append(Fit(problem.weights(result.x), result.fun, norm, result.nit, int(status)))
    return Fit(*map(np.asarray, zip(*fits, strict=True)))


def fit_in_program(mdp: MDP, features, evidence: Evidence, start, problem: Problem, optimizer) -> Fit:
    """All lanes by an optimiser of optax, in one loop, which is compiled once per optimiser."""
    optimizer = _adam() if optimizer is None else optimizer
    if not (callable(getattr(optimizer, "init", None)) and callable(getattr(optimizer, "update", None))):
        raise ValueError(f"optimizer must be an optax.GradientTransformation, got {checks.in_one_line(optimizer)}")
    arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, mdp.dtype), (features, start))
    evidence = jax.tree.map(lambda leaf: jnp.asarray(leaf, mdp.dtype), evidence)
    return _descend(mdp, *arrays, evidence, problem=problem, optimizer=optimizer)


@functools.cache
def _adam():
    import optax

    return optax.adam(_STEP)


@functools.partial(jax.jit, static_argnames=("problem", "optimizer"))
def _descend(mdp: MDP, features, start, evidence: Evidence, *, problem: Problem, optimizer) -> Fit:
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


def _descend_one(mdp: MDP, features, start, problem: Problem, optimizer, evidence: Evidence) -> Fit:
    """One lane: steps of the optimiser, each projected on the signs; the best variables of the way are returned."""
    import optax

    optimizer = optax.with_extra_args_support(optimizer)

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
    return Fit(problem.weights(variables), objective, gradient_norm, end.iterations, status)
