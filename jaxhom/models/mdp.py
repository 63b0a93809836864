"""Finite Markov decision processes without a reward.

A model is T(s, a, s'), an initial distribution alpha, a discount gamma and features phi(s, a) of which the
unknown reward is a non-negative combination (Boularias and Chaib-draa 2010, section II). T is a `Dynamics`, in one of
two layouts: the constructors choose (`construction`), and everything else runs on the two maps that both have.

*Actions that some states lack.* `allowed[s, a]` says which actions exist. Where one does not, its row of probabilities
and its features are zero, and no policy may take it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models import construction
from jaxhom.models.dense_tensor import DenseTensor
from jaxhom.models.dynamics import Dynamics
from jaxhom.models.exploration import explore, features_of, padded
from jaxhom.models.names import Names, check_names, look_up, numbers_of
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int

_REPLACEABLE = ("discount", "initial", "features", "probability", "allowed", "state_names", "action_names")


class MDP(Record):
    """A finite MDP without reward. Build it with `MDP.from_dense`, `MDP.from_successors` or `MDP.from_function`.

    Attributes:
      dynamics: the transitions in the layout that was chosen for them, with the one-step maps.
      initial: float [S], distribution of the first state.
      features: float [S, A, K]; the unknown reward is sum_i w_i features[..., i] with w_i >= 0.
      discount: float scalar, strictly between 0 and 1.
      allowed: bool [S, A], the actions that exist in each state, one at least.
      restricts_actions: whether some state lacks some action.
      state_names: S hashable values, or None: what the states are called, in messages, explanations and files.
      action_names: A of them, or None. Models that come out of `jit`, `vmap`, `grad` and `jax.tree.map` have no names.
    """

    dynamics: Dynamics
    initial: Float[Array, " S"]
    features: Float[Array, "S A K"]
    discount: Float[Array, ""]
    allowed: Bool[Array, "S A"]
    restricts_actions: bool = dataclasses.field(metadata={"static": True})
    state_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})
    action_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})

    @classmethod
    def from_dense(
        cls,
        transition: Float[ArrayLike, "S A S"],
        *,
        discount: Float[ArrayLike, ""],
        initial: Float[ArrayLike, " S"] | None = None,
        features: Float[ArrayLike, "S A K"] | Float[ArrayLike, "S K"] | None = None,
        allowed: Bool[ArrayLike, "S A"] | None = None,
        state_names: Iterable[Hashable] | None = None,
        action_names: Iterable[Hashable] | None = None,
    ) -> MDP:
        """Builds a model from its transition tensor. On the host: not under `jit`, `vmap` or `grad`.

        Args:
          transition: [S, A, S], transition[s, a, s'] = T(s, a, s'); rows sum to 1. Sums within 1e-5 of 1 (1e-4 in
            float32) are accepted, and the rows divided by them.
          discount: scalar, strictly between 0 and 1.
          initial: [S] distribution of the first state, to the same tolerance; uniform if None.
          features: [S, A, K], or [S, K] for features of the state alone; no features (K = 0) if None.
          allowed: bool [S, A], which actions exist in each state, one at least; all if None. What the other pairs have
            in `transition` and `features` is not looked at.
          state_names: S hashable values, all different; none if None.
          action_names: A of them; none if None.

        Returns:
          The model, in the dtype of `transition` (integers become floats).

        Raises:
          ValueError: on a wrong shape, on more than 2^31 - 2 entries, naming the first entry that is NaN, negative
            or out of range, the first row that does not sum to 1, the first state without an action, or the first name
            that is not new.

        Example:
          >>> mdp = MDP.from_dense([[[0.5, 0.5], [1, 0]], [[0, 1], [0, 1]]], discount=0.9, initial=[1, 0])
          >>> mdp.num_states, mdp.num_actions, mdp.num_features
          (2, 2, 0)
        """
        lists = construction.lists_of_tensor(transition, allowed)
        return cls._assemble(*lists, discount, initial, features, state_names, action_names)

    @classmethod
    def from_successors(
        cls,
        next_state: Int[ArrayLike, "S A N"],
        probability: Float[ArrayLike, "S A N"],
        *,
        discount: Float[ArrayLike, ""],
        initial: Float[ArrayLike, " S"] | None = None,
        features: Float[ArrayLike, "S A K"] | Float[ArrayLike, "S K"] | None = None,
        allowed: Bool[ArrayLike, "S A"] | None = None,
        state_names: Iterable[Hashable] | None = None,
        action_names: Iterable[Hashable] | None = None,
    ) -> MDP:
        """Builds a model from lists of successors, without ever making the dense tensor of a sparse model.

        On the host: not under `jit`, `vmap` or `grad`.

        Args:
          next_state: integers [S, A, N] in [0, S). A successor that is listed twice counts with the sum.
          probability: [S, A, N]; rows sum to 1, as in `from_dense`. Padding has probability 0 and any valid state.
          discount: scalar, strictly between 0 and 1.
          initial: [S] distribution of the first state; uniform if None.
          features: [S, A, K] or [S, K]; no features (K = 0) if None.
          allowed: bool [S, A], as in `from_dense`.
          state_names: S names, as in `from_dense`.
          action_names: A of them.

        Returns:
          The model, in the dtype of `probability`.

        Raises:
          ValueError: as `from_dense`, and for a successor outside [0, S).

        Example:
          >>> ring = MDP.from_successors([[[1]], [[2]], [[0]]], [[[1.0]], [[1.0]], [[1.0]]], discount=0.9)
          >>> ring.transition[:, 0].tolist()
          [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
        """
        lists = construction.lists_of_successors(next_state, probability, allowed)
        return cls._assemble(*lists, discount, initial, features, state_names, action_names)

    @classmethod
    def from_function(
        cls,
        successors: Callable[[Any], Mapping[Hashable, Iterable[tuple[float, Hashable]]] | None],
        start: Hashable | Mapping[Hashable, float],
        *,
        discount: Float[ArrayLike, ""],
        features: Callable[[Any, Any], Sequence[float]] | None = None,
        actions: Iterable[Hashable] | None = None,
        max_states: int = 1_000_000,
        progress: bool = False,
    ) -> MDP:
        """Builds a model of all states that a function leads to, explored breadth first.

        On the host: not under `jit`, `vmap` or `grad`.

        Args:
          successors: takes a state, any hashable value, and returns a mapping from the actions that exist there
            (hashable values too) to lists of pairs (probability, next state), whose probabilities sum to 1. A state
            where nothing can be done (None, or an empty mapping) ends an episode: it is absorbing, with all actions.
          start: the state where episodes start, or a mapping from states to probabilities.
          discount: scalar, strictly between 0 and 1.
          features: takes a state and an action that exists there, and returns K numbers; no features (K = 0) if None.
            Where an episode has ended they are 0.
          actions: A of them, in the order in which they are to be numbered; as they are met if None.
          max_states: more than so many are refused.
          progress: show how many states have been explored.

        Returns:
          The model, in float64 (float32 unless x64 is on). `state_names` and `action_names` are the states and actions,
          numbered as they were met.

        Raises:
          ValueError: naming the state and action whose outcomes are malformed or do not sum to 1; if there are too many
            states, or no actions; and as `from_dense`. What the functions raise themselves is passed on, with a note
            that names the state.

        Example:
          >>> def successors(place):  # a corridor of four places, with a slippery floor
          ...     go = [(0.8, place + 1), (0.2, place)]
          ...     return None if place == 3 else {"wait": [(1.0, place)], "go": go}
          >>> mdp = MDP.from_function(successors, 0, discount=0.9, features=lambda place, action: [action == "go"])
          >>> mdp.state_names, mdp.action_names, mdp.features[..., 0].tolist()
          ((0, 1, 2, 3), ('wait', 'go'), [[0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
          >>> mdp.transition[mdp.state_index(2), mdp.action_index("go")].tolist()
          [0.0, 0.0, 0.2, 0.8]
        """
        found = explore(successors, start, actions, max_states, progress)
        next_state, probability = padded(found)
        lists = construction.lists_of_successors(next_state, probability, found.allowed)
        table = None if features is None else features_of(features, found)
        return cls._assemble(*lists, discount, found.initial, table, found.states, found.actions)

    @classmethod
    def _assemble(cls, next_state, probability, allowed, discount, initial, features, state_names, action_names) -> MDP:
        dtype = checks.to_device(probability[:1, :1]).dtype  # float64 becomes float32 unless x64 is on
        initial = construction.check_initial(initial, len(next_state))
        features = construction.check_features(features, allowed, dtype)
        discount = checks.require_discount(discount, dtype)
        construction.check_contraction(probability, discount)
        return cls(
            dynamics=construction.make_dynamics(next_state, probability, dtype),
            initial=checks.to_device(initial, dtype),
            features=checks.to_device(features, dtype),
            discount=checks.to_device(discount, dtype),
            allowed=checks.to_device(allowed),
            restricts_actions=not allowed.all(),
            state_names=check_names("state_names", state_names, len(allowed)),
            action_names=check_names("action_names", action_names, allowed.shape[1]),
        )

    def state_index(self, name: Hashable) -> int:
        """The number of the state with a name.

        Raises:
          ValueError: if there is none, naming those that look most like it; or if the states have no names.

        Example:
          >>> MDP.from_dense([[[0, 1]], [[0, 1]]], discount=0.9, state_names=["door", "room"]).state_index("room")
          1
        """
        return look_up("state", self._state_numbers, name)

    def action_index(self, name: Hashable) -> int:
        """The number of the action with a name.

        Raises:
          ValueError: as `state_index`.
        """
        return look_up("action", self._action_numbers, name)

    @functools.cached_property
    def _state_numbers(self) -> dict[Hashable, int] | None:
        return None if self.state_names is None else numbers_of("state_names", self.state_names)

    @functools.cached_property
    def _action_numbers(self) -> dict[Hashable, int] | None:
        return None if self.action_names is None else numbers_of("action_names", self.action_names)

    def replace(self, **changes: Any) -> MDP:
        """Returns the model with the given arrays exchanged; usable under `jit`, `vmap` and `grad`.

        New numbers get the type of those that they replace, so that what was compiled for the model serves the new one
        too. Concrete arrays go through the constructors' checks, traced ones through none but those of shapes.

        Args:
          **changes: `discount`, `initial`, `features` ([S, A, K] or [S, K]), `probability` in the layout that the model
            has, without a successor that was not there: successors are not searched for again; `allowed`, which may
            only take actions away; `state_names`, `action_names`.

        Raises:
          ValueError: if another field is named, or a concrete array is not what the constructors would take.

        Example:
          >>> mdp = MDP.from_dense([[[1.0]]], discount=0.9)
          >>> float(jax.grad(lambda discount: mdp.replace(discount=discount).discount ** 2)(0.5))
          1.0
        """
        if not hasattr(self.probability, "dtype"):  # a description, such as vmap's axes
            return self._exchange(changes)
        for name in changes:
            if name not in _REPLACEABLE:
                raise ValueError(f"{name} cannot be replaced ({', '.join(_REPLACEABLE)} can): build a new model")
        model = self._without_actions(changes.pop("allowed")) if "allowed" in changes else self
        return model._exchange({name: _replacement(model, name, new) for name, new in changes.items()})

    def _exchange(self, changes: dict) -> MDP:
        """The model with other fields; what the dynamics hold is exchanged there."""
        outer = {field.name for field in dataclasses.fields(self)}
        inner = {name: new for name, new in changes.items() if name not in outer}
        changes = {name: new for name, new in changes.items() if name in outer}
        if inner:
            changes["dynamics"] = self.dynamics.replace(**inner)
        return super().replace(**changes)

    def _without_actions(self, allowed) -> MDP:
        """The model with fewer actions."""
        if checks.is_traced(allowed, self):
            good = jnp.shape(allowed) == self.allowed.shape
            checks.require_shape("allowed", allowed, str(self.allowed.shape), good)
            keep, restricts_actions = jnp.asarray(allowed, bool) & self.allowed, True
        else:
            allowed = construction.check_allowed(allowed, self.allowed.shape)
            checks.require_all("allowed", allowed, ~allowed | np.asarray(self.allowed), "is a pair without transitions")
            keep, restricts_actions = checks.to_device(allowed), not allowed.all()
        return self._exchange(
            {
                "allowed": keep,
                "probability": jnp.where(keep[..., None], self.probability, 0.0),
                "features": jnp.where(keep[..., None], self.features, 0.0),
                "restricts_actions": restricts_actions,
            }
        )

    def _figures(self) -> dict:
        return {
            "batch": self.probability.shape[0] if self.probability.ndim > 3 else None,  # of `stack_models`
            "num_states": self.num_states,
            "num_actions": self.num_actions,
            "num_features": self.num_features,
            "discount": self.discount,
            "dtype": str(self.dtype),
            "layout": self.dynamics.layout,
            "width": self.next_state.shape[-1],
        }

    @property
    def num_states(self) -> int:
        """S."""
        return self.probability.shape[-3]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.probability.shape[-2]

    @property
    def num_features(self) -> int:
        """K."""
        return self.features.shape[-1]

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type of the model, and so of the work done on it."""
        return self.probability.dtype

    @property
    def next_state(self) -> Int[Array, "S A N"]:
        """The successors of every pair, see `Dynamics`; in the dense layout all states."""
        return self.dynamics.next_state

    @property
    def probability(self) -> Float[Array, "S A N"]:
        """The successors' probabilities, see `Dynamics`."""
        return self.dynamics.probability

    @property
    def is_dense(self) -> bool:
        """True in the dense layout, where `probability` is the transition tensor itself."""
        return isinstance(self.dynamics, DenseTensor)

    @property
    def transition(self) -> Float[Array, "S A S"]:
        """The dense tensor T. Made anew at each call in the successor layout: mind its size."""
        return self.dynamics.transition


def expected_next_value(mdp: MDP, value: Float[ArrayLike, "S *B"]) -> Float[Array, "S A *B"]:
    """The backward map: E[value(s') | s, a], [S] -> [S, A] or [S, B] -> [S, A, B]."""
    return mdp.dynamics.expected_next_value(value)


def expected_next_values(mdp: MDP, value: Float[ArrayLike, "S *B"]) -> list[Float[Array, "S *B"]]:
    """The backward map action by action: A arrays E[value(s') | s, a], each [S] or [S, B].

    What sweeps run on: a maximum or average over actions that is written out over this list stays in one vectorised
    pass, where one over the middle axis of `expected_next_value` does not.
    """
    return mdp.dynamics.expected_next_values(value)


def push_forward(mdp: MDP, occupancy: Float[ArrayLike, "S A *B"]) -> Float[Array, "S *B"]:
    """The forward map: sum_{s, a} x(s, a) T(s, a, s'), [S, A] -> [S] or [S, A, B] -> [S, B]."""
    return mdp.dynamics.push_forward(occupancy)


def state_transition(mdp: MDP, policy: Float[Array, "S A"]) -> Float[Array, "S S"]:
    """P_pi(s, s') = sum_a pi(s, a) T(s, a, s'), dense; for small models."""
    return mdp.dynamics.state_transition(policy)


def absorbing_states(mdp: MDP) -> Bool[Array, " S"]:
    """The states that every allowed action stays in with certainty; in NumPy at hand, also under `jit` and `vmap`."""
    xp = checks.arrays_of(mdp.next_state, mdp.probability)
    leaves = xp.asarray(mdp.next_state) != xp.arange(mdp.num_states, dtype=mdp.next_state.dtype)[:, None, None]
    return ~(leaves & (xp.asarray(mdp.probability) > 0)).any(axis=(1, 2))


def deciding_states(mdp: MDP, visited: Bool[Array, " S"]) -> Bool[Array, " S"]:
    """The demonstrated states in which there was something to decide; in NumPy at hand, also under `jit` and `vmap`.

    What was done in an absorbing state is no evidence: an episode's end is no decision, and every local model maps onto
    such a state with error 0. So it makes no difference whether demonstrations stop at the goal or walk on in it.
    """
    absorbs = absorbing_states(mdp)
    xp = checks.arrays_of(visited, absorbs)
    return xp.asarray(visited) & ~xp.asarray(absorbs)


def uniform_policy(mdp: MDP) -> Float[Array, "S A"]:
    """Every allowed action alike; in NumPy at hand, also under `jit` and `vmap`."""
    allowed = checks.arrays_of(mdp.allowed).asarray(mdp.allowed, mdp.dtype)
    return allowed / allowed.sum(axis=-1, keepdims=True)


def _replacement(mdp: MDP, name: str, new) -> jax.Array | Names | None:
    """What `MDP.replace` puts in the place of a field; checked as far as it is concrete."""
    if name in ("state_names", "action_names"):
        return check_names(name, new, mdp.num_states if name == "state_names" else mdp.num_actions)
    old = getattr(mdp, name)
    if checks.is_traced(new, mdp):
        if name == "features" and jnp.ndim(new) == 2 and jnp.shape(new)[0] == mdp.num_states:
            new = jnp.broadcast_to(jnp.asarray(new)[:, None], (*old.shape[:2], jnp.shape(new)[1]))
        good = jnp.shape(new) == old.shape or (name == "features" and jnp.shape(new)[:-1] == old.shape[:-1])
        checks.require_shape(name, new, str(old.shape), good)
        new = jnp.asarray(new, old.dtype)
        if mdp.restricts_actions and name in ("features", "probability"):
            new = jnp.where(mdp.allowed[..., None], new, 0.0)
        return new
    if name == "discount":
        new = checks.require_discount(new, old.dtype)
        construction.check_contraction(mdp.probability, new)
        return checks.to_device(new)
    if name == "features":
        return checks.to_device(construction.check_features(new, np.asarray(mdp.allowed), old.dtype), old.dtype)
    if name == "initial":
        return checks.to_device(construction.check_initial(checks.as_host_array(name, new), mdp.num_states), old.dtype)
    new = checks.as_host_array(name, new)
    checks.require_shape(name, new, str(old.shape), new.shape == old.shape)
    rows = np.asarray(mdp.allowed) if mdp.restricts_actions else None
    new = checks.require_distribution(name, new, rows, (mdp.state_names, mdp.action_names))
    checks.require_all(name, new, (new == 0) | mdp.dynamics.open_slots(), "is a successor that the model did not have")
    return checks.to_device(new, old.dtype)
