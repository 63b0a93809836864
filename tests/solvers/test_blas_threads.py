"""One thread of BLAS within, as many as before afterwards."""

import numpy as np
import pytest
import scipy
import threadpoolctl

import jaxhom
from jaxhom.solvers.blas_threads import one_blas_thread


def threads():
    return [library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]


@pytest.fixture(autouse=True)
def _two():
    with threadpoolctl.threadpool_limits(limits=2, user_api="blas"):
        yield


def test_within_and_after():
    with one_blas_thread():
        assert set(threads()) == {1}
        with one_blas_thread():
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert set(threads()) == {2}


def test_after_an_error():
    with pytest.raises(KeyError), one_blas_thread():
        raise KeyError
    assert set(threads()) == {2}


@pytest.mark.parametrize("name", ["mwal", "projection", "max_causal_entropy", "inverse_lp"])
def test_learners_that_solve_many_small_systems(name, monkeypatch, rng):
    """Where other processes keep the cores busy, threads that wait for each other take twenty times as long."""
    seen, factor = [], scipy.linalg.lu_factor

    def counted(*args, **options):
        seen.extend(threads())
        return factor(*args, **options)

    monkeypatch.setattr("scipy.linalg.lu_factor", counted)
    transition = rng.dirichlet(np.ones(30), (30, 2))
    mdp = jaxhom.MDP.from_dense(transition, discount=0.9, features=rng.random((30, 2, 2)))
    given = {
        "max_causal_entropy": jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [0, 1, 1])]),
        "inverse_lp": np.zeros(30, int),
    }.get(name, [5.0, 5.0])
    getattr(jaxhom, name)(mdp, given, max_iterations=3)
    assert set(seen) == {1} and set(threads()) == {2}
