"""Small work does not compile: what the host does in milliseconds starts no program, and finds what programs find."""

import contextlib

import jax
import numpy as np
import pytest

import jaxhom
from jaxhom import programs
from jaxhom.models.mdp import MDP

STATES, ACTIONS, FEATURES = 23, 3, 5  # shapes that no other test has: nothing is compiled for them yet
WALKS = [([0, 2, 5], [1, 1, 0]), ([4, 7], [2, 0])]


@contextlib.contextmanager
def compilations():
    """A list that grows by a name with every program that XLA compiles."""
    names = []

    def count(event, _, **details):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(details.get("fun_name", "a program"))

    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(count)


def model(dtype=np.float64, *, is_sparse=True, restricts=False):
    """A random model; sparse ones lead from s to some of s + 1 ... s + 4."""
    rng = np.random.default_rng(3)
    transition = rng.dirichlet(np.full(STATES, 0.3), (STATES, ACTIONS))
    if is_sparse:
        ahead = (np.arange(STATES)[None] - np.arange(STATES)[:, None]) % STATES
        transition = np.where(((ahead > 0) & (ahead < 5))[:, None], transition + 0.01, 0.0)
        transition /= transition.sum(axis=-1, keepdims=True)
    allowed = rng.random((STATES, ACTIONS)) < 0.7 if restricts else None
    if restricts:
        allowed[:, 0] = True
        for states, actions in WALKS:
            allowed[states, actions] = True
    features = rng.random((STATES, ACTIONS, FEATURES))
    return MDP.from_dense(transition.astype(dtype), discount=0.9, features=features.astype(dtype), allowed=allowed)


DEMONSTRATIONS = jaxhom.Demonstrations.from_trajectories(WALKS)
STEPS = {
    "optimal_policy": lambda mdp, policy: jaxhom.optimal_policy(mdp, np.asarray(mdp.features)[..., 0]),
    "occupancy": jaxhom.occupancy,
    "feature_expectations": jaxhom.feature_expectations,
    "policy_value": lambda mdp, policy: jaxhom.policy_value(mdp, policy, np.asarray(mdp.features)[..., 1]),
    "empirical_policy": lambda mdp, policy: jaxhom.empirical_policy(mdp, DEMONSTRATIONS),
    "uniform_elsewhere": lambda mdp, policy: jaxhom.uniform_elsewhere(mdp, DEMONSTRATIONS),
    "nearest_neighbors": lambda mdp, policy: jaxhom.nearest_neighbors(mdp, DEMONSTRATIONS),
    "soft_local_homomorphism": lambda mdp, policy: jaxhom.soft_local_homomorphism(mdp, DEMONSTRATIONS),
    "soft_homomorphism": lambda mdp, policy: jaxhom.soft_homomorphism(mdp, DEMONSTRATIONS, tolerance=1e-2),
    "soft_homomorphism, labels": lambda mdp, policy: jaxhom.soft_homomorphism(
        mdp, DEMONSTRATIONS, labels=np.asarray(mdp.features), tolerance=1e-2
    ),
    "soft_homomorphism, two models": lambda mdp, policy: jaxhom.soft_homomorphism(mdp, mdp, tolerance=1e-2).pull_back(
        policy
    ),
    "disjoint_union": lambda mdp, policy: jaxhom.disjoint_union([mdp, mdp]).place(1, DEMONSTRATIONS).states,
    "local_similarity": lambda mdp, policy: jaxhom.local_similarity(mdp, [0, 1], [2, 3]),
    "local_similarity, labels": lambda mdp, policy: jaxhom.local_similarity(
        mdp, [0, 1], [2, 3], labels=np.asarray(mdp.features)
    ),
    "isomorphic": lambda mdp, policy: jaxhom.soft_local_homomorphism(
        mdp, DEMONSTRATIONS, relation="isomorphic", voters=2
    ),
    "walks, weighted": lambda mdp, policy: jaxhom.soft_local_homomorphism(
        mdp, DEMONSTRATIONS, relation="random_walk", voters="all", weights="similarity", threshold=0.5
    ),
    "choose_generalization": lambda mdp, policy: jaxhom.choose_generalization(
        mdp, DEMONSTRATIONS, {"plain": {}, "walks": {"relation": "random_walk"}, "k-NN": jaxhom.nearest_neighbors}
    ),
    "soft_optimal_policy": lambda mdp, policy: jaxhom.soft_optimal_policy(mdp, np.asarray(mdp.features)[..., 0]),
    "max_causal_entropy": lambda mdp, policy: jaxhom.max_causal_entropy(mdp, DEMONSTRATIONS),
    "max_causal_entropy, expectations": lambda mdp, policy: jaxhom.max_causal_entropy(
        mdp, expectations=np.full(FEATURES, 3.0)
    ),
    "query_states": lambda mdp, policy: jaxhom.query_states(mdp, DEMONSTRATIONS, policy, 4),
    "query_states by visits": lambda mdp, policy: jaxhom.query_states(
        mdp, DEMONSTRATIONS, policy, 4, criterion="visits"
    ),
    "query_states by bound": lambda mdp, policy: jaxhom.query_states(mdp, DEMONSTRATIONS, policy, 4, criterion="bound"),
    "with_answers": lambda mdp, policy: DEMONSTRATIONS.with_answers([1, 1], [0, 2]).states,
    "lpal": lambda mdp, policy: jaxhom.lpal(mdp, np.full(FEATURES, 3.0), initial_policy=policy),
    "loss_bound": lambda mdp, policy: jaxhom.loss_bound(mdp, DEMONSTRATIONS, policy),
    "loss_bound, weights": lambda mdp, policy: jaxhom.loss_bound(
        mdp, DEMONSTRATIONS, policy, weights=np.ones(FEATURES)
    ),
    "loss_bound, a batch": lambda mdp, policy: jaxhom.loss_bound(mdp, DEMONSTRATIONS, np.stack([policy, policy])),
    "loss_bound, first steps": lambda mdp, policy: jaxhom.loss_bound(mdp, DEMONSTRATIONS, policy, horizon=7),
    "robust_policy": lambda mdp, policy: jaxhom.robust_policy(mdp, DEMONSTRATIONS),
    "lpal of two": lambda mdp, policy: jaxhom.lpal(mdp, np.array([3.0, 4.0])[:, None] + np.zeros(FEATURES)),
    "projection": lambda mdp, policy: jaxhom.projection(mdp, np.full(FEATURES, 3.0)),
    "projection, margin": lambda mdp, policy: jaxhom.projection(mdp, np.full((2, FEATURES), 4.0), method="max_margin"),
    "mwal": lambda mdp, policy: jaxhom.mwal(mdp, np.full(FEATURES, 3.0), max_iterations=20),
    "inverse_lp": lambda mdp, policy: jaxhom.inverse_lp(mdp, np.asarray(mdp.allowed).argmax(axis=1)),
}
MODELS = {
    "sparse": {},
    "dense": {"is_sparse": False},
    "float32": {"dtype": np.float32},
    "missing actions": {"restricts": True},
}


