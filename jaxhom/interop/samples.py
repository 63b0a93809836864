"""Models from recorded transitions (s, a, s'): counts with a Dirichlet prior, and how far off each row may be.

With n(s, a, z) transitions counted, n of them from the pair in all, a symmetric Dirichlet prior of weight alpha per
successor gives the row (posterior mean)

    p(z) = (n(s, a, z) + alpha) / (n + alpha m)                  z in the row's support, of m successors

What the support is decides what the model looks like:

* `support="observed"`: the successors that were seen from this pair. The model is as sparse as the data. A pair that
  was never visited stays where it is (a self-loop), as a move that leaves a local model does: states without data
  become absorbing, which is right for states that end episodes.
* `support="all"`: all S states. Every row is dense, and a pair that was never visited becomes uniform. With S large
  and little data most of the mass is the prior's: take alpha near 1/S, which gives the prior the weight of one
  transition altogether.

*Uncertainty.* Under the posterior, P(z) ~ Beta(a, b) with a = n(s, a, z) + alpha and a + b the sum of all weights.
Reported are the expected L1 distance E sum_z |P(z) - p(z)|, of which half bounds the expected difference in the
probability of any event, and the root mean square of the Euclidean distance. With X ~ Beta(a, b), mean u, and
I_c the regularised incomplete beta function,

    E|X - c| = 2 (c I_c(a, b) - u I_c(a + 1, b)) + u - c         E(X - c)^2 = u (1 - u) / (a + b + 1) + (u - c)^2

(the moments of the beta distribution: Gelman et al., Bayesian Data Analysis, 3rd ed., appendix A). The observed
support alone would call a row certain that was visited once. So for "observed" the posterior has one more class,
"elsewhere", of weight alpha, which the row gives probability 0; a pair that was never visited is as uncertain as
can be. With alpha = 0 (maximum likelihood) there is no such class, and what was not seen counts as impossible.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom import checks
from jaxhom.interop.matrices import from_scipy
from jaxhom.interop.recorded_steps import RecordedSteps, recorded_steps, with_ends
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

SUPPORTS = ("observed", "all")


class SampledModel(Record):
    """A model estimated from transitions. See `from_samples`.

    Attributes:
      mdp: the model with the posterior mean as its transitions.
      count: int32 [S, A], recorded transitions per pair; 0 where the row is all prior.
      expected_l1_error: float [S, A], posterior expectation of sum_z |P(z) - p(z)|, in [0, 2].
      standard_deviation: float [S, A], root of the posterior expectation of sum_z (P(z) - p(z))^2.
      reward: float [S, A], the mean of the recorded rewards, 0 where there is none; None if none were given.
      terminal: bool [S], the states in which episodes end, which are absorbing; None if no ends were given.
    """

    mdp: MDP
    count: Int[Array, "S A"]
    expected_l1_error: Float[Array, "S A"]
    standard_deviation: Float[Array, "S A"]
    reward: Float[Array, "S A"] | None = None
    terminal: Bool[Array, " S"] | None = None


def from_samples(
    states: Sequence[Any] | Shaped[ArrayLike, "T ..."],
    actions: Sequence[Any] | Shaped[ArrayLike, " T"],
    next_states: Sequence[Any] | Shaped[ArrayLike, "T ..."],
    *,
    num_states: int | None = None,
    num_actions: int | None = None,
    discount: Float[ArrayLike, ""],
    rewards: Float[ArrayLike, " T"] | None = None,
    terminated: Bool[ArrayLike, " T"] | None = None,
    end_state: bool = False,
    prior: float = 0.5,
    support: str = "observed",
    initial: Float[ArrayLike, "S"] | None = None,
    features: Float[ArrayLike, "S *A K"] | None = None,
) -> SampledModel:
    """Estimates a model from transitions, and says how uncertain each of its rows is.

    Args:
      states: [T], the state of each recorded transition: integers in [0, S), or, without `num_states`, observations of
        any kind that is told apart by value: numbers, texts, tuples, arrays, dictionaries.
      actions: [T], the action taken there: integers in [0, A), or, without `num_actions`, of any such kind.
      next_states: [T], the state that followed.
      num_states: S. If None, observations are numbered: as they first appear in `states`, and after these what was only
        ever reached. The model has them as its `state_names`, by which trajectories find them again.
      num_actions: A. If None, one more than the largest; or, of actions that are no whole numbers, as many as there
        are, numbered as they first appear and kept as `action_names`.
      discount: scalar, strictly between 0 and 1.
      rewards: [T], what each transition earned.
      terminated: bool [T], which transitions ended their episode, not those that were cut off. The states that they
        led to become absorbing.
      end_state: True: one absorbing state is added as the last, with features and reward 0, and every terminated
        transition leads there: where an episode can end in a state that others go on from.
      prior: alpha, the Dirichlet prior's weight per successor, in transitions; 0.5 is Jeffreys' prior, 0 (only for
        "observed") maximum likelihood.
      support: "observed" or "all": which successors a row may have (see the module's text).
      initial: [S] distribution of the first state; uniform over those that are not terminal if None.
      features: [S, A, K] or [S, K], without the state that is added; no features (K = 0) if None. Where states are
        numbered here, `model.mdp.replace(initial=..., features=...)` sets both afterwards.

    Returns:
      The model with counts and uncertainties.

    Raises:
      ValueError: on sequences of different lengths or none at all, naming the first entry that is out of range or not
        whole, or a state in which some episodes end and others go on, unless `end_state`; on a negative or infinite
        `prior` or an unknown `support`; and as `MDP.from_successors`.

    Outside jit, vmap and grad only: transitions are counted on the host.

    Source: the beta distribution's moments, Gelman et al., Bayesian Data Analysis, 3rd ed., appendix A.

    Example:
      >>> model = from_samples([0, 0, 0], [0, 0, 0], [1, 1, 0], num_states=2, num_actions=1, discount=0.9, prior=1.0)
      >>> model.mdp.transition[0].tolist(), model.count[:, 0].tolist()  # (2 + 1) / (3 + 2) of the mass goes to state 1
      ([[0.4, 0.6]], [3, 0])
      >>> model = from_samples(["sea", "sea"], [0, 1], ["sea", "gold"], discount=0.9, rewards=[-1.0, 5.0])
      >>> model.mdp.state_names, model.reward.tolist()
      (('sea', 'gold'), [[-1.0, 5.0], [0.0, 0.0]])
    """
    prior = _validated_prior(prior, support)
    steps = recorded_steps(states, actions, next_states, num_states, num_actions)
    if terminated is not None:
        steps = with_ends(steps, terminated, end_state)
    elif end_state:
        raise ValueError("end_state needs terminated, the transitions that ended their episode")
    if end_state:
        initial, features = _with_end("initial", initial, steps), _with_end("features", features, steps)
    if initial is None and steps.terminal is not None and not steps.terminal.all():
        initial = ~steps.terminal / (~steps.terminal).sum()
    return _model(steps, rewards, prior, support, discount=discount, initial=initial, features=features)


def _model(steps: RecordedSteps, rewards, prior: float, support: str, **options: Any) -> SampledModel:
    """The model of checked transitions."""
    num_states, num_actions = steps.num_states, steps.num_actions
    checks.require_slots(num_states, num_actions, num_states if support == "all" else 1)
    pair, successor, seen = _counts(steps)
    count = np.bincount(pair, weights=seen, minlength=num_states * num_actions)
    kinds = np.bincount(pair, minlength=num_states * num_actions)
    is_end = np.zeros(len(count), bool) if steps.terminal is None else np.repeat(steps.terminal, num_actions)
    if support == "all":
        rows = np.full((len(count), num_states), prior)
        rows[pair, successor] += seen
        rows /= (count + prior * num_states)[:, None]
        rows[is_end] = np.eye(num_states)[np.flatnonzero(is_end) // num_actions]
        mdp = MDP.from_dense(rows.reshape(num_states, num_actions, num_states), **options)
    else:
        chance = (seen + prior) / (count + prior * kinds)[pair]
        alone = np.flatnonzero(count == 0)
        entries = np.append(chance, np.ones(len(alone)))
        indices = np.append(pair, alone), np.append(successor, alone // num_actions)
        matrix = scipy.sparse.csr_array((entries, indices), shape=(len(count), num_states))
        mdp = from_scipy(matrix, **options)
    mdp = mdp.replace(state_names=steps.state_names, action_names=steps.action_names)
    l1, square = (np.where(is_end, 0.0, each) for each in _errors(pair, seen, count, kinds, num_states, prior, support))
    shape = (num_states, num_actions)
    return SampledModel(
        mdp=mdp,
        count=checks.to_device(count.reshape(shape), jnp.int32),
        expected_l1_error=checks.to_device(l1.reshape(shape), mdp.dtype),
        standard_deviation=checks.to_device(np.sqrt(square).reshape(shape), mdp.dtype),
        reward=None if rewards is None else _mean_rewards(steps, rewards, count, mdp),
        terminal=None if steps.terminal is None else checks.to_device(steps.terminal),
    )


def _with_end(name: str, given: Any, steps: RecordedSteps) -> np.ndarray | None:
    """What is given by the states, with zeros for the one that was added."""
    if given is None:
        return None
    array, count = checks.as_host_array(name, given), steps.num_states - 1
    checks.require_shape(name, array, f"({count}, ...)", array.ndim >= 1 and len(array) == count)
    return np.pad(array, [(0, 1)] + [(0, 0)] * (array.ndim - 1))


def _mean_rewards(steps: RecordedSteps, rewards: Any, count: np.ndarray, mdp: MDP) -> Float[Array, "S A"]:
    array = checks.as_host_array("rewards", rewards)
    checks.require_shape("rewards", array, f"({len(steps.states)},) like states", array.shape == steps.states.shape)
    array = checks.require_floats_in(mdp.dtype, "rewards", array)
    pair = steps.states * steps.num_actions + steps.actions
    total = np.bincount(pair, weights=array, minlength=len(count))
    return checks.to_device((total / np.maximum(count, 1)).reshape(steps.num_states, -1), mdp.dtype)


def _validated_prior(prior, support: str) -> float:
    if not isinstance(support, str) or support not in SUPPORTS:
        raise ValueError(f"support must be one of {', '.join(SUPPORTS)}, got {checks.in_one_line(support)}")
    prior = checks.require_floats("prior", checks.as_host_array("prior", prior))
    checks.require_shape("prior", prior, "()", prior.ndim == 0)
    if prior < 0 or (prior == 0 and support == "all"):
        raise ValueError(f"prior must be {'positive' if support == 'all' else 'at least 0'}, got {prior}")
    return float(prior)


def _counts(steps: RecordedSteps):
    """Distinct transitions: flat pair s * A + a, successor, and how often each was recorded."""
    pair, successor = steps.states * steps.num_actions + steps.actions, steps.next_states
    order = np.lexsort((successor, pair))
    pair, successor = pair[order], successor[order]
    first = np.flatnonzero(np.append(True, (np.diff(pair) != 0) | (np.diff(successor) != 0)))
    return pair[first], successor[first], np.diff(np.append(first, len(pair)))


def _errors(pair, seen, count, kinds, num_states: int, prior: float, support: str):
    """Expected L1 and squared Euclidean distance of each row to the posterior's draws, [S A] each."""
    unseen = num_states - kinds if support == "all" else np.minimum(num_states - kinds, 1)
    weight = count + prior * (kinds + unseen)
    mean = (seen + prior) / (count + prior * (kinds + (unseen if support == "all" else 0)))[pair]
    l1, square = _beta_errors(seen + prior, weight[pair], mean)
    l1 = np.bincount(pair, weights=l1, minlength=len(count))
    square = np.bincount(pair, weights=square, minlength=len(count))
    if prior > 0:
        given = prior / weight if support == "all" else np.zeros(len(count))
        of_each = _beta_errors(np.full(len(count), prior), weight, given)
        l1, square = l1 + unseen * of_each[0], square + unseen * of_each[1]
    if num_states == 1:
        return np.zeros((2, len(count)))
    if support == "observed":  # nothing is known of such a row: as far off as two distributions can be
        l1, square = np.where(count == 0, 2.0, l1), np.where(count == 0, 2.0, square)
    return np.clip(l1, 0.0, 2.0), square  # but for rounding it lies there


def _beta_errors(weight, total, centre):
    """E|X - c| and E(X - c)^2 for X ~ Beta(weight, total - weight); X = 1 where nothing is left beside it."""
    rest = total - weight
    sure = rest <= 0
    safe = np.where(sure, 1.0, rest)
    mean = np.where(sure, 1.0, weight / total)
    below = scipy.special.betainc(weight, safe, centre)
    first_moment = mean * scipy.special.betainc(weight + 1.0, safe, centre)
    l1 = 2.0 * (centre * below - first_moment) + mean - centre
    square = mean * (1.0 - mean) / (total + 1.0) + (mean - centre) ** 2
    return np.where(sure, np.abs(1.0 - centre), l1), square
