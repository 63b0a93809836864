"""Soft homomorphisms between two models: bounds against HiGHS, copies, lumpings, and policies that are carried over."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, SoftHomomorphism, Status, programs, soft_homomorphism


def model(seed, states, actions=2, *, restricts=False, dtype=np.float64, successors=2):
    rng = np.random.default_rng(seed)
    transition = oracles.random_mdp(rng, states, actions, N=min(successors, states))[0].astype(dtype)
    allowed = rng.uniform(size=(states, actions)) < 0.7
    allowed[np.arange(states), rng.integers(actions, size=states)] = True
    return MDP.from_dense(transition, discount=0.9, allowed=allowed if restricts else None)


def labels_for(seed, mdp, count, scale=1.0, shift=0.0):
    labels = np.random.default_rng(seed).uniform(size=(mdp.num_states, mdp.num_actions, count))
    return (shift + scale * labels).astype(mdp.dtype)


def error_of(source, target, labels=None):
    """HiGHS's, with one more state in either model that refused actions lead to."""
    models, restricts = [], source.restricts_actions or target.restricts_actions
    for mdp in (source, target):
        transition, states = np.asarray(mdp.transition, float), mdp.num_states
        if restricts:
            wider = np.zeros((states + 1, mdp.num_actions, states + 1))
            wider[:states, :, :states], wider[:states, :, states] = transition, ~np.asarray(mdp.allowed)
            wider[states, :, states] = 1
            transition = wider
        models.append(transition)
    if labels is not None:
        labels = [np.pad(one.astype(float), ((0, int(restricts)), (0, 0), (0, 0))) for one in labels]
    return oracles.homomorphism_lp(*models, anchored=False, labels=labels, refused=restricts)[0]


PAIRS = {
    "no labels": ((1, 7, 2), (2, 4, 2), {}, {}, None),
    "to more states": ((3, 3, 2), (4, 6, 2), {}, {}, None),
    "to one state": ((5, 6, 3), (6, 1, 3), {}, {}, (1, 1.0, 0.0)),
    "from one state": ((7, 1, 2), (8, 5, 2), {}, {}, (2, 1.0, 0.0)),
    "labels": ((9, 6, 3), (10, 5, 3), {}, {}, (2, 1.0, 0.0)),
    "labels far from 0": ((11, 6, 2), (12, 4, 2), {}, {}, (1, 10.0, 1e3)),
    "refused": ((13, 7, 3), (14, 5, 3), {"restricts": True}, {"restricts": True}, None),
    "refused in the source": ((15, 6, 2), (16, 4, 2), {"restricts": True}, {}, None),
    "refused in the target": ((17, 5, 2), (18, 4, 2), {}, {"restricts": True}, None),
    "refused, labels": ((19, 6, 3), (20, 4, 3), {"restricts": True}, {"restricts": True}, (2, 0.2, 0.0)),
    "lists": ((21, 20, 2), (22, 16, 2), {}, {}, (1, 0.5, 0.0)),
    "float32": ((23, 8, 2), (24, 5, 2), {"dtype": np.float32}, {"dtype": np.float32}, (1, 5.0, 100.0)),
}
TOLERANCES = {"float32": 5e-3, "lists": 1e-2}


@functools.cache
def pair(name):
    (seed, n, actions), (other, m, _), here, there, labelling = PAIRS[name]
    source, target = model(seed, n, actions, **here), model(other, m, actions, **there)
    assert (source.is_dense, target.is_dense) == (name != "lists",) * 2
    if labelling is None:
        return source, target, {}
    count, scale, shift = labelling
    labels, target_labels = (labels_for(s, mdp, count, scale, shift) for s, mdp in ((seed, source), (other, target)))
    return source, target, {"labels": labels, "target_labels": target_labels}


@functools.cache
def error_of_pair(name):
    source, target, labels = pair(name)
    return error_of(source, target, tuple(labels.values()) or None)


def residual(found, labels):
    """What the map itself misses by, labels included."""
    f, T, U = (np.asarray(array, float) for array in (found.map, found.source.transition, found.target.transition))
    error = oracles.homomorphism_residual(T, U, f)
    for here, there in [tuple(labels.values())] if labels else []:
        error = max(error, np.abs(here - np.einsum("sk,kai->sai", f, there.astype(float))).max())
    refused = [1.0 - np.asarray(mdp.allowed) for mdp in (found.source, found.target)]
    return max(error, np.abs(refused[0] - f @ refused[1]).max())


def assert_certified(found, name, tolerance):
    source, target, labels = pair(name)
    error = error_of_pair(name)
    rounding = 1e-9
    assert isinstance(found, SoftHomomorphism) and found.map.shape == (source.num_states, target.num_states)
    assert found.map.dtype == found.error_lower.dtype == source.dtype
    assert found.error_lower - rounding <= error <= found.error_upper + rounding
    assert found.error_upper - found.error_lower <= tolerance
    assert Status(int(found.status)) == Status.SOLVED
    np.testing.assert_allclose(found.map.sum(axis=1), 1.0, rtol=1e-5)
    assert np.all(np.asarray(found.map) >= 0)
    assert error - 1e-4 <= residual(found, labels) <= found.error_upper + 1e-6


