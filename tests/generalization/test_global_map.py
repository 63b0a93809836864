"""Labels in LP (8): bounds against HiGHS, on the host and in programs; what changes nothing; and what is refused."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, Demonstrations, Status, programs, soft_homomorphism
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem, HostProblem, centred, restricted_to_list
from jaxhom.similarity.local_models import restricted_model

STATES, ACTIONS = 12, 2
SHOWN = [([0, 3, 5], [0, 1, 1]), ([7, 3], [1, 0])]
EXPERTS = [0, 3, 5, 7]
VISITED = np.isin(np.arange(STATES), EXPERTS)


def transition(dtype=np.float64):
    return oracles.random_mdp(np.random.default_rng(3), STATES, ACTIONS, N=3)[0].astype(dtype)


@functools.cache
def model(dtype=np.float64, restricts=False):
    allowed = np.random.default_rng(4).uniform(size=(STATES, ACTIONS)) < 0.7
    for states, actions in SHOWN:
        allowed[states, actions] = True
    allowed[~allowed.any(axis=1)] = True
    return MDP.from_dense(transition(dtype), discount=0.9, allowed=allowed if restricts else None)


def shown():
    return Demonstrations.from_trajectories(SHOWN)


def labels_of(kind):
    rng = np.random.default_rng(7)
    return {
        "of states": 2 * rng.uniform(size=(STATES, 3)),
        "of pairs": rng.uniform(size=(STATES, ACTIONS, 3)),
        "large, far from 0": 1e4 + 30 * rng.uniform(size=(STATES, ACTIONS, 1)),
        "numbers": np.arange(STATES)[:, None],
        "one hot": np.eye(STATES),
    }[kind]


def by_pair(labels):
    return labels if labels.ndim == 3 else np.broadcast_to(labels[:, None], (STATES, ACTIONS, labels.shape[1]))


def assert_brackets(found, error, tolerance, rounding=1e-9):
    assert found.error_lower - rounding <= error <= found.error_upper + rounding
    assert found.error_upper - found.error_lower <= tolerance
    assert Status(int(found.status)) == Status.SOLVED


KINDS = ["of states", "of pairs", "large, far from 0", "numbers", "one hot"]


@pytest.mark.parametrize(
    ("kind", "anchored"), [*zip(KINDS, [True, False, True, False, True], strict=True), ("of pairs", True)]
)
def test_labels_against_highs(kind, anchored, monkeypatch):
    """On the host, in the program that the host calls, and where demonstrations, labels or weights are traced."""
    mdp, labels, tolerance = model(), labels_of(kind), 3e-3
    error, _ = oracles.global_homomorphism_lp(transition(), VISITED, by_pair(labels), anchored)
    without, _ = oracles.global_homomorphism_lp(transition(), VISITED, anchored=anchored)
    assert error > without + 0.01
    solve = functools.partial(soft_homomorphism, mdp, anchored=anchored, tolerance=tolerance)
    assert_brackets(solve(shown(), labels=labels), error, tolerance)
    traced = jax.jit(lambda shown, labels, weight: solve(shown, labels=labels, label_weight=weight))
    assert_brackets(traced(shown(), labels, 1.0), error, tolerance)
    monkeypatch.setattr(programs, "pays", lambda seconds: True)
    assert_brackets(solve(shown(), labels=labels), error, tolerance)


def test_labels_that_tell_states_apart_cost_more_than_one():
    found = soft_homomorphism(model(), shown(), labels=labels_of("numbers"))
    assert found.error_lower > 1.0
    general = soft_homomorphism(model(), shown())
    assert general.error_upper <= 1.0


@pytest.mark.parametrize("kind", ["of pairs", "large, far from 0"])
def test_bounds_hold_in_float32(kind):
    """For the model and the labels as rounded, also where more is asked than float32 gives."""
    mdp, labels = model(np.float32), labels_of(kind).astype(np.float32)
    exact = np.asarray(mdp.transition, float)
    error, _ = oracles.global_homomorphism_lp(exact, VISITED, by_pair(labels).astype(float))
    for tolerance in (1e-2, 1e-9):
        found = soft_homomorphism(mdp, shown(), labels=labels, anchored=False, tolerance=tolerance, max_iterations=4000)
        assert found.error_lower.dtype == jnp.float32
        assert found.error_lower <= error <= found.error_upper
        assert found.error_upper - found.error_lower <= 1e-2
    strict = functools.partial(soft_homomorphism, mdp, anchored=False, tolerance=1e-9, max_iterations=4000)
    inside = jax.jit(lambda shown, labels: strict(shown, labels=labels))(shown(), labels)
    assert inside.error_lower <= error <= inside.error_upper


@pytest.mark.parametrize(
    "labels", [np.full((STATES, 2), 5e3), np.full((STATES, ACTIONS, 1), -0.3), np.zeros((STATES, 0))]
)
def test_constant_labels_change_nothing(labels):
    found, expected = soft_homomorphism(model(), shown(), labels=labels), soft_homomorphism(model(), shown())
    np.testing.assert_allclose(found.policy, expected.policy, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.error_lower, expected.error_lower, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.error_upper, expected.error_upper, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.support, expected.support)


def test_the_weight_multiplies():
    labels = labels_of("of pairs")
    found = soft_homomorphism(model(), shown(), labels=labels, label_weight=0.25)
    expected = soft_homomorphism(model(), shown(), labels=0.25 * labels)
    np.testing.assert_array_equal(found.error_upper, expected.error_upper)
    np.testing.assert_array_equal(found.policy, expected.policy)
    nothing = soft_homomorphism(model(), shown(), labels=labels, label_weight=0)
    np.testing.assert_allclose(nothing.policy, soft_homomorphism(model(), shown()).policy, rtol=0, atol=1e-9)


def test_a_reward_is_one_label_of_every_action():
    reward = labels_of("of pairs")[..., 0]
    found, expected = (soft_homomorphism(model(), shown(), labels=labels) for labels in (reward, reward[..., None]))
    np.testing.assert_array_equal(found.error_upper, expected.error_upper)
    np.testing.assert_array_equal(found.policy, expected.policy)


def test_weights_side_by_side_in_one_program():
    labels, weights = labels_of("of states"), jnp.array([0.0, 0.5, 20.0])

    def solve(weight):
        return soft_homomorphism(model(), shown(), labels=labels, label_weight=weight, tolerance=1e-2)

    found = jax.jit(jax.vmap(solve))(weights)
    for lane, weight in enumerate(weights):
        expected = soft_homomorphism(model(), shown(), labels=labels, label_weight=float(weight), tolerance=1e-2)
        assert found.error_lower[lane] <= expected.error_upper and expected.error_lower <= found.error_upper[lane]
    assert np.all(found.error_upper[1:] > found.error_lower[:-1]) and found.error_lower[2] > found.error_upper[1] + 1.0


def test_labels_of_actions_that_states_lack():
    """Those that are not finite count as 0, others as given; in programs too."""
    mdp = model(restricts=True)
    lacks = ~np.asarray(mdp.allowed)
    assert lacks.any()
    filled = np.where(lacks[..., None], 0.0, labels_of("of pairs"))
    missing = np.where(lacks[..., None], np.nan, filled)
    expected = soft_homomorphism(mdp, shown(), labels=filled)
    for found in (
        soft_homomorphism(mdp, shown(), labels=missing),
        jax.jit(lambda labels: soft_homomorphism(mdp, shown(), labels=labels))(missing),
    ):
        assert found.error_lower <= expected.error_upper and expected.error_lower <= found.error_upper
        assert np.isfinite(found.error_upper)
    given = soft_homomorphism(mdp, shown(), labels=np.where(lacks[..., None], 9.0, filled))
    assert given.error_lower > expected.error_upper + 1.0


def test_labels_that_are_not_finite_end_the_iterations():
    found = jax.jit(lambda labels: soft_homomorphism(model(), shown(), labels=labels))(np.full((STATES, 1), np.nan))
    assert Status(int(found.status)) == Status.ITERATION_LIMIT and not np.isfinite(found.error_upper)


def test_no_demonstrated_state_decides():
    """There is no map to nothing, with labels or without."""
    mdp = MDP.from_dense(np.broadcast_to(np.eye(3)[:, None], (3, 2, 3)), discount=0.9)
    walk = Demonstrations.from_trajectories([([1], [0])])
    found = soft_homomorphism(mdp, walk, labels=np.eye(3))
    assert np.isinf(found.error_upper) and found.radius.tolist() == [-1, 0, -1]
    inside = jax.jit(lambda walk: soft_homomorphism(mdp, walk, labels=np.eye(3)))(walk)
    assert np.isinf(inside.error_upper) and inside.radius.tolist() == [-1, 0, -1]


# ------------------------------------------------------------------------------------- the problem itself


def problems():
    """LP (8) with labels as NumPy has it, and as programs do, with a list of states that is padded."""
    mdp, labels = model(), centred(by_pair(labels_of("of pairs")))[0]
    pinned = np.zeros((STATES, 4), bool)
    host = HostProblem(
        mdp=mdp,
        target=restricted_model(mdp, EXPERTS),
        pinned=pinned,
        exists=np.ones(4, bool),
        labels=labels,
        target_labels=labels[EXPERTS],
        rows=mdp.dynamics.host_matrix(np.asarray(mdp.probability)),
    )
    padded = jnp.array([*EXPERTS, STATES, STATES], jnp.int32)
    traced = GlobalHomomorphismProblem(
        mdp=mdp,
        target=restricted_to_list(mdp, padded),
        pinned=jnp.zeros((STATES, 6), bool),
        exists=padded < STATES,
        labels=jnp.asarray(labels),
        target_labels=jnp.asarray(labels).at[padded].get(mode="fill", fill_value=0),
    )
    return {"host": host, "padded": traced}


@pytest.mark.parametrize("name", ["host", "padded"])
def test_products_bounds_and_norms(name):
    problem, rng = problems()[name], np.random.default_rng(0)
    asarray = np.asarray if name == "host" else jnp.asarray
    size, labels = len(problem.exists), problem.num_labels
    f = problem.project_primal(asarray(rng.uniform(size=(STATES, size, 1))), None)
    y = problem.project_dual(asarray(rng.normal(size=(STATES, ACTIONS, size + labels, 1))), None)
    forward, adjoint = problem.forward(f), problem.adjoint(y)
    np.testing.assert_allclose((forward * y).sum(), (f * adjoint).sum(), rtol=1e-12)
    given = by_pair(labels_of("of pairs"))
    mapped = np.einsum("sk,kai->sai", f[:, :4, 0], given[EXPERTS])
    np.testing.assert_allclose(forward[:, :, size:, 0], given - mapped, rtol=0, atol=1e-12)
    error, _ = oracles.global_homomorphism_lp(transition(), VISITED, given)
    lower, upper = problem.bounds(f, y, forward, adjoint)
    assert lower[0] <= error <= upper[0] <= problem.largest() + 1e-9
    columns = [problem.forward(asarray(unit.reshape(f.shape))) for unit in np.eye(f.size)]
    norm = np.linalg.norm(np.reshape(columns, (f.size, -1)), 2)
    assert norm <= problem.norm_bound()[0] <= 20 * norm


# --------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"labels": np.zeros((3, 1))}, r"labels must have shape \(12, 2, L\) or \(12, L\), got \(3, 1\)"),
        ({"labels": np.full((STATES, 1), np.nan)}, r"labels\[0, 0\] must be finite, got nan"),
        ({"labels": np.zeros((STATES, 1)), "label_weight": -1.0}, "label_weight must not be negative, got -1"),
        ({"labels": np.zeros((STATES, 1)), "target_labels": np.zeros((4, 1))}, "target_labels are those of a target"),
        ({"tolerance": 0.0}, "tolerance must be positive, got 0.0"),
    ],
)
def test_labels_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        soft_homomorphism(model(), shown(), **options)


def test_what_is_neither_demonstrations_nor_a_model_is_refused():
    with pytest.raises(ValueError, match="a jaxhom.MDP is needed, or what has one as .mdp, got list"):
        jaxhom.soft_homomorphism(model(), SHOWN)
