"""Finite Markov decision processes without a reward, in two layouts.

A model is T(s, a, s'), an initial distribution alpha, a discount gamma and features phi(s, a) of which the
unknown reward is a non-negative combination (Boularias and Chaib-draa 2010, section II). What the solvers need
of it are two linear maps, both defined here and nowhere else:

    backward   (T v)(s, a) = sum_s' T(s, a, s') v(s')            `expected_next_value`
    forward    (T^t x)(s') = sum_{s, a} x(s, a) T(s, a, s')      `push_forward`

*Successor layout.* `next_state[S, A, N]` and `probability[S, A, N]` list the N successors of every pair, padded
with probability 0. Rows wider than most (a restart anywhere on a track, say) would make every sweep pay for them,
so they are kept apart. The forward map reads the same numbers through
their transpose, lists of (s, a, slot) entries per s', so that derivatives reach `probability` either way.

*Dense layout.* Where N is near S the slots are the states themselves (`probability` is T) and both maps are
matrix products. The choice is made once, in the constructors.

*Actions that some states lack.* `allowed[s, a]` says which actions exist. Where one does not, its row of probabilities
and its features are zero, and no policy may take it.

Sweeps take a trailing batch axis: v is [S] or [S, B], x is [S, A] or [S, A, B]. Batch last is what XLA's CPU
backend vectorises.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.padded_rows import PaddedRows, gather_sum, narrow_width, pad_rows
from jaxhom.models.policy_chain import Edges, find_edges
from jaxhom.status import Record

_REPLACEABLE = ("discount", "initial", "features", "probability", "allowed")
_MAX_UNROLLED_ACTIONS = 16  # more are not written out one by one: programs would take minutes to compile
_DENSE_FRACTION = 0.25  # dense layout from N >= S / 4 on, where products beat gathers


class MDP(Record):
    """A finite MDP without reward. Build it with `MDP.from_dense` or `MDP.from_successors`.

    Attributes:
      next_state: int32 [S, A, N], successors of each state-action pair (ascending; padding repeats 0).
      probability: float [S, A, N], their probabilities; 0 on padding.
      initial: float [S], distribution of the first state.
      features: float [S, A, K]; the unknown reward is sum_i w_i features[..., i] with w_i >= 0.
      discount: float scalar, strictly between 0 and 1.
      allowed: bool [S, A], the actions that exist in each state, one at least.
      wide_pairs: int32 [J], flat (s, a) indices of the pairs with successors beyond the narrow width.
      wide_successors: int32 [N], the successors of all these pairs, if they are the same (restarts); else None.
      predecessors: per state s', the flat (s, a, slot) entries that lead to it; None in the dense layout.
      edges: the graph's edges, for the chains of policies; None in the dense layout.
      narrow_width: slots that every sweep reads for every pair.
      restricts_actions: whether some state lacks some action.
    """

    next_state: jax.Array
    probability: jax.Array
    initial: jax.Array
    features: jax.Array
    discount: jax.Array
    allowed: jax.Array
    wide_pairs: jax.Array
    wide_successors: jax.Array | None
    predecessors: PaddedRows | None
    edges: Edges | None
    narrow_width: int = dataclasses.field(metadata={"static": True})
    restricts_actions: bool = dataclasses.field(metadata={"static": True})

    @classmethod
    def from_dense(cls, transition, *, discount, initial=None, features=None, allowed=None) -> "MDP":
        """Builds a model from its transition tensor.

        Args:
          transition: [S, A, S], transition[s, a, s'] = T(s, a, s'); rows sum to 1. Sums within 1e-5 of 1 (1e-4 in
            float32) are accepted, and the rows divided by them.
          discount: scalar, strictly between 0 and 1.
          initial: [S] distribution of the first state, to the same tolerance; uniform if None.
          features: [S, A, K], or [S, K] for features of the state alone; no features (K = 0) if None.
          allowed: bool [S, A], which actions exist in each state, one at least; all if None. What the other pairs have
            in `transition` and `features` is not looked at.

        Returns:
          The model, in the dtype of `transition` (integers become floats).

        Raises:
          ValueError: on a wrong shape, on more than 2^31 - 2 entries, naming the first entry that is NaN, negative
            or out of range, the first row that does not sum to 1, or the first state without an action.
        """
        transition = checks.as_host_array("transition", transition)
        shape = transition.shape
        good = len(shape) == 3 and shape[0] == shape[2] and min(shape, default=0) > 0
        checks.require_shape("transition", transition, "[S, A, S] with S, A >= 1", good)
        checks.require_slots(*shape)
        allowed = _validated_allowed(allowed, shape[:2])
        transition = checks.require_distribution("transition", transition, None if allowed.all() else allowed)
        num_states = shape[0]
        width = int((transition > 0).sum(axis=-1).max())
        if width >= _DENSE_FRACTION * num_states:
            next_state = np.broadcast_to(np.arange(num_states, dtype=np.int32), shape)
            return cls._assemble(next_state, transition, discount, initial, features, allowed)
        next_state, probability = _compress(transition, width)
        return cls._assemble(next_state, probability, discount, initial, features, allowed)

    @classmethod
    def from_successors(cls, next_state, probability, *, discount, initial=None, features=None, allowed=None) -> "MDP":
        """Builds a model from lists of successors, without ever making the dense tensor of a sparse model.

        Args:
          next_state: integers [S, A, N] in [0, S). A successor that is listed twice counts with the sum.
          probability: [S, A, N]; rows sum to 1, as in `from_dense`. Padding has probability 0 and any valid state.
          discount: scalar, strictly between 0 and 1.
          initial: [S] distribution of the first state; uniform if None.
          features: [S, A, K] or [S, K]; no features (K = 0) if None.
          allowed: bool [S, A], as in `from_dense`.

        Returns:
          The model, in the dtype of `probability`.

        Raises:
          ValueError: as `from_dense`, and for a successor outside [0, S).
        """
        next_state = checks.as_host_array("next_state", next_state)
        probability = checks.as_host_array("probability", probability)
        good = next_state.ndim == 3 and min(next_state.shape) > 0
        checks.require_shape("next_state", next_state, "[S, A, N] with S, A, N >= 1", good)
        same = probability.shape == next_state.shape
        checks.require_shape("probability", probability, str(next_state.shape), same)
        checks.require_slots(*next_state.shape)
        allowed = _validated_allowed(allowed, next_state.shape[:2])
        if not allowed.all():
            next_state = np.where(allowed[..., None], next_state, 0)
        next_state = checks.require_integers("next_state", next_state, upper=len(next_state))
        probability = checks.require_distribution("probability", probability, None if allowed.all() else allowed)
        next_state, probability = _merge_repeated(next_state, probability)
        num_states, num_actions, width = next_state.shape
        if width >= _DENSE_FRACTION * num_states:
            checks.require_slots(num_states, num_actions, num_states)
            transition = _scatter_dense(next_state, probability)
            return cls.from_dense(transition, discount=discount, initial=initial, features=features, allowed=allowed)
        return cls._assemble(next_state, probability, discount, initial, features, allowed)

    @classmethod
    def _assemble(cls, next_state, probability, discount, initial, features, allowed) -> "MDP":
        num_states, _, width = next_state.shape
        dtype = checks.to_device(probability[:1, :1]).dtype  # float64 becomes float32 unless x64 is on
        if initial is None:
            initial = np.full(num_states, 1.0 / num_states)
        initial = checks.as_host_array("initial", initial)
        checks.require_shape("initial", initial, f"({num_states},)", initial.shape == (num_states,))
        initial = checks.require_distribution("initial", initial)
        features = _validated_features(features, allowed, dtype)
        discount = checks.require_discount(discount, dtype)
        _require_contraction(probability, discount)
        dense = width == num_states
        slots, wide_pairs, wide_successors, predecessors, edges = width, np.zeros(0, np.int32), None, None, None
        if not dense:
            counts = (probability > 0).sum(axis=-1).ravel()
            slots = narrow_width(counts)
            wide_pairs = np.flatnonzero(counts > slots).astype(np.int32)
            lists = next_state.reshape(-1, width)[wide_pairs]
            if len(lists) and (lists == lists[0]).all():
                wide_successors = checks.to_device(lists[0], jnp.int32)
            entry = np.flatnonzero(probability > 0)
            predecessors = pad_rows(entry, next_state.ravel()[entry], num_states, next_state.size)
            edges = find_edges(next_state, probability)
        return cls(
            next_state=checks.to_device(next_state, jnp.int32),
            probability=checks.to_device(probability, dtype),
            initial=checks.to_device(initial, dtype),
            features=checks.to_device(features, dtype),
            discount=checks.to_device(discount, dtype),
            allowed=checks.to_device(allowed),
            wide_pairs=checks.to_device(wide_pairs),
            wide_successors=wide_successors,
            predecessors=jax.tree.map(checks.to_device, predecessors),
            edges=jax.tree.map(checks.to_device, edges),
            narrow_width=slots,
            restricts_actions=not allowed.all(),
        )

    def replace(self, **changes) -> "MDP":
        """Returns the model with the given arrays exchanged; usable under jit, vmap and grad.

        New numbers get the type of those that they replace, so that what was compiled for the model serves the new one
        too. Concrete arrays go through the constructors' checks, traced ones through none but those of shapes.

        Args:
          **changes: `discount`, `initial`, `features` ([S, A, K] or [S, K]), `probability` in the layout that the model
            has, without a successor that was not there: successors are not searched for again; `allowed`, which may
            only take actions away.

        Raises:
          ValueError: if another field is named, or a concrete array is not what the constructors would take.
        """
        if not hasattr(self.probability, "dtype"):  # a description, such as vmap's axes
            return dataclasses.replace(self, **changes)
        for name in changes:
            if name not in _REPLACEABLE:
                raise ValueError(f"{name} cannot be replaced ({', '.join(_REPLACEABLE)} can): build a new model")
        model = self._without_actions(changes.pop("allowed")) if "allowed" in changes else self
        return dataclasses.replace(model, **{name: _replacement(model, name, new) for name, new in changes.items()})

    def _without_actions(self, allowed) -> "MDP":
        """The model with fewer actions."""
        allowed = _validated_allowed(allowed, self.allowed.shape)
        checks.require_all("allowed", allowed, ~allowed | np.asarray(self.allowed), "is a pair without transitions")
        keep = checks.to_device(allowed)[..., None]
        return dataclasses.replace(
            self,
            allowed=checks.to_device(allowed),
            probability=jnp.where(keep, self.probability, 0.0),
            features=jnp.where(keep, self.features, 0.0),
            restricts_actions=not allowed.all(),
        )

    def _figures(self) -> dict:
        layout = {"layout": "dense"} if self.is_dense else {"layout": "successors", "width": self.next_state.shape[-1]}
        return {
            "num_states": self.num_states,
            "num_actions": self.num_actions,
            "num_features": self.num_features,
            "discount": self.discount,
            "dtype": str(self.dtype),
            **layout,
        }

    @property
    def num_states(self) -> int:
        """S."""
        return self.probability.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.probability.shape[1]

    @property
    def num_features(self) -> int:
        """K."""
        return self.features.shape[-1]

    @property
    def dtype(self):
        """Floating-point type of the model, and so of the work done on it."""
        return self.probability.dtype

    @property
    def is_dense(self) -> bool:
        """True in the dense layout, where `probability` is the transition tensor itself."""
        return self.predecessors is None

    @property
    def transition(self) -> jax.Array:
        """The dense tensor T, [S, A, S]. Made anew at each call in the successor layout: mind its size."""
        if self.is_dense:
            return self.probability
        states, actions, _ = self.probability.shape
        s, a = jnp.ogrid[:states, :actions]
        zeros = jnp.zeros((states, actions, states), self.dtype)
        return zeros.at[s[..., None], a[..., None], self.next_state].add(self.probability)


def expected_next_value(mdp: MDP, value: jax.Array) -> jax.Array:
    """The backward map: E[value(s') | s, a], [S] -> [S, A] or [S, B] -> [S, A, B]."""
    if mdp.is_dense:
        return jnp.tensordot(mdp.probability, value, axes=1)
    if mdp.num_actions > _MAX_UNROLLED_ACTIONS:
        return gather_sum(*_narrow_rows(mdp, value))
    return jnp.stack(expected_next_values(mdp, value), axis=1)


def expected_next_values(mdp: MDP, value: jax.Array) -> list[jax.Array]:
    """The backward map action by action: A arrays E[value(s') | s, a], each [S] or [S, B].

    What sweeps run on: a maximum or average over actions that is written out over this list stays in one vectorised
    pass, where one over the middle axis of `expected_next_value` does not.
    """
    if mdp.is_dense:
        return list(jnp.moveaxis(expected_next_value(mdp, value), 1, 0))
    if value.ndim == 2 and value.shape[1] == 1:  # gathers of single numbers, not of rows of one
        return [expected[:, None] for expected in expected_next_values(mdp, value[:, 0])]
    index, weight, value = _narrow_rows(mdp, value)
    return [gather_sum(index[:, a], weight[:, a], value) for a in range(mdp.num_actions)]


def _narrow_rows(mdp: MDP, value: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Indices and weights [S, A, W], and the values that they read: E[value(s') | s, a] is their `gather_sum`."""
    width, slots = mdp.narrow_width, mdp.next_state.shape[-1]
    index, weight = mdp.next_state[..., :width], mdp.probability[..., :width]
    if mdp.wide_pairs.size:
        # A wide row's expectation is computed beside the states' values and looked up like one more state.
        wide = mdp.probability.reshape(-1, slots)[mdp.wide_pairs]
        if mdp.wide_successors is None:
            expectation = gather_sum(mdp.next_state.reshape(-1, slots)[mdp.wide_pairs], wide, value)
        else:
            expectation = wide @ value[mdp.wide_successors]
        lookup = mdp.num_states + jnp.arange(mdp.wide_pairs.size, dtype=index.dtype)
        first = jnp.arange(width) == 0
        index = _replace_pairs(index, mdp.wide_pairs, jnp.where(first, lookup[:, None], 0))
        weight = _replace_pairs(weight, mdp.wide_pairs, first.astype(weight.dtype))
        value = jnp.concatenate([value, expectation])
    return index, weight, value


def _replace_pairs(rows: jax.Array, pairs: jax.Array, replacement: jax.Array) -> jax.Array:
    """`rows` [S, A, W] with those of the given flat pairs exchanged."""
    return rows.reshape(-1, rows.shape[-1]).at[pairs].set(replacement).reshape(rows.shape)


def push_forward(mdp: MDP, occupancy: jax.Array) -> jax.Array:
    """The forward map: sum_{s, a} x(s, a) T(s, a, s'), [S, A] -> [S] or [S, A, B] -> [S, B]."""
    if mdp.is_dense:
        return jnp.tensordot(mdp.probability, occupancy, axes=((0, 1), (0, 1)))
    if occupancy.ndim == 3 and occupancy.shape[2] == 1:
        return push_forward(mdp, occupancy[..., 0])[:, None]
    rows, slots = mdp.predecessors, mdp.probability.shape[-1]
    flat = occupancy.reshape((-1, *occupancy.shape[2:]))
    entries = jnp.append(mdp.probability.ravel(), jnp.zeros((), mdp.dtype))  # the sentinel's 0

    def pull(entry):
        pair = jnp.minimum(entry // slots, flat.shape[0] - 1)
        return gather_sum(pair, entries[entry], flat)

    pushed = pull(rows.narrow)
    if rows.wide_row.size:
        pushed = pushed.at[rows.wide_row].add(pull(rows.wide))
    return pushed


def state_transition(mdp: MDP, policy: jax.Array) -> jax.Array:
    """P_pi(s, s') = sum_a pi(s, a) T(s, a, s'), [S, A] -> [S, S] dense; for small models."""
    if mdp.is_dense:
        return jnp.einsum("sa,saz->sz", policy, mdp.probability)
    weight = policy[..., None] * mdp.probability
    rows = jnp.broadcast_to(jnp.arange(mdp.num_states)[:, None, None], weight.shape)
    zeros = jnp.zeros((mdp.num_states, mdp.num_states), weight.dtype)
    return zeros.at[rows, mdp.next_state].add(weight)


def absorbing_states(mdp: MDP) -> jax.Array:
    """bool [S]: the states that every allowed action stays in with certainty; works under jit and vmap."""
    leaves = mdp.next_state != jnp.arange(mdp.num_states, dtype=mdp.next_state.dtype)[:, None, None]
    return jnp.where(leaves, mdp.probability, 0.0).sum(axis=(1, 2)) == 0


def uniform_policy(mdp: MDP) -> jax.Array:
    """[S, A]: every allowed action alike; works under jit and vmap."""
    allowed = mdp.allowed.astype(mdp.dtype)
    return allowed / allowed.sum(axis=-1, keepdims=True)


def _compress(transition: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """[S, A, S] -> successors (ascending, padding last) and probabilities, [S, A, width]."""
    s, a, z = np.nonzero(transition)
    shape = transition.shape[:2]
    pair = s * shape[1] + a
    start = np.searchsorted(pair, np.arange(shape[0] * shape[1]))
    slot = np.arange(len(pair)) - start[pair]
    next_state = np.zeros((*shape, width), np.int32)
    probability = np.zeros((*shape, width), transition.dtype)
    next_state[s, a, slot] = z
    probability[s, a, slot] = transition[s, a, z]
    return next_state, probability


def _merge_repeated(next_state, probability) -> tuple[np.ndarray, np.ndarray]:
    """Sorts each row by successor, adds repeated ones up, and drops slots that no row uses.

    Done on the entries alone: with one row of thousands of successors nearly all of the arrays is padding.
    """
    num_states, num_actions, slots = next_state.shape
    entry = np.flatnonzero(probability > 0)
    key = entry // slots * num_states + next_state.ravel()[entry]
    order = np.argsort(key, kind="stable")
    key, entry = key[order], entry[order]
    begin = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    merged = np.add.reduceat(probability.ravel()[entry], begin)
    pair, successor = np.divmod(key[begin], num_states)
    slot = np.arange(len(pair)) - np.searchsorted(pair, pair)
    shape = (num_states * num_actions, int(slot.max()) + 1)
    merged_state, merged_probability = np.zeros(shape, np.int32), np.zeros(shape, probability.dtype)
    merged_state[pair, slot], merged_probability[pair, slot] = successor, merged
    shape = (num_states, num_actions, -1)
    return merged_state.reshape(shape), merged_probability.reshape(shape)


def _scatter_dense(next_state, probability) -> np.ndarray:
    """Successors without repetitions -> [S, A, S]."""
    states, actions, _ = next_state.shape
    transition = np.zeros((states, actions, states), probability.dtype)
    s, a = np.ogrid[:states, :actions]
    np.add.at(transition, (s[..., None], a[..., None], next_state), probability)
    return transition


def _require_contraction(probability: np.ndarray, discount: np.ndarray) -> None:
    """Raises where a sum within the tolerance of 1 makes discounted sums diverge all the same."""
    total = np.asarray(probability).sum(axis=-1, dtype=np.float64)
    message = f"is too far above 1 for a discount of {discount}"
    checks.require_all("sum of probability", total, total * np.float64(discount) < 1.0, message)


def _replacement(mdp: MDP, name: str, new) -> jax.Array:
    """What `MDP.replace` puts in the place of a field; checked as far as it is concrete."""
    old = getattr(mdp, name)
    if checks.is_traced(new, mdp):
        if name == "features" and jnp.ndim(new) == 2 and jnp.shape(new)[0] == mdp.num_states:
            new = jnp.broadcast_to(jnp.asarray(new)[:, None], (*old.shape[:2], jnp.shape(new)[1]))
        good = jnp.shape(new) == old.shape or (name == "features" and jnp.shape(new)[:-1] == old.shape[:-1])
        checks.require_shape(name, new, str(old.shape), good)
        return jnp.asarray(new, old.dtype)
    if name == "discount":
        new = checks.require_discount(new, old.dtype)
        _require_contraction(mdp.probability, new)
        return checks.to_device(new)
    allowed = np.asarray(mdp.allowed)
    if name == "features":
        return checks.to_device(_validated_features(new, allowed, old.dtype), old.dtype)
    new = checks.as_host_array(name, new)
    checks.require_shape(name, new, str(old.shape), new.shape == old.shape)
    if name == "initial":
        return checks.to_device(checks.require_distribution(name, new), old.dtype)
    new = checks.require_distribution(name, new, allowed if mdp.restricts_actions else None)
    if not mdp.is_dense:
        was_there = np.asarray(old) > 0
        checks.require_all(name, new, (new == 0) | was_there, "is a successor that the model did not have")
    return checks.to_device(new, old.dtype)


def _validated_allowed(allowed, shape: tuple[int, int]) -> np.ndarray:
    """Which actions exist, bool [S, A], or raises."""
    if allowed is None:
        return np.ones(shape, bool)
    allowed = checks.as_host_array("allowed", allowed)
    checks.require_shape("allowed", allowed, str(tuple(shape)), allowed.shape == tuple(shape))
    if allowed.dtype != bool:
        raise ValueError(f"allowed must be bool, got dtype {allowed.dtype}")
    some = allowed.any(axis=1)
    if not some.all():
        raise ValueError(f"allowed[{int(np.argmin(some))}] allows no action: a state needs one at least")
    return allowed


def _validated_features(features, allowed: np.ndarray, dtype) -> np.ndarray:
    """Returns features as [S, A, K] in the model's type, zero where an action is not allowed; or raises."""
    num_states, num_actions = allowed.shape
    if features is None:
        return np.zeros((num_states, num_actions, 0))
    features = checks.as_host_array("features", features)
    by_state = features.ndim == 2 and len(features) == num_states
    by_pair = features.ndim == 3 and features.shape[:2] == (num_states, num_actions)
    expected = f"({num_states}, {num_actions}, K) or ({num_states}, K)"
    checks.require_shape("features", features, expected, by_state or by_pair)
    if by_pair and not allowed.all():
        features = np.where(allowed[..., None], features, 0)  # whatever is there is not looked at
    features = checks.require_floats_in(dtype, "features", features)
    if by_pair:
        return features
    features = np.broadcast_to(features[:, None], (num_states, num_actions, features.shape[-1]))
    return features if allowed.all() else np.where(allowed[..., None], features, 0)