@pytest.mark.parametrize("name", PAIRS)
def test_against_highs(name, monkeypatch):
    """On the host, and in the program that the host calls where that pays."""
    source, target, labels = pair(name)
    tolerance = TOLERANCES.get(name, 1e-3)
    assert_certified(soft_homomorphism(source, target, tolerance=tolerance, **labels), name, tolerance)
    monkeypatch.setattr(programs, "pays", lambda seconds: True)
    assert_certified(soft_homomorphism(source, target, tolerance=tolerance, **labels), name, tolerance)


@pytest.mark.parametrize(
    ("name", "traced"),
    [
        ("labels", ("models", "source", "target", "weight")),
        ("no labels", ("target",)),
        ("refused, labels", ("models", "weight")),
        ("lists", ("source", "target")),
        ("float32", ("models",)),
    ],
)
def test_inside_programs(name, traced):
    """Whatever is traced: both models, the source, the target or the labels alone."""
    source, target, labels = pair(name)
    tolerance = TOLERANCES.get(name, 1e-3)
    solve = functools.partial(soft_homomorphism, tolerance=tolerance)
    programs_of = {
        "models": lambda: jax.jit(lambda one, other, labels: solve(one, other, **labels))(source, target, labels),
        "source": lambda: jax.jit(lambda one: solve(one, target, **labels))(source),
        "target": lambda: jax.jit(lambda other: solve(source, other, **labels))(target),
        "weight": lambda: jax.jit(lambda weight: solve(source, target, label_weight=weight, **labels))(1.0),
    }
    for what in traced:
        assert_certified(programs_of[what](), name, tolerance)


def test_stacked_sources_and_targets():
    sources = [model(seed, 6, restricts=True) for seed in (30, 31, 32)]
    targets = [model(seed, 4, restricts=True) for seed in (33, 34, 35)]
    stacks = jaxhom.stack_models(sources), jaxhom.stack_models(targets)
    found = jax.jit(jax.vmap(functools.partial(soft_homomorphism, tolerance=1e-3)))(*stacks)
    for lane, (source, target) in enumerate(zip(sources, targets, strict=True)):
        error = error_of(source, target)
        assert found.error_lower[lane] - 1e-9 <= error <= found.error_upper[lane] + 1e-9
        one = jax.tree.map(lambda leaf, lane=lane: leaf[lane], found)
        policy = one.pull_back(np.full((4, 2), 0.5) * np.asarray(target.allowed) + 0.5 * uniform_gap(target))
        np.testing.assert_allclose(policy.sum(axis=1), 1.0)


def uniform_gap(mdp):
    """What a row of halves lacks where one of two actions is refused."""
    allowed = np.asarray(mdp.allowed, float)
    return allowed * (allowed.sum(axis=1, keepdims=True) == 1)


# ------------------------------------------------------------------------------------- error 0


@pytest.mark.parametrize("restricts", [False, True])
def test_a_copy_with_labels_is_found(restricts):
    """The same model in another order, with labels that tell states apart: the map is that order."""
    source, rng = model(40, 8, restricts=restricts), np.random.default_rng(0)
    order, labels = rng.permutation(8), labels_for(41, source, 2)
    transition, allowed = np.asarray(source.transition), np.asarray(source.allowed)
    target = MDP.from_dense(transition[order][:, :, order], discount=0.9, allowed=allowed[order])
    found = soft_homomorphism(source, target, labels=labels, target_labels=labels[order], tolerance=1e-7)
    assert found.error_lower == 0 and found.error_upper <= 1e-7
    np.testing.assert_allclose(found.map, np.eye(8)[order].T, rtol=0, atol=1e-4)
    policy = rng.dirichlet(np.ones(2), size=8) * allowed
    policy /= policy.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(found.pull_back(policy[order]), policy, rtol=0, atol=1e-4)


def test_identity():
    mdp = jaxhom.gridworld(4)
    found = soft_homomorphism(mdp, mdp, labels=np.eye(16), target_labels=np.eye(16))
    assert found.error_upper <= 1e-3
    np.testing.assert_allclose(found.map, np.eye(16), rtol=0, atol=1e-3)


def lumping(rng, blocks=4, size=3):
    """A model in which `size` states behave alike, and the one of their blocks, with rewards."""
    coarse = oracles.random_mdp(rng, blocks, 2, N=2)[0]
    block = np.repeat(np.arange(blocks), size)
    share = rng.dirichlet(np.ones(size), size=(blocks * size, 2, blocks))
    fine = (coarse[block][..., None] * share).reshape(blocks * size, 2, -1)
    reward = rng.uniform(size=(blocks, 2))
    source, target = (MDP.from_dense(transition, discount=0.9) for transition in (fine, coarse))
    return source, target, reward[block], reward, block


