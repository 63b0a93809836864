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

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom import checks
from jaxhom.interop.matrices import from_scipy
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float, Int

SUPPORTS = ("observed", "all")


class SampledModel(Record):
    """A model estimated from transitions. See `from_samples`.

    Attributes:
      mdp: the model with the posterior mean as its transitions.
      count: int32 [S, A], recorded transitions per pair; 0 where the row is all prior.
      expected_l1_error: float [S, A], posterior expectation of sum_z |P(z) - p(z)|, in [0, 2].
      standard_deviation: float [S, A], root of the posterior expectation of sum_z (P(z) - p(z))^2.
    """

    mdp: MDP
    count: Int[Array, "S A"]
    expected_l1_error: Float[Array, "S A"]
    standard_deviation: Float[Array, "S A"]


def from_samples(
    states: Int[ArrayLike, "T"],
    actions: Int[ArrayLike, "T"],
    next_states: Int[ArrayLike, "T"],
    *,
    num_states: int,
    num_actions: int,
    discount: Float[ArrayLike, ""],
    prior: float = 0.5,
    support: str = "observed",
    initial: Float[ArrayLike, "S"] | None = None,
    features: Float[ArrayLike, "S *A K"] | None = None,
) -> SampledModel:
    """Estimates a model from transitions, and says how uncertain each of its rows is.

    Args:
      states: integers [T] in [0, S), the state of each recorded transition.
      actions: integers [T] in [0, A), the action taken there.
      next_states: integers [T] in [0, S), the state that followed.
      num_states: S.
      num_actions: A.
      discount: scalar, strictly between 0 and 1.
      prior: alpha, the Dirichlet prior's weight per successor, in transitions; 0.5 is Jeffreys' prior, 0 (only for
        "observed") maximum likelihood.
      support: "observed" or "all": which successors a row may have (see the module's text).
      initial: [S] distribution of the first state; uniform if None.
      features: [S, A, K] or [S, K]; no features (K = 0) if None.

    Returns:
      The model with counts and uncertainties.

    Raises:
      ValueError: on sequences of different lengths or none at all, naming the first entry that is out of range or not
        whole, on a negative or infinite `prior` or an unknown `support`; and as `MDP.from_successors`.

    Outside jit, vmap and grad only: transitions are counted on the host.

    Source: the beta distribution's moments, Gelman et al., Bayesian Data Analysis, 3rd ed., appendix A.

    Example:
      >>> model = from_samples([0, 0, 0], [0, 0, 0], [1, 1, 0], num_states=2, num_actions=1, discount=0.9, prior=1.0)
      >>> model.mdp.transition[0].tolist(), model.count[:, 0].tolist()  # (2 + 1) / (3 + 2) of the mass goes to state 1
      ([[0.4, 0.6]], [3, 0])
    """
    num_states = checks.require_count("num_states", num_states)
    num_actions = checks.require_count("num_actions", num_actions)
    prior = _validated_prior(prior, support)
    checks.require_slots(num_states, num_actions, num_states if support == "all" else 1)
    pair, successor, seen = _counts(states, actions, next_states, num_states, num_actions)
    count = np.bincount(pair, weights=seen, minlength=num_states * num_actions)
    kinds = np.bincount(pair, minlength=num_states * num_actions)
    if support == "all":
        rows = np.full((len(count), num_states), prior)
        rows[pair, successor] += seen
        rows /= (count + prior * num_states)[:, None]
        mdp = MDP.from_dense(
            rows.reshape(num_states, num_actions, num_states), discount=discount, initial=initial, features=features
        )
    else:
        chance = (seen + prior) / (count + prior * kinds)[pair]
        alone = np.flatnonzero(count == 0)
        entries = np.append(chance, np.ones(len(alone)))
        indices = np.append(pair, alone), np.append(successor, alone // num_actions)
        matrix = scipy.sparse.csr_array((entries, indices), shape=(len(count), num_states))
        mdp = from_scipy(matrix, discount=discount, initial=initial, features=features)
    l1, square = _errors(pair, seen, count, kinds, num_states, prior, support)
    shape = (num_states, num_actions)
    return SampledModel(
        mdp=mdp,
        count=checks.to_device(count.reshape(shape), jnp.int32),
        expected_l1_error=checks.to_device(l1.reshape(shape), mdp.dtype),
        standard_deviation=checks.to_device(np.sqrt(square).reshape(shape), mdp.dtype),
    )


def _validated_prior(prior, support: str) -> float:
    if not isinstance(support, str) or support not in SUPPORTS:
        raise ValueError(f"support must be one of {', '.join(SUPPORTS)}, got {checks.in_one_line(support)}")
    prior = checks.require_floats("prior", checks.as_host_array("prior", prior))
    checks.require_shape("prior", prior, "()", prior.ndim == 0)
    if prior < 0 or (prior == 0 and support == "all"):
        raise ValueError(f"prior must be {'positive' if support == 'all' else 'at least 0'}, got {prior}")
    return float(prior)


def _counts(states, actions, next_states, num_states: int, num_actions: int):
    """Distinct transitions: flat pair s * A + a, successor, and how often each was recorded."""
    columns = []
    for name, values, upper in (
        ("states", states, num_states),
        ("actions", actions, num_actions),
        ("next_states", next_states, num_states),
    ):
        array = checks.as_host_array(name, values)
        checks.require_shape(name, array, "[T] with T >= 1", array.ndim == 1 and array.size > 0)
        columns.append(checks.require_integers(name, array, upper))
        same = len(columns[-1]) == len(columns[0])
        checks.require_shape(name, array, f"({len(columns[0])},) like states", same)
    pair = columns[0] * num_actions + columns[1]
    order = np.lexsort((columns[2], pair))
    pair, successor = pair[order], columns[2][order]
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