@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")
@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("step", STEPS)
def test_a_first_call_compiles_nothing(step, kind):
    mdp = model(**MODELS[kind])
    allowed = np.asarray(mdp.allowed, float)
    policy = allowed / allowed.sum(axis=1, keepdims=True)
    with compilations() as names:
        jax.block_until_ready(STEPS[step](mdp, policy))
    assert names == []


def test_compilations_are_counted():
    with compilations() as names:
        jax.block_until_ready(jax.jit(lambda x: x + STATES)(np.ones(STATES)))
    assert len(names) == 1


@pytest.mark.parametrize("kind", ["sparse", "dense", "float32"])
@pytest.mark.parametrize("anchored", [True, False])
def test_the_global_program_on_the_host_and_in_a_program(kind, anchored, monkeypatch):
    """The same iterations, up to rounding, so the same bounds."""
    mdp, found = model(**MODELS[kind]), []
    for pays in (False, True):
        monkeypatch.setattr(programs, "pays", lambda seconds, pays=pays: pays)
        found.append(jaxhom.soft_homomorphism(mdp, DEMONSTRATIONS, anchored=anchored, tolerance=1e-2))
    host, program = found
    digits = 1e-9 if mdp.dtype == np.float64 else 5e-3
    np.testing.assert_allclose(host.error_upper, program.error_upper, rtol=0, atol=digits)
    np.testing.assert_allclose(host.error_lower, program.error_lower, rtol=0, atol=digits)
    assert host.policy.dtype == program.policy.dtype == mdp.dtype
    assert host.status == program.status == jaxhom.Status.SOLVED


def test_a_dozen_lanes_on_a_small_grid_compile_nothing(rng):
    mdp = jaxhom.gridworld(10, num_regions=25, discount=0.95).mdp
    expectations = rng.uniform(0.0, 1.0, (13, 25))
    with compilations() as names:
        solution = jaxhom.lpal(mdp, expectations)
    assert not names
    assert np.all(solution.status == jaxhom.Status.SOLVED)
    for lane in (0, 12):
        exact = jaxhom.lpal(mdp, expectations[lane], method="columns")
        assert solution.margin[lane] <= exact.margin_bound and exact.margin <= solution.margin_bound[lane]
