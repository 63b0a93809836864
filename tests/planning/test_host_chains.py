"""Chains on the host: factors of bands against SuperLU's and dense solves; policy iteration against its oracle."""

import numpy as np
import oracles
import pytest
import small_models

from jaxhom.domains.gridworld import gridworld
from jaxhom.models.mdp import MDP
from jaxhom.planning import host_chains, policy_iteration
from jaxhom.planning.host_chains import HostModel

BANDS = pytest.mark.parametrize("band_work", [0.0, np.inf], ids=["SuperLU", "band"])


def ring(num_states=60, discount=0.99999):
    """One way round with a step back now and then, and a pair of states that nobody comes to."""
    state = np.arange(num_states - 2)
    ahead, back = (state + 1) % len(state), (state - 1) % len(state)
    apart = [[num_states - 1, 0], [num_states - 2, 0]]
    next_state = np.concatenate([np.stack([ahead, back], axis=1), apart])[:, None]
    probability = np.array([[0.9, 0.1]] * len(state) + [[1.0, 0.0], [0.5, 0.5]])[:, None]
    return MDP.from_successors(next_state, probability, discount=discount, initial=np.eye(num_states)[0])


MODELS = {
    "sparse": lambda: small_models.case("sparse").mdp,
    "restart": lambda: small_models.case("restart").mdp,
    "absorbing": lambda: small_models.case("absorbing").mdp,
    "grid": lambda: gridworld(9).mdp,
    "ring": ring,
}


@BANDS
@pytest.mark.parametrize("name", MODELS)
def test_factors_against_dense_solves(name, band_work, monkeypatch, rng):
    monkeypatch.setattr(host_chains, "_BAND_WORK", band_work)
    mdp = MODELS[name]()
    model = HostModel(mdp)
    policy = rng.dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    transition = np.einsum("sa,saz->sz", policy, np.asarray(mdp.transition))
    system, right = np.eye(mdp.num_states) - float(mdp.discount) * transition, rng.normal(size=(mdp.num_states, 3))
    chain = model.chain(policy)
    for kind, matrix in ((chain.value, system), (chain.flow, system.T)):
        expected = np.linalg.solve(matrix, right)
        np.testing.assert_allclose(kind(right), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        np.testing.assert_allclose(kind(right[:, 0]), expected[:, 0], rtol=0, atol=1e-9 * np.abs(expected).max())


@BANDS
def test_what_nobody_comes_to_has_no_occupancy_at_all(band_work, monkeypatch):
    monkeypatch.setattr(host_chains, "_BAND_WORK", band_work)
    mdp = ring()
    occupancy = HostModel(mdp).chain(np.zeros(60, int)).state_occupancy(np.asarray(mdp.initial))
    assert (occupancy[-2:] == 0).all() and (occupancy[:-2] > 0).all()
    np.testing.assert_allclose(occupancy.sum(), 1e5, rtol=1e-9)


def test_a_model_without_links_is_a_band_of_its_diagonal():
    stay = MDP.from_successors(np.arange(5)[:, None, None], np.ones((5, 1, 1)), discount=0.9)
    np.testing.assert_allclose(HostModel(stay).chain(np.zeros(5, int)).value(np.arange(5.0)), 10.0 * np.arange(5))


@BANDS
@pytest.mark.parametrize("name", ["sparse", "grid", "ring"])
def test_policy_iteration_ends_at_the_optimum(name, band_work, monkeypatch, rng):
    monkeypatch.setattr(host_chains, "_BAND_WORK", band_work)
    mdp = MODELS[name]()
    reward = rng.normal(size=(mdp.num_states, mdp.num_actions))
    found = policy_iteration.iterate(HostModel(mdp), reward, np.zeros(mdp.num_states, int), np.finfo(float).eps)
    value, _ = oracles.optimal_value(np.asarray(mdp.transition), float(mdp.discount), reward)
    np.testing.assert_allclose(found.value, value, rtol=1e-9)


def test_sweeps_save_solves(rng):
    """News travel by sweeps: 11 policies are tried without them."""
    mdp = gridworld(24).mdp
    reward = np.broadcast_to(rng.uniform(size=(24 * 24, 1)), (24 * 24, 4))
    found = policy_iteration.iterate(HostModel(mdp), reward, np.zeros(24 * 24, int), np.finfo(float).eps)
    assert found.is_settled and found.iterations <= 7
