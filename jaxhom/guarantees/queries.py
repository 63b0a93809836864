"""Where to ask the expert next: single states in which an answer tells most about what the learned policy meets.

A demonstration goes where the expert goes, and mostly over what is known already. An answer about one state costs one
step and may lie where the learned policy is led by a guess. States are ranked by how often that policy meets them,
mu(s) in discounted time, by how unsure it is there, or by what they add to a bound on what is lost (`loss_bound`).

What an answer can change at most is known before it is given. Let the policy do a in s, and what it did elsewhere. With
h(s') the discounted number of visits to s from s', and d = T(s, a, .) - P_pi(s, .), the new chain is P_pi + e_s d, and
(Sherman and Morrison 1950)

    V' - V  =  (I - gamma P_pi - gamma e_s d)^-1 e_s A(s, a)  =  h A(s, a) / (1 - gamma d . h),

A the advantage of a under the policy as it is; from the start, alpha . h = mu(s). Over weights of sum 1 the largest
such change is that of a single feature.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.guarantees.loss_bound import loss_bound
from jaxhom.models.demonstrations import Demonstrations, empirical_policy
from jaxhom.models.inputs import as_model, check_policy
from jaxhom.models.mdp import MDP, absorbing_states
from jaxhom.models.names import Names, described
from jaxhom.planning.host_chains import host_model
from jaxhom.planning.occupancy import has_occupancy, occupancy, policy_value
from jaxhom.status import Record

if TYPE_CHECKING:
    from types import ModuleType

    from jaxtyping import Array, ArrayLike, Bool, Float, Int

_SURE = 0.05  # nats that count beside the entropy: where the policy is sure, visits alone decide
_CHUNK = 16  # states whose changes are computed at once


class Queries(Record):
    """States to ask the expert about, the best first; `print` lists them.

    Attributes:
      states: int32 [count].
      scores: [count], those of the criterion, falling.
      changes: [count], by how much an answer changes the value of a single feature at most, in either direction: in the
        discounted sums of V from the initial distribution, over all actions that are allowed there, the policy left as
        it is elsewhere. The same for every reward features @ w, w >= 0 of sum 1. None if the model has no features.
      criterion: what they were ranked by.
      status: int32 scalar, a `jaxhom.Status`: that of the bound, None for other criteria.
      state_names: what the model calls its states; None without names, and after JAX transformations.
    """

    states: Int[Array, " count"]
    scores: Float[Array, " count"]
    changes: Float[Array, " count"] | None = None
    criterion: str = dataclasses.field(metadata={"static": True})
    status: Int[Array, ""] | None = None
    state_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})

    def __str__(self) -> str:
        try:
            return _in_words(self)
        except Exception:  # a batch, or what is no array but describes one
            return repr(self)


def query_states(
    mdp: MDP,
    demonstrations: Demonstrations,
    policy: Float[ArrayLike, "S A"] | Int[ArrayLike, " S"],
    count: int,
    *,
    criterion: str = "visits_entropy",
    terminal: Bool[ArrayLike, " S"] | None = None,
) -> Queries:
    """Ranks the states in which the expert was not seen by how much it helps to ask there.

    Asked about are undemonstrated states in which something is to be decided: several actions are allowed, and the
    state neither absorbs nor ends an episode. One of score 0 is not asked about even if nothing else is left: the
    learned policy does not come there, so what the expert does there changes nothing.

    The answers become demonstrations by `demonstrations.with_answers(states, actions)`, from which the next policy is
    learned. Then ask again: which states matter depends on the policy.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories, and its answers so far.
      policy: [S, A], the learned one; integers [S]; or what has one as `.policy`.
      count: how many states, at least 1.
      criterion: what ranks them. "visits": mu(s), the policy's discounted visits, which sum to 1 / (1 - discount) over
        all states; "visits_entropy": mu(s) (H(policy(s, .)) + 0.05), with the entropy H in nats; "bound": the state's
        contribution to `loss_bound(mdp, demonstrations, policy)`, where it is positive, in units of the features.
      terminal: bool [S], states in which an episode ends, for models in which these do not absorb; none if None.

    Returns:
      `Queries`, the highest score first, the lowest state first among equal ones. Fewer than `count` if fewer have a
      score. Visits to a state whose share of all time is below 1e-9, which solvers leave where nothing goes, count as
      none.

    Raises:
      ValueError: if `count` is below 1, the criterion is unknown, `terminal` is not bool [S], the policy is none, or a
        demonstration does not fit the model; with "bound" also if the model has no features, or anything is traced.

    Warns:
      ImpossibleStepsWarning: if steps have probability 0; see `Demonstrations.validate`.

    On the host where everything is concrete. The criteria of visits work under `jit` and `vmap` too, with `count`
    static, and under `grad`, which sees scores and changes, not the order. There always `count` states come out, S at
    most; where there is none left, the state is -1, which `with_answers` skips, and its score and change are 0.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4, num_regions=4, discount=0.9)
      >>> shown = jaxhom.Demonstrations.from_trajectories([([0, 1, 2, 3, 7], [3, 3, 3, 1, 1])])
      >>> general = jaxhom.nearest_neighbors(grid, shown)
      >>> queries = jaxhom.query_states(grid, shown, general, 3, criterion="visits")
      >>> queries.states.tolist(), queries.scores.round(3).tolist()
      ([15, 11, 14], [3.383, 0.84, 0.547])
      >>> answered = shown.with_answers(queries.states, [1, 1, 1])

    Source: asking about states rather than for trajectories is active imitation learning (Judah, Fern and Dietterich
    2012); the change by the formula of Sherman and Morrison 1950.
    """
    mdp = as_model(mdp)
    count = checks.require_count("count", count)
    if not isinstance(criterion, str) or criterion not in _SCORES:
        raise ValueError(f"criterion must be one of {', '.join(_SCORES)}, got {checks.in_one_line(criterion)}")
    if checks.is_traced(mdp, demonstrations, getattr(policy, "policy", policy), terminal):
        return _ranked(mdp, demonstrations, policy, count, criterion, terminal, jnp)
    with checks.at_once():
        return _ranked(mdp, demonstrations, policy, count, criterion, terminal, np)


def _ranked(mdp: MDP, demonstrations, policy, count: int, criterion: str, terminal, xp: ModuleType) -> Queries:
    """`query_states`; `xp` is NumPy on the host and `jax.numpy` where anything is traced."""
    policy = xp.asarray(check_policy(mdp, policy, batch=False))
    askable = _askable(mdp, demonstrations, terminal, xp)
    visits = _visits(mdp, policy, xp)
    scores, status = _SCORES[criterion](mdp, demonstrations, policy, visits, xp)
    states, scores = _highest(xp.where(askable, xp.maximum(scores, 0.0), 0.0), count, xp)
    changes = None
    if mdp.num_features:
        changes = xp.where(states >= 0, _changes(mdp, policy, visits, xp.maximum(states, 0), xp), 0.0)
    return Queries(
        states=checks.to_device(states, jnp.int32),
        scores=checks.to_device(scores, mdp.dtype),
        changes=None if changes is None else checks.to_device(changes, mdp.dtype),
        criterion=criterion,
        status=status,
        state_names=mdp.state_names,
    )


def _askable(mdp: MDP, demonstrations, terminal, xp: ModuleType):
    """bool [S]: nothing was demonstrated, and something is to be decided."""
    visited, _ = empirical_policy(mdp, demonstrations)
    askable = ~xp.asarray(visited) & ~xp.asarray(absorbing_states(mdp))
    if mdp.restricts_actions:
        askable = askable & (xp.asarray(mdp.allowed).sum(axis=1) > 1)
    elif mdp.num_actions == 1:
        askable = xp.zeros_like(askable)
    if terminal is not None:
        terminal = terminal if checks.is_traced(terminal) else checks.as_host_array("terminal", terminal)
        askable = askable & ~checks.require_flags("terminal", terminal, mdp.num_states)
    return askable


def _visits(mdp: MDP, policy, xp: ModuleType):
    """mu [S]; 0 where nothing goes but rounding."""
    pairs = xp.asarray(occupancy(mdp, policy))
    return xp.where(has_occupancy(mdp, pairs), pairs.sum(axis=1), 0.0)


def _by_visits(mdp, demonstrations, policy, visits, xp):
    return visits, None


def _by_visits_and_entropy(mdp, demonstrations, policy, visits, xp):
    entropy = -(policy * xp.log(xp.where(policy > 0, policy, 1.0))).sum(axis=1)
    return visits * (entropy + _SURE), None


def _by_bound(mdp, demonstrations, policy, visits, xp):
    loss = loss_bound(mdp, demonstrations, policy)
    return xp.asarray(loss.contributions), loss.status


_SCORES: dict[str, Callable[..., tuple[Any, Any]]] = {
    "visits_entropy": _by_visits_and_entropy,
    "visits": _by_visits,
    "bound": _by_bound,
}
CRITERIA = tuple(_SCORES)


def _highest(scores, count: int, xp: ModuleType):
    """The states of the highest scores, and these; of score 0 none, or -1 where the number of states must not vary."""
    if xp is np:
        states = np.argsort(-scores, kind="stable")[:count]
        states = states[scores[states] > 0]
        return states, scores[states]
    highest, states = jax.lax.top_k(scores, min(count, len(scores)))
    return jnp.where(highest > 0, states, -1), highest


def _changes(mdp: MDP, policy, visits, states, xp: ModuleType):
    """[n]: the largest |V_k' - V_k| over features k and over the actions a of each state."""
    values = _values(mdp, policy, xp.moveaxis(xp.asarray(mdp.features), -1, 0))
    chunks = [states[start : start + _CHUNK] for start in range(0, len(states), _CHUNK)]
    return xp.concatenate([visits[:0], *(_changes_of(mdp, policy, visits, chunk, values, xp) for chunk in chunks)])


