"""Small models for the tests: jaxhom's `MDP` beside the NumPy arrays that it was built from.

Each is the smallest that reaches one path of the code: LU or Krylov solves, dense or successor
layout, rows of successors and of predecessors that are wider than most.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import oracles

from jaxhom.models.mdp import MDP


class Case(NamedTuple):
    """A model twice; `arrays` are what the oracles take."""

    name: str
    mdp: MDP
    transition: np.ndarray
    discount: float
    initial: np.ndarray
    features: np.ndarray

    @property
    def arrays(self):
        return self.transition, self.discount, self.initial, self.features

    @property
    def shape(self):
        return self.features.shape[:2]


def random_policy(rng, *shape):
    """Policy [..., S, A] with flat Dirichlet rows."""
    return rng.dirichlet(np.ones(shape[-1]), size=shape[:-1])


def dense_transition(mdp):
    """T [S, A, S] of a model in NumPy: without compiling anything for its shape."""
    transition = np.zeros((mdp.num_states, mdp.num_actions, mdp.num_states))
    s, a, _ = np.indices(mdp.probability.shape)
    np.add.at(transition, (s, a, np.asarray(mdp.next_state)), np.asarray(mdp.probability))
    return transition


@functools.cache
def case(name: str) -> Case:
    transition, discount, initial, features = _BUILDERS[name]()
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    return Case(name, mdp, transition, discount, initial, features)


def slow_ring() -> Case:
    """A ring of 258 states that hardly mixes, with discount 0.999, in the dense layout.

    It has the shapes of "dense_krylov", so what is compiled for that serves here too.
    """
    other = case("dense_krylov")
    transition = np.zeros(other.transition.shape)
    for s in range(len(transition)):
        for action, step in enumerate((-1, 1)):
            transition[s, action, (s + step) % len(transition)] += 0.95
            transition[s, action, (s - step) % len(transition)] += 0.05
    mdp = other.mdp.replace(probability=jnp.asarray(transition), discount=np.asarray(0.999))
    return Case("slow_ring", mdp, transition, 0.999, other.initial, other.features)


def in_float32(case: Case) -> Case:
    """The model rounded to float32; the arrays are those rounded numbers, in float64."""
    rounded = [array.astype(np.float32) for array in (case.transition, case.initial, case.features)]
    transition, initial, features = rounded
    mdp = MDP.from_dense(transition, discount=case.discount, initial=initial, features=features)
    discount = float(np.float32(case.discount))
    return Case(case.name, mdp, transition.astype(float), discount, initial.astype(float), features)


def _random(seed, *args, **kwargs):
    return oracles.random_mdp(np.random.default_rng(seed), *args, **kwargs)


def absorbing():
    """Deterministic: 0 -> 1 -> 2, which absorbs; 3 is unreachable; 4 and 5 alternate."""
    step = [(1, 0), (2, 1), (2, 2), (0, 4), (5, 5), (4, 4)]
    transition = np.eye(6)[np.array(step)]
    initial = np.array([0.5, 0.25, 0.0, 0.0, 0.25, 0.0])
    features = np.random.default_rng(6).uniform(-1, 1, size=(6, 2, 3))
    return transition, 0.9, initial, features


def restart():
    """A noisy ring; five pairs restart among 24 states, all others may fall back to state 0."""
    num_states, num_actions = 100, 3
    rng = np.random.default_rng(7)
    transition = np.zeros((num_states, num_actions, num_states))
    for s in range(num_states):
        for action, move in enumerate((1, -1, 2)):
            transition[s, action, (s + move) % num_states] += 0.8
            transition[s, action, (s + 5) % num_states] += 0.1
            transition[s, action, 0] += 0.1
    transition[95:, 2] = 0.0
    transition[95:, 2, 10:34] = rng.dirichlet(np.ones(24), size=5)
    features = rng.uniform(size=(num_states, num_actions, 2))
    return transition, 0.99, np.eye(num_states)[3], features


_BUILDERS = {
    "one_state": lambda: _random(1, 1, 1, K=2),
    "one_action": lambda: _random(2, 5, 1, K=2),
    "dense": lambda: _random(3, 7, 3, K=2),
    "absorbing": absorbing,
    "sparse": lambda: _random(4, 40, 3, N=4, K=2),
    "restart": restart,
    "dense_krylov": lambda: _random(9, 258, 2, K=2),
}
NAMES = tuple(_BUILDERS)
