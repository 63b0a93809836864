"""Demonstrations: padded trajectories, what the expert did where, Monte Carlo expectations, sampling.

Trajectories of unequal length are padded to the longest and masked: `states`, `actions` and `mask` are [M, H]. They
also carry how they ended: an episode that *terminated* is absorbed for good, one that was cut off (truncated) would
have gone on.

What the expert answered when asked about a single state is a trajectory of one step that is marked as an *answer*. It
says what is done there as any step does, and nothing of how often or how early the expert comes there.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models import episode_ends, impossible_steps
from jaxhom.models.inputs import as_model, check_policy
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.models.names import described
from jaxhom.models.sampling import sample_walks
from jaxhom.models.trajectories import padded, with_single_steps
from jaxhom.programs import quick_jit
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key


class Demonstrations(Record):
    """M trajectories of at most H steps. Build it with `Demonstrations.from_trajectories`.

    `len` is M, answers included. `demonstrations[i]` is trajectory i as a pair of NumPy arrays, as `from_trajectories`
    takes it; a slice or an array selects some of them, as `Demonstrations`: `demonstrations[demonstrations.is_answer]`.

    Attributes:
      states: int32 [M, H], the state of each step; 0 on padding.
      actions: int32 [M, H], the action taken there; 0 on padding.
      mask: bool [M, H], True on the steps that happened, a prefix of every row. Taking steps out of it, such as those
        of a car that is put back to the start, hides them from the learner and leaves the times of the others. Where
        the last steps are taken out, so must be the final state.
      terminated: bool [M], whether the episode ended by itself; False for all if not given. Where it is False the
        episode was cut off, or nobody knows.
      final_states: int32 [M], the state after the last step, in which no action was taken; -1 where it is not known,
        for all if not given.
      is_answer: bool [M], the trajectories of one step that are answers (`with_answers`): they count where the expert's
        actions do, and not where time does; False for all if not given.
    """

    states: Int[Array, "M H"]
    actions: Int[Array, "M H"]
    mask: Bool[Array, "M H"]
    terminated: Bool[Array, " M"] | None = None
    final_states: Int[Array, " M"] | None = None
    is_answer: Bool[Array, " M"] | None = None

    def __post_init__(self) -> None:
        # Trees of axes or types are built through here too: what stands for the mask stands for these fields as well.
        is_array = hasattr(self.mask, "shape") and len(self.mask.shape) > 0
        defaults = {"terminated": (False, bool), "final_states": (-1, jnp.int32), "is_answer": (False, bool)}
        for name, (value, dtype) in defaults.items():
            if getattr(self, name) is None:
                filled = checks.to_device(np.full(self.mask.shape[:-1], value, dtype)) if is_array else self.mask
                object.__setattr__(self, name, filled)

    @classmethod
    def from_trajectories(
        cls, trajectories: Iterable[Any], terminated: Bool[ArrayLike, " M"] | None = None
    ) -> Demonstrations:
        """Builds demonstrations from a sequence of (states, actions) pairs of integer sequences.

        On the host: not under `jit`, `vmap` or `grad`; what comes out passes through all three.

        Args:
          trajectories: M pairs of non-empty sequences with as many states as actions, or one more: the last is then the
            state in which the episode ended, where no action was taken. Lengths may differ between pairs.
            Demonstrations are taken as they are, hidden steps and all.
          terminated: bool [M], which episodes ended by themselves; the others were cut off. False for all if None, or
            what demonstrations say themselves.

        Raises:
          ValueError: if there is no trajectory, one is empty or not a pair, its lengths do not fit, an entry is
            negative or not whole (the trajectory and the step are named), `terminated` is not bool [M], or all
            of them padded to the longest are too many steps for 32-bit indices.

        Example:
          >>> demonstrations = Demonstrations.from_trajectories([([0, 1, 2], [1, 1]), ([0, 3], [0])])
          >>> demonstrations.states.tolist(), demonstrations.final_states.tolist()
          ([[0, 1], [0, 0]], [2, 3])
        """
        if not isinstance(trajectories, cls):
            arrays = padded(trajectories, terminated)
            return cls(**{name: checks.to_device(array) for name, array in arrays.items()})
        if terminated is None:
            return trajectories
        terminated = checks.as_host_array("terminated", terminated)
        terminated = checks.require_flags("terminated", terminated, len(trajectories))
        return trajectories.replace(terminated=checks.to_device(terminated))

    @checks.eager_where_concrete
    def with_answers(self, states: Int[ArrayLike, " N"], actions: Int[ArrayLike, " N"]) -> Demonstrations:
        """The demonstrations, and what the expert said to do in single states.

        Works under `jit` and `vmap`, with states and actions traced. There a state below 0 is no answer, and its step
        is masked: `query_states` gives -1 where nothing is left to ask.

        An answer is a trajectory of one step that is marked by `is_answer`. `empirical_policy`, and with it all that
        generalizes, counts it beside the steps that are there. The Monte Carlo mean leaves it out, because its time is
        not known, and so does the choice of a generalization as one to leave out, because the states asked about are
        no sample of those that the expert visits.

        Args:
          states: [N], the states that were asked about; one may occur several times.
          actions: [N], the answers.

        Returns:
          Demonstrations [M + N, H].

        Raises:
          ValueError: if they are not [N] both; where they are concrete, if one is negative or not whole. Whether they
            exist in a model `validate` says, which whatever takes demonstrations calls.

        Example:
          >>> shown = Demonstrations.from_trajectories([([0, 1, 2], [1, 1, 0])]).with_answers([4], [1])
          >>> len(shown), shown.is_answer.tolist(), shown[1]
          (2, [False, True], (array([4], dtype=int32), array([1], dtype=int32)))
        """
        return self.replace(**with_single_steps(self, states, actions))

    @property
    def num_trajectories(self) -> int:
        """M, answers included."""
        return self.states.shape[-2]

    @property
    def horizon(self) -> int:
        """H, the length of the longest trajectory (padding included)."""
        return self.states.shape[-1]

    def __len__(self) -> int:
        return self.num_trajectories

    def __getitem__(self, index: Any) -> Any:
        try:
            index = operator.index(index)
        except TypeError:
            if isinstance(index, str):
                raise TypeError(f"trajectories have numbers, got the index {index!r}") from None
            if isinstance(index, list):
                index = checks.require_integers("index", np.asarray(index, None if index else int))
            return jax.tree.map(operator.itemgetter(index), self)
        mask, final = np.asarray(self.mask)[index], np.asarray(self.final_states)[index]
        states, actions = (np.asarray(array)[index][mask] for array in (self.states, self.actions))
        return (np.append(states, final) if final >= 0 else states), actions

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        return (self[i] for i in range(len(self)))

    def validate(self, mdp: MDP, impossible: str = "refuse") -> None:
        """Raises unless the demonstrations can have happened in a model; does nothing on traced arrays.

        Functions that take demonstrations call it with "warn". To have nothing of it there, filter
        `ImpossibleStepsWarning` with the `warnings` module; to refuse, call this first.

        Args:
          mdp: the model.
          impossible: what to do about steps of probability 0: "refuse", "warn" (an `ImpossibleStepsWarning`) or
            "ignore". A step is s_t, a_t and the state that follows, if that is known: the mask shows the next step too,
            or it is the final state.

        Raises:
          ValueError: naming trajectory and step, if a state or action does not exist in the model or an action is not
            allowed in its state; if the fields' shapes do not fit; if steps are impossible, saying how many of how
            many, and the first.
        """
        mdp = as_model(mdp)
        if impossible not in impossible_steps.OPTIONS:
            raise ValueError(f'impossible must be "refuse", "warn" or "ignore", got {checks.in_one_line(impossible)}')
        if checks.is_traced(self):
            return
        self._require_shapes()
        self._require_pairs(mdp)
        if not checks.is_traced(mdp.next_state, mdp.probability):
            impossible_steps.report_impossible(mdp, self, impossible)

    def _require_shapes(self) -> None:
        shape = self.states.shape
        checks.require_shape("states", self.states, "[..., H] with H >= 1", self.states.ndim > 0 and shape[-1] > 0)
        same = self.actions.shape == shape and self.mask.shape == shape
        checks.require_shape("states, actions and mask", self.actions, f"{shape} alike", same)
        for name in ("terminated", "final_states", "is_answer"):
            array = getattr(self, name)
            checks.require_shape(name, array, str(shape[:-1]), array.shape == shape[:-1])

    def _require_pairs(self, mdp: MDP) -> None:
        """Raises unless the model has every state and action, and allows the actions in their states."""
        mask, states, actions = (np.asarray(array) for array in (self.mask, self.states, self.actions))
        for name, array, limit in (("states", states, mdp.num_states), ("actions", actions, mdp.num_actions)):
            inside = (array >= 0) & (array < limit)
            message = f"must lie in [0, {limit}) (index: trajectory, step)"
            checks.require_all(name, array, inside | ~mask, message)
        final = np.asarray(self.final_states)
        message = f"must lie in [0, {mdp.num_states}), or be -1 where it is not known (index: trajectory)"
        checks.require_all("final_states", final, (final >= -1) & (final < mdp.num_states), message)
        if mdp.restricts_actions and not checks.is_traced(mdp.allowed):
            exists = np.asarray(mdp.allowed)[np.where(mask, states, 0), np.where(mask, actions, 0)] | ~mask
            if not exists.all():
                first = tuple(np.argwhere(~exists)[0])
                message = "is not allowed in its state (index: trajectory, step)"
                state = described(states[first], mdp.state_names)
                action = described(actions[first], mdp.action_names)
                checks.require_all("actions", actions, exists, message, f": action {action} in state {state}")


def require_demonstrations(demonstrations: Any) -> Demonstrations:
    """Returns the demonstrations; raises if they are something else, such as a list of trajectories."""
    if not isinstance(demonstrations, Demonstrations):
        kind = type(demonstrations).__name__
        raise ValueError(f"demonstrations must be Demonstrations, got {kind}: see Demonstrations.from_trajectories")
    return demonstrations


def empirical_policy(mdp: MDP, demonstrations: Demonstrations) -> tuple[Bool[Array, " S"], Float[Array, "S A"]]:
    """Frequencies of the expert's actions in the states that were demonstrated.

    Works under `jit` and `vmap`; counts have no derivative.

    Absorbing states are no exception: if steps were recorded in one, it counts as visited, and its row says what was
    done there. That is no decision, though, and the methods that carry the expert's policy over to other states leave
    these states out.

    Args:
      mdp: the model.
      demonstrations: M trajectories.

    Returns:
      visited: bool [S], the states S^E that occur in the demonstrations. A final state, in which nothing was done, does
        not count.
      policy: [S, A], empirical action frequencies on visited states, uniform over the allowed actions elsewhere; rows
        sum to 1.

    Raises:
      ValueError: if a state or action is out of range, or an action not allowed.

    Warns:
      ImpossibleStepsWarning: if steps have probability 0; see `Demonstrations.validate`.

    Example:
      >>> ring = MDP.from_successors([[[1], [0]], [[0], [1]]], [[[1.0]] * 2] * 2, discount=0.9)
      >>> visited, policy = empirical_policy(ring, Demonstrations.from_trajectories([([0, 0, 0], [1, 1, 0])]))
      >>> visited.tolist(), policy.round(2).tolist()
      ([True, False], [[0.33, 0.67], [0.5, 0.5]])

    Source: Boularias and Chaib-draa 2010, section V.
    """
    mdp = as_model(mdp)
    require_demonstrations(demonstrations).validate(mdp, "warn")
    counts = action_counts(mdp, demonstrations)
    xp = checks.arrays_of(mdp, counts)
    visits = counts.sum(axis=-1, keepdims=True)
    visited = visits[:, 0] > 0
    frequencies = (counts / xp.maximum(visits, 1.0)).astype(mdp.dtype)
    return tuple(map(checks.to_device, (visited, xp.where(visited[:, None], frequencies, uniform_policy(mdp)))))


def action_counts(mdp: MDP, demonstrations: Demonstrations) -> Float[Array, "S A"] | Int[np.ndarray, "S A"]:
    """How often each action was taken in each state; in NumPy at hand, also under `jit` and `vmap`."""
    shape = (mdp.num_states, mdp.num_actions)
    states, actions, mask = demonstrations.states, demonstrations.actions, demonstrations.mask
    # Counted in integers and divided in JAX's default type: float32 would stop counting at 2^24, float16 at 2^11.
    if checks.is_at_hand(mdp, states, actions, mask):
        mask = np.asarray(mask)
        pairs = np.ravel_multi_index((np.asarray(states)[mask], np.asarray(actions)[mask]), shape)
        return np.bincount(pairs, minlength=shape[0] * shape[1]).reshape(shape)
    return jnp.zeros(shape, jnp.int32).at[states, actions].add(mask.astype(jnp.int32)).astype(float)


@checks.eager_where_concrete
def monte_carlo_feature_expectations(mdp: MDP, demonstrations: Demonstrations) -> Float[Array, " K"]:
    """Feature expectations as the demonstrations' mean, 1/M sum_m sum_t gamma^t phi(s_t, a_t), t from 0.

    Works under `jit`, `vmap` and `grad`, in features and discount. Answers (`Demonstrations.with_answers`), which say
    nothing of time, are no part of the mean.

    Where an episode terminated, the sum goes on to infinity: gamma^T phi(z) / (1 - gamma) is added, T the number of its
    steps, z the absorbing state that it ended in, phi(z) the mean over the actions allowed there. Where the final state
    is not known, z may be any absorbing successor of the last step, weighted by its probability. The same holds for an
    episode that was cut off, or walked on, in an absorbing state whose features do not depend on the action. All others
    are sums over their own steps: of a finite horizon.

    Args:
      mdp: the model, with K features.
      demonstrations: M trajectories.

    Returns:
      [K], in the units of `feature_expectations`.

    Raises:
      ValueError: if a state or action is out of range, an action not allowed, all trajectories are answers, or one
        terminated where the model does not absorb. Under a trace such a trajectory is not continued.

    Warns:
      ImpossibleStepsWarning: if steps have probability 0; see `Demonstrations.validate`.

    Example:
      >>> ring = MDP.from_successors([[[1]], [[0]]], [[[1.0]]] * 2, discount=0.5, features=[[1.0], [4.0]])
      >>> monte_carlo_feature_expectations(ring, Demonstrations.from_trajectories([([0, 1, 0], [0, 0, 0])])).tolist()
      [3.25]

    Source: Boularias and Chaib-draa 2010, eq. (6), with the first step counted as gamma^0.
    """
    mdp = as_model(mdp)
    require_demonstrations(demonstrations).validate(mdp, "warn")
    if not checks.is_traced(demonstrations.is_answer) and np.asarray(demonstrations.is_answer).all():
        raise ValueError("there are no trajectories but answers about single states, which say nothing of time")
    is_little = checks.is_at_hand(mdp, demonstrations)  # the sums take less time than any program compiles
    expectations, is_lost = (_expected_at_hand if is_little else _expectations)(mdp, demonstrations)
    if not checks.is_traced(is_lost):
        episode_ends.refuse_lost(demonstrations, np.asarray(is_lost))
    return expectations


def _expected(mdp: MDP, demonstrations: Demonstrations) -> tuple[Float[Array, " K"], Bool[Array, " M"]]:
    walks = ~demonstrations.is_answer
    demonstrations = demonstrations.replace(
        mask=demonstrations.mask & walks[:, None],
        terminated=demonstrations.terminated & walks,
        final_states=jnp.where(walks, demonstrations.final_states, -1),
    )
    steps = jnp.arange(demonstrations.horizon)
    weight = jnp.where(demonstrations.mask, mdp.discount**steps, 0.0)
    # Weights are summed per pair first: [M, H, K] would not fit for long demonstrations and many features.
    pairs, is_lost = episode_ends.absorbed_time(mdp, demonstrations)
    pairs = pairs.at[demonstrations.states, demonstrations.actions].add(weight)
    return jnp.einsum("sa,sak->k", pairs, mdp.features) / walks.sum(), is_lost


_expectations, _expected_at_hand = jax.jit(_expected), quick_jit(_expected)


@checks.eager_where_concrete
def sample_demonstrations(
    key: Key[Array, ""],
    mdp: MDP,
    policy: Float[ArrayLike, "S A"] | Int[ArrayLike, " S"],
    num_trajectories: int,
    horizon: int,
    *,
    terminal: Bool[ArrayLike, " S"] | None = None,
) -> Demonstrations:
    """Draws trajectories of a policy, started from the model's initial distribution.

    Works under `jit` and `vmap`, with the counts static; draws have no derivative.

    Args:
      key: a `jax.random` key; the same key gives the same trajectories, with `terminal` up to their ends.
      mdp: the model.
      policy: [S, A], rows sum to 1; integers [S] are the actions of one that is deterministic.
      num_trajectories: M, at least 1.
      horizon: H, the largest number of steps of a trajectory, at least 1.
      terminal: bool [S], states in which an episode ends: it has no step there. None if episodes are not to end; a walk
        then goes on in absorbing states too.

    Returns:
      Demonstrations [M, H]. With `terminal`, `terminated` says which episodes ended within H steps, and `final_states`
      where each was after its last step; without, there is no padding and final states are not kept.

    Raises:
      ValueError: if `key` is none, `policy` has another shape or is none, a count is below 1, or `terminal` is not
        bool [S] or True where episodes start.

    Example:
      >>> ring = MDP.from_successors([[[1]], [[2]], [[2]]], [[[1.0]]] * 3, discount=0.9, initial=[1, 0, 0])
      >>> walks = sample_demonstrations(jax.random.key(0), ring, [0, 0, 0], 1, 4, terminal=[False, False, True])
      >>> walks.states.tolist(), walks.mask.tolist(), walks.terminated.tolist()
      ([[0, 1, 0, 0]], [[True, True, False, False]], [True])
    """
    checks.require_key(key)
    mdp = as_model(mdp)
    policy = check_policy(mdp, policy, batch=False)
    num_trajectories = checks.require_count("num_trajectories", num_trajectories)
    horizon = checks.require_count("horizon", horizon)
    if terminal is not None:
        terminal = checks.require_flags("terminal", jnp.asarray(terminal), mdp.num_states)
        if not checks.is_traced(terminal, mdp.initial):
            starts = np.asarray(mdp.initial) > 0
            message = "must be False where episodes start: one that starts there has no step"
            checks.require_all("terminal", np.asarray(terminal), ~(starts & np.asarray(terminal)), message)
    return Demonstrations(**sample_walks(key, mdp, policy, terminal, num_trajectories, horizon))
