"""How good a policy is: reward per step, steps to a goal, events, agreement with the expert.

The measures of Boularias and Chaib-draa (2010), section VI: a policy is tried out in trials of at
most H steps from the initial distribution, nothing is discounted, and what is reported is an
average *per step*,

    reward_per_step = E[total reward of a trial] / E[steps of a trial],

a ratio of expectations: the sum over all trials by the sum of their lengths. A trial that enters a
terminal state ends there: the step that enters counts.

`evaluate_exactly` pushes the distribution of the state forward for H steps, d_{t+1} = d_t P_pi, and
sums it up. Every measure is then linear in the visits sum_t d_t(s) pi(s, a), so one scan serves all
of them. `evaluate_by_sampling` runs trials, as the paper does, and reports standard errors.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.demonstrations import sample_demonstrations
from jaxhom.models.inputs import as_model, check_policy, check_reward, require_policy_shape
from jaxhom.models.mdp import MDP, push_forward
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key

    Policy = Float[ArrayLike, "*B S A"] | Int[ArrayLike, " S"]


class Evaluation(Record):
    """What a policy achieves; with a batch of B policies every number gains a leading axis [B].

    Attributes:
      reward_per_step: scalar, `total_reward` by `steps`, in units of reward; NaN if no step is
        taken (every trial starts in a terminal state).
      total_reward: scalar, expected undiscounted reward of a trial.
      steps: scalar, expected steps of a trial, at most the horizon.
      finished: scalar in [0, 1], share of trials that are in a terminal state within the horizon.
      events: per name, a scalar: the event's expected number per trial, by `steps`.
      standard_error: the same measures' standard errors, or None where the evaluation is exact.
    """

    reward_per_step: Float[Array, "*B"]
    total_reward: Float[Array, "*B"]
    steps: Float[Array, "*B"]
    finished: Float[Array, "*B"]
    events: dict[str, Float[Array, "*B"]]
    standard_error: Evaluation | None = None


def evaluate_exactly(
    mdp: MDP,
    policy: Policy,
    reward: Float[ArrayLike, "*B S A"],
    horizon: int,
    *,
    terminal: Bool[ArrayLike, " S"] | None = None,
    events: Mapping[str, Float[ArrayLike, "S A"]] | None = None,
    count_terminal_step: bool = False,
) -> Evaluation:
    """Computes what a policy achieves in trials of at most `horizon` steps, without sampling.

    Works under `jit`, `vmap` and `grad`, with `horizon` and `count_terminal_step` static.

    Args:
      mdp: the model; trials start from its initial distribution. Its discount plays no part.
      policy: [S, A] or [B, S, A], rows sum to 1.
      reward: [S, A], or [B, S, A] beside a batch of policies.
      horizon: H, the largest number of steps of a trial, at least 1.
      terminal: bool [S], states in which a trial ends; none if None.
      events: named arrays [S, A], the probability (or expected number) of an event in a step, the
        racetrack's `off_road` for one.
      count_terminal_step: whether the step that a trial would take next, from the terminal state
        that it has entered, still counts: one more step if it falls within the horizon, with what
        `reward` and `events` hold in that state. On a racetrack it is the step that puts the car
        back to the start and earns nothing.

    Returns:
      An `Evaluation` without standard errors, exact up to rounding.

    Raises:
      ValueError: if a shape does not fit, `terminal` is not bool, a reward, an event or a policy is not finite, or
        `horizon` is below 1.

    Source: the measures of Boularias and Chaib-draa 2010, section VI.

    Example:
      >>> from jaxhom.domains.gridworld import gridworld
      >>> from jaxhom.planning.optimal import optimal_policy
      >>> mdp = gridworld(4, noise=0.0).mdp
      >>> reward = jnp.zeros((16, 4)).at[:, 1].set(1.0)  # for the wish to go down
      >>> float(evaluate_exactly(mdp, optimal_policy(mdp, reward).policy, reward, 10).total_reward)
      10.0
    """
    mdp = as_model(mdp)
    policy, reward, terminal, events = _validated(mdp, policy, reward, terminal, events)
    return _evaluate_visits(
        mdp,
        _batch_last(policy),
        _batch_last(reward),
        terminal,
        events,
        horizon=checks.require_count("horizon", horizon),
        count_terminal_step=checks.require_switch("count_terminal_step", count_terminal_step),
    )


def evaluate_by_sampling(
    key: Key[Array, ""],
    mdp: MDP,
    policy: Policy,
    reward: Float[ArrayLike, "*B S A"],
    horizon: int,
    *,
    num_trials: int = 1000,
    terminal: Bool[ArrayLike, " S"] | None = None,
    events: Mapping[str, Float[ArrayLike, "S A"]] | None = None,
    count_terminal_step: bool = False,
) -> Evaluation:
    """Estimates what a policy achieves from independent trials of at most `horizon` steps.

    Works under `jit` and `vmap`, with the counts static. Under `grad` the trials are constants: only the derivative in
    `reward` and `events` is that of the expectation.

    What a trial adds up are expectations given its states and actions: `reward` and `events` are
    [S, A], so that the luck of a step's outcome is in where the trial goes on and nowhere else.

    All policies of a batch meet the same random numbers: lane b is what `policy[b]` alone would
    get. Differences between policies then mostly vary less than independent trials would let them;
    the lanes' errors are not independent, and do not average out over a batch as if they were.

    Args:
      key: a `jax.random` key; the same key gives the same trials.
      mdp: the model; trials start from its initial distribution. Its discount plays no part.
      policy: [S, A] or [B, S, A], rows sum to 1.
      reward: [S, A], or [B, S, A] beside a batch of policies.
      horizon: H, the largest number of steps of a trial, at least 1.
      num_trials: M, at least 2; the paper takes 1000.
      terminal: bool [S], states in which a trial ends; none if None.
      events: named arrays [S, A], as in `evaluate_exactly`.
      count_terminal_step: as in `evaluate_exactly`.

    Returns:
      An `Evaluation` whose `standard_error` holds those of its means over trials. Those of the
      ratios R / N (per step) are by the delta method: the standard error of the mean of
      R_m - (R / N) N_m, divided by the mean of N_m. Where all trials agree they are 0.

    Raises:
      ValueError: as `evaluate_exactly`, and if `num_trials` is below 2.

    Example:
      >>> from jaxhom.domains.gridworld import gridworld
      >>> mdp = gridworld(4, noise=0.0).mdp
      >>> at_goal = jnp.arange(16) == 15
      >>> to_goal = jnp.where(jnp.arange(16) < 12, 1, 3)  # down, then right
      >>> found = evaluate_by_sampling(jax.random.key(0), mdp, to_goal, jnp.ones((16, 4)), 10, terminal=at_goal)
      >>> float(found.steps), float(found.finished), float(found.standard_error.steps)
      (6.0, 1.0, 0.0)

    Source: Boularias and Chaib-draa 2010, section VI; they report no errors.
    """
    mdp = as_model(mdp)
    policy, reward, terminal, events = _validated(mdp, policy, reward, terminal, events)
    horizon = checks.require_count("horizon", horizon)
    num_trials = checks.require_count("num_trials", num_trials, least=2)
    count_terminal_step = checks.require_switch("count_terminal_step", count_terminal_step)

    def evaluate(policy, reward):
        # One state more than steps: the last step of a trial may be the one that finishes it.
        trials = sample_demonstrations(key, mdp, policy, num_trials, horizon + 1)
        return _evaluate_trials(trials, reward, terminal, events, count_terminal_step=count_terminal_step)

    if policy.ndim == 3:
        evaluate = jax.vmap(evaluate, in_axes=(0, 0 if reward.ndim == 3 else None))
    return evaluate(policy, reward)


def agreement(
    mdp: MDP, policy: Policy, expert_policy: Policy, weights: Float[ArrayLike, "*B S"] | None = None
) -> Float[Array, "*B"]:
    """Probability that a policy takes the expert's action, averaged over states.

    Works under `jit`, `vmap` and `grad`.

    In state s it is sum_a min(pi(s, a), pi_E(s, a)), one minus the total variation distance of the
    two rows: the largest probability with which draws from the two can be made to coincide. Between
    deterministic policies it is the share of states with the same action.

    Args:
      mdp: the model.
      policy: [S, A] or [B, S, A], rows sum to 1.
      expert_policy: [S, A] or [B, S, A].
      weights: [S] or [B, S], not negative, of any positive sum: how much a state counts. Take
        `occupancy(mdp, expert_policy).sum(-1)` for the states that the expert meets. All states
        count alike if None.

    Returns:
      Scalar in [0, 1], or [B] if any argument is a batch.

    Raises:
      ValueError: if a shape does not fit, or a weight is negative or not finite.

    Example:
      >>> from jaxhom import MDP
      >>> mdp = MDP.from_dense([[[1.0, 0.0], [0.0, 1.0]]] * 2, discount=0.9)
      >>> float(agreement(mdp, [[0.75, 0.25], [0.0, 1.0]], [0, 0]))
      0.375
    """
    mdp = as_model(mdp)
    policy = require_policy_shape(mdp, policy)
    expert_policy = require_policy_shape(mdp, expert_policy, "expert_policy")
    weights = jnp.ones(mdp.num_states, mdp.dtype) if weights is None else checks.to_device(weights)
    good = weights.ndim in (1, 2) and weights.shape[-1] == mdp.num_states
    checks.require_shape("weights", weights, f"({mdp.num_states},) or (B, {mdp.num_states})", good)
    if not checks.is_traced(weights):
        host = checks.require_floats("weights", np.asarray(weights))
        checks.require_all("weights", host, host >= 0, "must not be negative")
        checks.require_all("sum of weights", host.sum(axis=-1), host.sum(axis=-1) > 0, "must be positive")
    batches = {len(a) for a, n in ((policy, 3), (expert_policy, 3), (weights, 2)) if a.ndim == n}
    if len(batches) > 1:
        raise ValueError(f"batches must be of one size, got {sorted(batches)}")
    policy, expert_policy = check_policy(mdp, policy), check_policy(mdp, expert_policy, "expert_policy")
    shared = jnp.minimum(policy, expert_policy).sum(axis=-1)
    return (weights * shared).sum(axis=-1) / weights.sum(axis=-1)


@functools.partial(jax.jit, static_argnames=("horizon", "count_terminal_step"))
def _evaluate_visits(mdp, policy, reward, terminal, events, *, horizon, count_terminal_step) -> Evaluation:
    """`evaluate_exactly` with the batch, if any, last: policy and reward [S, A] or [S, A, B]."""
    spread = (...,) + (None,) * (policy.ndim - 2)
    ends = terminal.astype(mdp.dtype)[spread]
    goes_on = 1.0 - ends

    def step(state, _):
        distribution, visits = state
        moving = (distribution * goes_on)[:, None] * policy
        return (push_forward(mdp, moving), visits + distribution), None

    initial = jnp.broadcast_to(mdp.initial[spread], policy.shape[:1] + policy.shape[2:])
    start = (initial, jnp.zeros_like(initial))
    (last, visits), _ = jax.lax.scan(step, start, length=horizon)
    # Terminal mass is not pushed on, so that `visits` holds it once, on the step after its arrival.
    finished = jnp.minimum(((visits + last) * ends).sum(axis=0), 1.0)
    counted = visits if count_terminal_step else visits * goes_on
    pairs, steps = counted[:, None] * policy, counted.sum(axis=0)

    def total(per_pair):
        per_pair = per_pair if per_pair.ndim == pairs.ndim else per_pair[spread]
        return (pairs * per_pair).sum(axis=(0, 1))

    return Evaluation(
        reward_per_step=total(reward) / steps,
        total_reward=total(reward),
        steps=steps,
        finished=finished,
        events={name: total(event) / steps for name, event in events.items()},
    )


@functools.partial(jax.jit, static_argnames="count_terminal_step")
def _evaluate_trials(trials, reward, terminal, events, *, count_terminal_step) -> Evaluation:
    """Means and standard errors of trials [M, H + 1] of one policy."""
    horizon, dtype = trials.horizon - 1, reward.dtype
    is_terminal = terminal[trials.states]
    finished = is_terminal.any(axis=1)
    arrival = jnp.where(finished, is_terminal.argmax(axis=1), horizon)  # steps that lead there
    taken = jnp.arange(horizon) < (arrival + count_terminal_step)[:, None]  # [M, H]
    pairs = trials.states[:, :horizon], trials.actions[:, :horizon]

    def totals(per_pair):
        return jnp.where(taken, per_pair[pairs], 0.0).sum(axis=1)

    steps, rewards = taken.sum(axis=1, dtype=dtype), totals(reward)
    both = Evaluation(  # every measure beside its standard error, [2]
        reward_per_step=_ratio(rewards, steps),
        total_reward=_mean(rewards),
        steps=_mean(steps),
        finished=_mean(finished.astype(dtype)),
        events={name: _ratio(totals(event), steps) for name, event in events.items()},
    )
    mean, error = (jax.tree.map(operator.itemgetter(i), both) for i in range(2))
    return mean.replace(standard_error=error)


def _mean(samples: Float[Array, " M"]) -> Float[Array, " 2"]:
    """Mean over trials and its standard error."""
    return jnp.stack([samples.mean(), samples.std(ddof=1) / jnp.sqrt(len(samples))])


def _ratio(numerator: Float[Array, " M"], denominator: Float[Array, " M"]) -> Float[Array, " 2"]:
    """Ratio of the means of two samples and its standard error by the delta method."""
    ratio = numerator.mean() / denominator.mean()
    _, error = _mean(numerator - ratio * denominator)
    return jnp.stack([ratio, error / denominator.mean()])


def _batch_last(array: Float[Array, "*B S A"]) -> Float[Array, "S A *B"]:
    """[S, A] as it is, [B, S, A] -> [S, A, B]."""
    return jnp.moveaxis(array, 0, -1) if array.ndim == 3 else array


def _validated(mdp: MDP, policy, reward, terminal, events):
    """Returns policy, reward, terminal [S] and events in the model's dtype, or raises."""
    policy = require_policy_shape(mdp, policy)
    reward = checks.to_device(check_reward(mdp, reward, policy.shape))
    pair = (mdp.num_states, mdp.num_actions)
    terminal = jnp.zeros(pair[:1], bool) if terminal is None else checks.to_device(terminal)
    checks.require_flags("terminal", terminal, mdp.num_states)
    checked = {}
    for name, event in (events or {}).items():
        described = f"events[{name!r}]"
        if not checks.is_traced(event):
            event = checks.require_floats(described, checks.as_host_array(described, event))
        checks.require_shape(described, event, str(pair), event.shape == pair)
        checked[name] = checks.to_device(event, mdp.dtype)
    return check_policy(mdp, policy), reward, terminal, checked