def _changes_of(mdp: MDP, policy, visits, states, values, xp: ModuleType):
    """`_changes` of a few states; values [K, S] are V."""
    is_there = states[:, None] == xp.arange(mdp.num_states)
    reward = xp.broadcast_to(is_there[..., None], (*is_there.shape, mdp.num_actions)).astype(mdp.dtype)
    hits = _values(mdp, policy, reward)  # [n, S]
    own, allowed, features, chance, successor = (
        xp.asarray(array)[states] for array in (policy, mdp.allowed, mdp.features, mdp.probability, mdp.next_state)
    )
    discount = xp.asarray(mdp.discount)
    hits_after = (chance * hits[xp.arange(len(states))[:, None, None], successor]).sum(axis=-1)  # [n, A]
    more_hits = hits_after - (own * hits_after).sum(axis=1, keepdims=True)
    action_value = features + discount * xp.einsum("nam,knam->nak", chance, values[:, successor])
    advantage = action_value - (own[..., None] * action_value).sum(axis=1, keepdims=True)
    change = visits[states][:, None, None] * advantage / (1.0 - discount * more_hits)[..., None]
    return xp.abs(xp.where(allowed[..., None], change, 0.0)).max(axis=(1, 2))


def _values(mdp: MDP, policy, rewards):
    """V [B, S] of one policy for rewards [B, S, A]; on the host from one chain, where that gets there."""
    if checks.is_at_hand(mdp, policy, rewards):
        chain = host_model(mdp).chain(policy, may_iterate=True)
        values = chain.value((policy * rewards).sum(axis=-1, dtype=np.float64).T).T
        if np.isfinite(values).all():
            return values
    if not isinstance(rewards, np.ndarray):
        return policy_value(mdp, jnp.broadcast_to(policy, rewards.shape), rewards)
    lanes = len(rewards)
    rewards = np.pad(rewards, [(0, -lanes % _CHUNK), (0, 0), (0, 0)])  # so that few programs serve all numbers
    return np.asarray(policy_value(mdp, np.broadcast_to(policy, rewards.shape), rewards))[:lanes]


def _in_words(queries: Queries) -> str:
    """A line per state."""
    states, scores = np.asarray(queries.states), np.asarray(queries.scores)
    if not states.size:
        return "nothing to ask: the policy comes to no state in which the expert was not seen and has a choice"
    lines = [f"states to ask about, by {queries.criterion}"]
    for i, (state, score) in enumerate(zip(states, scores, strict=True)):
        change = "" if queries.changes is None else f", changes a feature's value by up to {queries.changes[i]:.4g}"
        lines.append(f"  state {described(state, queries.state_names)}: score {score:.4g}{change}")
    return "\n".join(lines)
