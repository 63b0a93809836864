"""Flows by steps of moving mass, against dense solves in NumPy."""

import numpy as np
import pytest
import scipy
import small_models

import jaxhom
from jaxhom.planning import host_chains
from jaxhom.planning.host_chains import host_model
from jaxhom.planning.moving_mass import flow_of_moving_mass


def corridor(length, rng):
    """P of a walk to the right that stays, goes on or falls back by chances of its own."""
    chance = rng.dirichlet([5.0, 1.0, 0.5], length)
    at, ends = np.arange(length), length - 1
    successors = np.stack([np.minimum(at + 1, ends), at, np.maximum(at - 2, 0)], axis=1)
    entries = (chance.ravel(), (np.repeat(at, 3), successors.ravel()))
    return scipy.sparse.csr_array(entries, shape=(length, length))


@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99, 0.999])
@pytest.mark.parametrize("error", [1e-3, 1e-10])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_flows(discount, error, sign, rng):
    transition = corridor(700, rng)
    source = np.zeros(700)
    source[[3, 200]] = 0.7, sign * 0.3
    exact = np.linalg.solve(np.eye(700) - discount * transition.toarray().T, source)
    found = flow_of_moving_mass(transition, discount, source, error, 700)
    assert np.abs(found - exact).sum() <= error / (1.0 - discount)


def test_no_source():
    assert not flow_of_moving_mass(corridor(9, np.random.default_rng(0)), 0.9, np.zeros(9), 1e-9, 9).any()


def test_mass_that_spreads_is_left_to_others(rng):
    """Windows that are too large; and what remains of them does no harm to the next."""
    transition = corridor(700, rng)
    source = np.arange(700) == 3
    assert flow_of_moving_mass(transition, 0.9, source.astype(float), 1e-9, 5) is None
    case = small_models.case("restart")
    chain = host_model(case.mdp).chain(small_models.random_policy(rng, *case.shape))
    assert np.isnan(chain.moved(np.asarray(case.mdp.initial), 1e-9)).all()


def test_reports_come_down(rng):
    seen = []
    transition, source = corridor(300, rng), (np.arange(300) == 0).astype(float)
    flow_of_moving_mass(transition, 0.9, source, 1e-6, 300, lambda *pair: seen.append(pair))
    sizes, allowed = np.array(seen).T
    assert len(seen) > 2 and (np.diff(sizes) < 0).all() and (sizes > allowed).all() and sizes[0] == 1.0


@pytest.mark.parametrize("solvable", [True, False])
def test_occupancies_of_large_models(monkeypatch, capsys, solvable):
    """By moving mass, with a bar; other solvers are not asked."""
    grid = jaxhom.gridworld(40, num_regions=4)
    policy = jaxhom.optimal_policy(grid.mdp, np.asarray(grid.mdp.features) @ [0.1, 0.2, 0.3, 1.0]).policy
    start = grid.mdp.replace(initial=np.arange(1600) == 0, discount=0.9)
    plain = jaxhom.occupancy(start, policy)
    monkeypatch.setattr(host_chains, "_MANY_STATES", 1000)
    monkeypatch.setattr(host_chains, "_WINDOW", 1.0)
    monkeypatch.setattr(host_chains.HostModel, "is_solvable", solvable)
    moved = []
    original = host_chains.HostChain.moved
    monkeypatch.setattr(host_chains.HostChain, "moved", lambda *args: moved.append(0) or original(*args))
    monkeypatch.setattr(host_chains.HostChain, "_checked", None)
    np.testing.assert_allclose(jaxhom.occupancy(start, policy, progress=True), plain, atol=1e-9)
    assert moved and "residual" in capsys.readouterr().err
    twice = jaxhom.feature_expectations(start, np.stack([policy, policy]))
    np.testing.assert_allclose(twice, [np.asarray(plain).reshape(-1) @ np.asarray(start.features).reshape(-1, 4)] * 2)
    assert len(moved) == 3
    assert capsys.readouterr().err == ""


def test_wide_starts_and_values_are_swept(monkeypatch, capsys):
    """Where mass is everywhere from the start, and for values: Krylov's steps, then sweeps, with a bar."""
    length = 2000
    step = np.minimum(np.arange(length) + 1, length - 1)
    mdp = jaxhom.MDP.from_successors(step[:, None, None], np.ones((length, 1, 1)), discount=0.9)
    policy, reward = np.ones((length, 1)), np.linspace(0.0, 1.0, length)[:, None]
    value, mu = jaxhom.policy_value(mdp, policy, reward), jaxhom.occupancy(mdp, policy)
    monkeypatch.setattr(host_chains, "_MANY_STATES", 1000)
    monkeypatch.setattr(host_chains.HostModel, "is_solvable", False)
    monkeypatch.setattr(host_chains.HostModel, "is_soon_factorised", False)
    monkeypatch.setattr(host_chains.HostChain, "_iterate", lambda self, right, *rest: np.full_like(right, np.nan))
    monkeypatch.setattr(jaxhom.planning.occupancy, "_state_occupancy", None)  # the device is not asked
    monkeypatch.setattr(jaxhom.planning.occupancy, "_solve_values", None)
    np.testing.assert_allclose(jaxhom.policy_value(mdp, policy, reward, progress=True), value, rtol=1e-9)
    np.testing.assert_allclose(jaxhom.occupancy(mdp, policy, progress=True), mu, atol=1e-9)
    assert "residual" in capsys.readouterr().err