def test_lumping_keeps_transitions_rewards_and_values():
    """Rewards that differ between blocks say where each state goes."""
    source, target, fine_reward, reward, block = lumping(np.random.default_rng(2))
    found = soft_homomorphism(source, target, labels=fine_reward, target_labels=reward, tolerance=1e-6)
    assert found.error_lower == 0 and found.error_upper <= 1e-6
    assert (
        oracles.homomorphism_residual(
            np.asarray(source.transition), np.asarray(target.transition), np.asarray(found.map)
        )
        <= 1e-6
    )
    plan = jaxhom.optimal_policy(target, reward)
    carried = jaxhom.policy_value(source, found.pull_back(plan), fine_reward)
    np.testing.assert_allclose(carried, np.asarray(plan.value)[block], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.map @ plan.value, np.asarray(plan.value)[block], rtol=0, atol=1e-3)


# ------------------------------------------------------------------------------------- policies


def test_policies_are_averaged_over_what_is_allowed():
    """By hand: state 0 lacks action 1; nothing is left in state 1, which lacks what its image does."""
    stay = np.broadcast_to(np.eye(2)[:, None], (2, 3, 2))
    source = MDP.from_dense(stay, discount=0.9, allowed=[[True, False, True], [True, True, False]])
    target = MDP.from_dense(stay, discount=0.9)
    found = soft_homomorphism(source, target, max_iterations=16)
    found = found.replace(map=jnp.array([[0.5, 0.5], [0.0, 1.0]]))
    policy = np.array([[0.25, 0.5, 0.25], [0.0, 0.0, 1.0]])
    expected = [[0.125 / 0.75, 0.0, 0.625 / 0.75], [0.5, 0.5, 0.0]]
    np.testing.assert_allclose(found.pull_back(policy), expected)
    np.testing.assert_allclose(jax.jit(lambda found, policy: found.pull_back(policy))(found, policy), expected)
    np.testing.assert_allclose(found.pull_back([0, 2]), [[0.5, 0.0, 0.5], [0.5, 0.5, 0.0]])
    slope = jax.grad(lambda policy: found.pull_back(policy)[0, 0])(jnp.asarray(policy))
    np.testing.assert_allclose(slope[0, 0], 0.5 / 0.75 - 0.125 * 0.5 / 0.75**2)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (np.full((3, 2), 0.5), r"policy must have shape \(4, 2\), got \(3, 2\)"),
        (np.full((4, 2), 0.4), r"sum of policy\[0\] must be 1"),
        ([0, 1, 2, 0], r"policy\[2\] must be below 2"),
    ],
)
def test_what_is_no_policy_of_the_target_is_refused(policy, message):
    source, target, _ = pair("no labels")
    with pytest.raises(ValueError, match=message):
        soft_homomorphism(source, target, max_iterations=16).pull_back(policy)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
        ({"max_iterations": 1.5}, "max_iterations must be a whole number"),
        ({"tolerance": "1e-3"}, "tolerance must be a number"),
        ({"tolerance": -1.0}, "tolerance must be positive"),
    ],
)
def test_how_long_to_look_is_checked(options, message):
    source, target, _ = pair("no labels")
    with pytest.raises(ValueError, match=message):
        soft_homomorphism(source, target, **options)


# ------------------------------------------------------------------------------------- what does not fit


def refused():
    source, target, labels = pair("labels")
    here, there = labels.values()
    return {
        "actions": (lambda: soft_homomorphism(source, model(0, 4)), "the target has num_actions 2, the source 3"),
        "type": (
            lambda: soft_homomorphism(model(0, 4), model(0, 4, dtype=np.float32)),
            "the target has dtype float32, the source float64",
        ),
        "one side": (lambda: soft_homomorphism(source, target, labels=here), "must be given together"),
        "other side": (lambda: soft_homomorphism(source, target, target_labels=there), "must be given together"),
        "number of labels": (
            lambda: soft_homomorphism(source, target, labels=here, target_labels=there[..., :1]),
            r"target_labels must have shape \(5, 3, 2\), as many labels as the source, got \(5, 3, 1\)",
        ),
        "states of labels": (
            lambda: soft_homomorphism(source, target, labels=there, target_labels=here),
            r"labels must have shape \(6, 3, L\) or \(6, L\), got \(5, 3, 2\)",
        ),
        "not finite": (
            lambda: soft_homomorphism(source, target, labels=here, target_labels=there * np.inf),
            r"target_labels\[0, 0, 0\] must be finite",
        ),
        "traced tolerance": (
            lambda: jax.jit(lambda tolerance: soft_homomorphism(source, target, tolerance=tolerance))(1e-2),
            "tolerance is a traced value",
        ),
    }


@pytest.mark.parametrize("name", refused())
def test_pairs_that_do_not_fit_are_refused(name):
    call, message = refused()[name]
    with pytest.raises(ValueError, match=message):
        call()
