"""Occupancy measures, feature expectations and policy values by jitted linear solves.

With P_pi(s, s') = sum_a pi(s, a) T(s, a, s'), the state occupancy mu and the value V of a reward r are the
solutions of a linear system and of its transpose:

    (I - gamma P_pi)^T mu = alpha,   x(s, a) = mu(s) pi(s, a)        (the flow, Boularias and Chaib-draa eq. 3)
    (I - gamma P_pi)   V  = r_pi,    r_pi(s) = sum_a pi(s, a) r(s, a)

Concrete policies, up to 128 at a time of moderate models, are solved in float64 on the host (`host_chains`), by sparse
LU on graphs like roads, grids and corridors, and so is what iterations leave open; everything else, and everything
under jit, vmap and grad, by `chain_solver`. A solution that nobody can vouch for (a policy that holds NaN, say) comes
back as NaN, never as a wrong number. Derivatives are implicit (one more solve with the transpose), whatever the method.

Policies are [S, A] or a batch [B, S, A]; inside, the batch is the last axis. The way back, from an occupancy to the
policy that has it, is eq. (5).
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model, check_policy, check_reward, require_policy_shape
from jaxhom.models.mdp import MDP
from jaxhom.planning.chain_solver import solve_chain
from jaxhom.planning.host_chains import HostChain, host_model
from jaxhom.planning.progress import progress_of_sweeps

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Array, ArrayLike, Bool, Float, Int

    Policy = Float[ArrayLike, "*B S A"] | Int[ArrayLike, " S"]

_EXACT = 1e-10  # relative error of products on the host that counts as none
NO_OCCUPANCY = 1e-9  # share of all discounted time below which eq. (5) is 0 / 0: what solvers leave where nothing goes


def occupancy(mdp: MDP, policy: Policy, *, progress: bool = False) -> Float[Array, "*B S A"]:
    """Discounted state-action occupancy x(s, a) = E sum_t gamma^t 1[s_t = s, a_t = a].

    Works under `jit`, `vmap` and `grad`, in the policy and in all numbers of the model.

    Args:
      mdp: the model.
      policy: [S, A] or [B, S, A], rows sum to 1; integers [S] are the actions of one that is deterministic.
      progress: show how far the residual is, on large models whose arrays are concrete.

    Returns:
      [S, A] or [B, S, A]; each sums to 1 / (1 - discount).

    Raises:
      ValueError: if `policy` has another shape, or is concrete and no policy.

    Example:
      >>> from jaxhom import MDP
      >>> mdp = MDP.from_dense([[[0.0, 1.0]], [[0.0, 1.0]]], discount=0.5, initial=[1, 0])
      >>> occupancy(mdp, [[1.0], [1.0]]).tolist()  # one step in state 0, all others in state 1
      [[1.0], [1.0]]

    Source: Boularias and Chaib-draa 2010, section II and eqs. (3)-(4).
    """
    mdp = as_model(mdp)
    policy = check_policy(mdp, policy)
    if checks.is_at_hand(mdp, policy):
        return checks.to_device(_occupancy_at_hand(mdp, policy, progress))
    if policy.ndim == 3:
        return jnp.moveaxis(_occupancy(mdp, jnp.moveaxis(policy, 0, -1)), -1, 0)
    return _occupancy(mdp, policy)


def feature_expectations(mdp: MDP, policy: Policy, *, progress: bool = False) -> Float[Array, "*B K"]:
    """Discounted feature expectations V_i(pi) = sum_{s, a} x_pi(s, a) phi_i(s, a).

    Works under `jit`, `vmap` and `grad`, as `occupancy`.

    Args:
      mdp: the model, with K features.
      policy: [S, A] or [B, S, A], rows sum to 1; or integers [S].
      progress: show how far the residual is, on large models whose arrays are concrete.

    Returns:
      [K] or [B, K]; divide by 1 / (1 - discount) for a weighted average per step.

    Raises:
      ValueError: if `policy` has another shape, or is concrete and no policy.

    Example:
      >>> from jaxhom import MDP
      >>> mdp = MDP.from_dense([[[0.0, 1.0]], [[0.0, 1.0]]], discount=0.5, initial=[1, 0], features=[[3.0], [5.0]])
      >>> feature_expectations(mdp, [[1.0], [1.0]]).tolist()
      [8.0]

    Source: Boularias and Chaib-draa 2010, section II.
    """
    mdp = as_model(mdp)
    policy = check_policy(mdp, policy)
    if checks.is_at_hand(mdp, policy):
        pairs = _occupancy_at_hand(mdp, policy, progress).reshape(*policy.shape[:-2], mdp.allowed.size)
        return checks.to_device(pairs @ np.asarray(mdp.features).reshape(mdp.allowed.size, mdp.num_features))
    return jnp.einsum("...sa,sak->...k", occupancy(mdp, policy), mdp.features)


def policy_value(
    mdp: MDP, policy: Policy, reward: Float[ArrayLike, "*B S A"], *, progress: bool = False
) -> Float[Array, "*B S"]:
    """State values V(s) = E[sum_t gamma^t r(s_t, a_t) | s_0 = s] of a policy.

    Works under `jit`, `vmap` and `grad`, in policy, reward and all numbers of the model.

    Args:
      mdp: the model.
      policy: [S, A] or [B, S, A], rows sum to 1; or integers [S].
      reward: [S, A], or [B, S, A] beside a batch of policies.
      progress: show how far the residual is, on large models whose arrays are concrete.

    Returns:
      [S] or [B, S], in units of reward, discounted sums: up to 1 / (1 - discount) times the largest reward.

    Raises:
      ValueError: if the shapes do not fit, or concrete values are no policy or no finite reward.

    Example:
      >>> from jaxhom import MDP
      >>> mdp = MDP.from_dense([[[0.0, 1.0]], [[0.0, 1.0]]], discount=0.5)
      >>> policy_value(mdp, [[1.0], [1.0]], [[3.0], [5.0]]).tolist()
      [8.0, 10.0]

    Source: Boularias and Chaib-draa 2010, section II.
    """
    mdp = as_model(mdp)
    policy = require_policy_shape(mdp, policy)
    reward = check_reward(mdp, reward, policy.shape)
    policy = check_policy(mdp, policy)
    if checks.is_at_hand(mdp, policy, reward):
        reward_under_policy = (np.asarray(policy) * reward).sum(axis=-1)
        return checks.to_device(_solve_at_hand(mdp, policy, reward_under_policy, transpose=False, progress=progress))
    reward_under_policy = (policy * reward).sum(axis=-1)
    if policy.ndim == 3:
        batch_last = jnp.moveaxis(policy, 0, -1)
        return _solve_values(mdp, batch_last, reward_under_policy.T).T
    return _solve_values(mdp, policy, reward_under_policy)


def policy_from_occupancy(
    mdp: MDP,
    x: Float[Array, "*B S A"] | Float[np.ndarray, "*B S A"],
    fallback: Float[ArrayLike, "*B S A"],
    negligible: float = NO_OCCUPANCY,
) -> Float[Array, "*B S A"]:
    """pi(s, a) = x(s, a) / sum_a' x(s, a'), eq. (5); `fallback` where the state's share of all time is negligible.

    Works under `jit` and `vmap`; in NumPy if x is a NumPy array.

    Args:
      mdp: the model, of which only the discount is read.
      x: [..., S, A], occupancies that sum to 1 / (1 - discount), as solvers leave them: entries below 0 count as 0.
      fallback: [..., S, A], a policy for states that do not occur.
      negligible: the share, see `has_occupancy`.

    Returns:
      [..., S, A], rows sum to 1.

    Source: Boularias and Chaib-draa 2010, eq. (5).
    """
    numpy = np if isinstance(x, np.ndarray) else jnp
    x = numpy.maximum(x, 0.0)
    occurs = has_occupancy(mdp, x, negligible)[..., None]
    return numpy.where(occurs, x / numpy.where(occurs, x.sum(axis=-1, keepdims=True), 1.0), fallback)


def has_occupancy(
    mdp: MDP, x: Float[Array, "*B S A"] | Float[np.ndarray, "*B S A"], negligible: float = NO_OCCUPANCY
) -> Bool[Array, "*B S"]:
    """The states whose share of all discounted time, sum_a x(s, a) (1 - gamma), is above `negligible`; else 0 / 0."""
    discount = float(mdp.discount) if isinstance(x, np.ndarray) else mdp.discount
    return x.sum(axis=-1) > negligible / (1.0 - discount)


@functools.partial(jax.jit, static_argnames="is_quick")
def _occupancy(mdp: MDP, policy: jax.Array, *, is_quick: bool = False) -> jax.Array:
    """`occupancy` with the batch, if any, last: [S, A] or [S, A, B]."""
    return _state_occupancy(mdp, policy, mdp.initial, is_quick=is_quick)[:, None] * policy


@functools.partial(jax.jit, static_argnames="is_quick")
def _state_occupancy(mdp: MDP, policy: jax.Array, initial: jax.Array, *, is_quick: bool = False) -> jax.Array:
    """mu [S] or [S, B] of an initial distribution [S] or [S, B]."""
    if initial.ndim < policy.ndim - 1:
        initial = initial[:, None]
    initial = jnp.broadcast_to(initial, policy.shape[:1] + policy.shape[2:])
    solution = solve_chain(mdp, policy, initial, transpose=True, is_quick=is_quick)
    # Rounding can leave -1e-17 where nothing goes; lifted without touching the derivative.
    return solution + jax.lax.stop_gradient(jnp.maximum(solution, 0.0) - solution)


@functools.partial(jax.jit, static_argnames="is_quick")
def _solve_values(mdp: MDP, policy: jax.Array, source: jax.Array, *, is_quick: bool = False) -> jax.Array:
    """Solves (I - gamma P_pi) V = source; [S] or, batch last, [S, B]."""
    return solve_chain(mdp, policy, source, transpose=False, is_quick=is_quick)


def _occupancy_at_hand(mdp: MDP, policy: jax.Array, progress: bool) -> np.ndarray:
    """`occupancy` of concrete policies."""
    mu = _solve_at_hand(mdp, policy, np.asarray(mdp.initial), transpose=True, progress=progress)
    return mu[..., None] * np.asarray(policy)


def _solve_at_hand(
    mdp: MDP, policy: jax.Array, source: np.ndarray, *, transpose: bool, progress: bool = False
) -> np.ndarray:
    """State occupancies (of sources that are distributions) or values of concrete policies, [S] or [B, S].

    The host is asked first where it is sure to be quick, and last, for what the device could not do, where it can.
    """
    policies = np.asarray(policy).reshape(-1, mdp.num_states, mdp.num_actions)
    sources = np.broadcast_to(source, (len(policies), mdp.num_states))
    model, solutions = host_model(mdp), np.full(sources.shape, np.nan)
    iterates = model.iterates_sooner(len(policies))

    def open_lanes() -> np.ndarray:
        return np.flatnonzero(np.isnan(solutions).any(axis=1))

    def on_host(solve: Callable[[HostChain, np.ndarray], np.ndarray], *, gives_up: bool = False, **options) -> None:
        for lane in open_lanes():
            solutions[lane] = solve(model.chain(policies[lane], **options), sources[lane].astype(np.float64))
            if gives_up and np.isnan(solutions[lane]).any():  # others would take hundreds of products for nothing, too
                break

    def on_device() -> None:
        if len(left := open_lanes()):
            solve = _state_occupancy if transpose else _solve_values
            solutions[left] = solve(mdp, np.moveaxis(policies[left], 0, -1), sources[left].T, is_quick=True).T

    def solved(chain: HostChain, source: np.ndarray) -> np.ndarray:
        return (chain.state_occupancy if transpose else chain.value)(source, _EXACT)

    with progress_of_sweeps(progress) as report:
        if transpose and model.moves_sooner(_EXACT):
            on_host(lambda chain, source: chain.moved(source, _EXACT, report), may_factorise=False)
        if not model.solves_sooner(len(policies)):
            if iterates:
                on_host(solved, gives_up=True, may_iterate=True, may_factorise=False)
            if not (iterates and model.is_swept(_EXACT)):
                on_device()
        if model.is_solvable:
            on_host(solved)
        else:
            on_host(
                lambda chain, source: chain.swept(source, _EXACT, is_flow=transpose, report=report), may_factorise=False
            )
    return solutions.reshape(policy.shape[:-1]).astype(mdp.dtype)
