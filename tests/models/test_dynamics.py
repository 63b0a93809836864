"""Both layouts do the same: every method of `Dynamics` against the dense tensor in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_models

from jaxhom.domains.gridworld import gridworld
from jaxhom.models.construction import lists_of_tensor
from jaxhom.models.dense_tensor import DenseTensor
from jaxhom.models.successor_lists import SuccessorLists

TRANSITION = small_models.restart()[0]
S, A = TRANSITION.shape[:2]


def dense():
    states = np.broadcast_to(np.arange(S, dtype=np.int32), TRANSITION.shape)
    return DenseTensor(next_state=jnp.asarray(states), probability=jnp.asarray(TRANSITION))


def lists():
    next_state, probability, _ = lists_of_tensor(TRANSITION, None)
    return SuccessorLists.from_host(next_state, probability, np.float64)


@pytest.fixture(params=[dense, lists], ids=["dense", "lists"])
def dynamics(request):
    return request.param()


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("batch", [(), (1,), (4,)])
def test_one_step_maps(dynamics, batch, rng):
    value, x = rng.normal(size=(S, *batch)), rng.normal(size=(S, A, *batch))
    backward = np.tensordot(TRANSITION, value, axes=1)

    @jax.jit
    def maps(dynamics, value, x):
        each = jnp.stack(dynamics.expected_next_values(value), axis=1)
        return dynamics.expected_next_value(value), each, dynamics.push_forward(x), dynamics.transition

    at_once, each, forward, transition = maps(dynamics, value, x)
    close(at_once, backward)
    close(each, backward)
    close(forward, np.tensordot(TRANSITION, x, axes=((0, 1), (0, 1))))
    close(transition, TRANSITION)


@pytest.mark.parametrize("batch", [(), (1,), (4,)])
def test_chains_of_policies(dynamics, batch, rng):
    policy = np.moveaxis([small_models.random_policy(rng, S, A) for _ in range(batch[0] if batch else 1)], 0, -1)
    value = rng.normal(size=(S, *batch))
    matrices = np.einsum("sab,saz->bsz", policy, TRANSITION)
    columns = value if batch else value[:, None]
    backward = np.stack([matrix @ column for matrix, column in zip(matrices, columns.T, strict=True)], axis=-1)
    forward = np.stack([column @ matrix for matrix, column in zip(matrices, columns.T, strict=True)], axis=-1)

    @jax.jit
    def maps(dynamics, policy, first, value):
        chain = dynamics.chain(policy)
        return chain.expected_next_value(value), chain.push_forward(value), dynamics.state_transition(first)

    found = maps(dynamics, policy if batch else policy[..., 0], policy[..., 0], value)
    jax.tree.map(close, found, (backward.reshape(value.shape), forward.reshape(value.shape), matrices[0]))


def test_what_the_host_asks(dynamics, rng):
    matrix = dynamics.host_matrix(np.asarray(dynamics.probability))
    close(matrix.toarray() if hasattr(matrix, "toarray") else matrix, TRANSITION.reshape(S * A, S))
    state, action, successor = rng.integers(0, [S, A, S], size=(500, 3)).T
    certain = np.argwhere(TRANSITION > 0)[::7].T
    triples = [np.concatenate(pair) for pair in zip((state, action, successor), certain, strict=True)]
    np.testing.assert_array_equal(dynamics.leads(*triples), TRANSITION[tuple(triples)] > 0)
    is_dense = isinstance(dynamics, DenseTensor)
    open_slots = dynamics.open_slots()
    assert open_slots.shape == dynamics.probability.shape
    assert open_slots.all() if is_dense else (open_slots == (np.asarray(dynamics.probability) > 0)).all()


def test_chains_of_all_actions_where_they_pay(rng):
    """A gridworld's moves share their successors; a dense model saves nothing."""
    mdp, value = gridworld(5).mdp, rng.normal(size=25)
    assert dense().action_chains() is None
    chains = mdp.dynamics.action_chains()
    close(jnp.stack(chains.expected_next_values(value), axis=1), np.asarray(mdp.transition) @ value)
