"""The flow method's parts: its projection against least squares, its program against HiGHS, models of every shape."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, Status, gridworld, lpal
from jaxhom.apprenticeship import flow, flow_factor
from jaxhom.apprenticeship.flow_lp import FEATURE_SCALE
from jaxhom.solvers import pdhg


@functools.cache
def model(name):
    """An MDP with the arrays that the oracles take. Grids have more than one block, and features of the state alone."""
    if name in small_models.NAMES:
        case = small_models.case(name)
        return case.mdp, case.arrays
    mdp = gridworld(8, num_regions=16).mdp
    return mdp, (small_models.dense_transition(mdp), 0.99, np.asarray(mdp.initial), np.asarray(mdp.features))


def affine_rows(arrays):
    """M and c of the affine set M (x, u) = c, entry by entry from eqs. (3)-(4)."""
    transition, discount, initial, features = arrays
    num_states, num_actions, num_features = features.shape
    inflow = discount * transition.reshape(-1, num_states).T
    on_flow = np.repeat(np.eye(num_states), num_actions, axis=1) - inflow
    phi = features.reshape(-1, num_features) / np.abs(features).max()
    top = np.hstack([on_flow, np.zeros((num_states, num_features))])
    rows = np.vstack([top, np.hstack([phi.T, -FEATURE_SCALE * np.eye(num_features)])])
    return rows, np.concatenate([(1 - discount) * initial, np.zeros(num_features)])


@jax.jit
def project(problem, point):
    return problem.project_dual(point, None)


@pytest.mark.parametrize(("name", "lanes"), [("dense", 3), ("absorbing", 3), ("restart", 3), ("grid", 1), ("grid", 3)])
def test_projection_on_the_flow(name, lanes, rng):
    """The nearest point of the affine set, by least squares on the dense rows."""
    mdp, arrays = model(name)
    problem = flow.FlowProgram(mdp).problem(jnp.zeros((lanes, mdp.num_features)))
    assert (len(problem.projection.diagonal) > 1) == (name in ("absorbing", "grid"))
    assert problem.features.shape[1] == (1 if name == "grid" else mdp.num_actions)
    rows, right = affine_rows(arrays)
    point = rng.normal(size=(rows.shape[1], lanes))
    correction = np.linalg.lstsq(rows, right[:, None] - rows @ point, rcond=None)[0]
    np.testing.assert_allclose(project(problem, point), point + correction, rtol=0, atol=1e-9)


def test_blocks_of_which_the_last_is_padded(rng):
    """A noisy chain of eleven states, whose band is cut into blocks of two; the inverse against NumPy's."""
    transition = np.zeros((11, 2, 11))
    for action, step in enumerate((-1, 1)):
        for direction, probability in ((step, 0.9), (-step, 0.1)):
            transition[np.arange(11), action, np.clip(np.arange(11) + direction, 0, 10)] += probability
    features = rng.uniform(-1, 1, size=(11, 2, 3))
    features /= np.abs(features).max()
    mdp = MDP.from_dense(transition, discount=0.9, features=features)
    factor = flow_factor.factor_flow(mdp, features)
    chex.assert_shape([factor.lower, factor.diagonal], (6, 2, 2))
    rows, _ = affine_rows((transition, 0.9, np.full(11, 1 / 11), features))
    right = rng.normal(size=(14, 2))
    solution = np.concatenate(factor.solve(jnp.asarray(right[:11]), jnp.asarray(right[11:])))
    np.testing.assert_allclose(solution, np.linalg.solve(rows @ rows.T, right), rtol=0, atol=1e-9)


def test_the_iteration_converges_to_the_program():
    """Without any certificate: x feasible and optimal, w the multipliers, on a model whose optimum is unique."""
    mdp, arrays = model("dense")
    expectations = np.random.default_rng(11).uniform(0.3, 0.7, size=(1, 2)) / (1 - arrays[1])
    _, x, weights = oracles.lpal(*arrays, expectations[0])
    problem = flow.FlowProgram(mdp).problem(jnp.asarray(expectations))
    state = flow._start(problem, jnp.full((1, *x.shape), 1.0 / x.shape[1]))
    for _ in range(8):
        state = flow._advance(problem, state)
    for reading in problem.occupancies(state.primal, state.dual, state.weight):
        np.testing.assert_allclose(reading[..., 0] / (1 - arrays[1]), x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(problem.weights(state.primal)[:, 0], weights, rtol=0, atol=1e-5)
    assert state.steps[0] == 8 * flow._STEPS_PER_LOOK * pdhg.STEPS_PER_CHECK


def test_proximal_steps(rng):
    """lambda >= 0 and q in its simplex, after the step on -q . Vhat / s, against jaxopt's simplex."""
    from jaxopt.projection import projection_simplex

    mdp, arrays = model("dense")
    expectations = rng.uniform(size=(3, 2))
    problem = flow.FlowProgram(mdp).problem(jnp.asarray(expectations))
    pairs, step = mdp.num_states * mdp.num_actions, np.array([0.1, 1.0, 10.0])
    point = rng.normal(size=(pairs + 2, 3))
    result = np.asarray(problem.project_primal(point, step))
    np.testing.assert_array_equal(result[:pairs], np.maximum(point[:pairs], 0.0))
    scaled = (1 - arrays[1]) * expectations.T / np.abs(arrays[3]).max() / FEATURE_SCALE
    for i in range(3):
        expected = projection_simplex(point[pairs:, i] + step[i] * scaled[:, i], FEATURE_SCALE)
        np.testing.assert_allclose(result[pairs:, i], expected, rtol=0, atol=1e-12)


def assert_solved(solution, arrays, expectations, tolerance):
    """The true margin of the policy, and v*, both by the oracles."""
    best = oracles.lpal(*arrays, expectations)[0]
    true = oracles.margin(*arrays, expectations, np.asarray(solution.policy, float))
    assert float(solution.margin) == pytest.approx(true, abs=1e-7 * np.abs(expectations).max() + 1e-7)
    assert solution.margin - 1e-6 <= best <= solution.margin_bound + 1e-6
    assert solution.status == Status.SOLVED
    assert solution.margin_bound - solution.margin <= tolerance


def test_a_batch_at_the_default_tolerance():
    """Exact expectations of policies that are not given (v* = 0), perturbed, and what no policy can reach."""
    mdp, arrays = model("grid")
    rng = np.random.default_rng(5)
    rewards = [arrays[3] @ rng.uniform(size=16) for _ in range(2)]
    experts = [np.eye(4)[oracles.optimal_value(*arrays[:2], reward)[1].argmax(axis=1)] for reward in rewards]
    exact = [oracles.feature_expectations(*arrays, policy) for policy in experts]
    perturbed = [expected * rng.uniform(0.8, 1.2, size=16) for expected in exact]
    unreachable = [np.full(16, 1e4), np.full(16, -1e4), 1e3 * rng.normal(size=16)]
    batch = np.stack([*exact, *perturbed, *unreachable, np.zeros(16)])
    solution = lpal(mdp, batch, method="flow")
    chex.assert_tree_all_finite((solution.policy, solution.margin, solution.margin_bound, solution.weights))
    for i, expectations in enumerate(batch):
        assert_solved(jax.tree.map(lambda leaf, i=i: leaf[i], solution), arrays, expectations, 1e-3)
    np.testing.assert_allclose(solution.margin[:2], 0.0, rtol=0, atol=1e-3)
    assert len(set(solution.iterations.tolist())) > 1  # each lane's own


def test_float32_bounds_hold():
    case = small_models.in_float32(small_models.case("dense"))
    expectations = (np.random.default_rng(3).uniform(0.3, 0.7, size=2) / (1 - case.discount)).astype(np.float32)
    solution = lpal(case.mdp, expectations, method="flow", tolerance=1e-3, max_iterations=2000)
    assert solution.margin.dtype == solution.weights.dtype == jnp.float32
    best = oracles.lpal(*case.arrays, expectations.astype(float))[0]
    assert solution.margin - 1e-4 <= best <= solution.margin_bound
    assert solution.margin_bound - solution.margin <= 1e-3


def test_a_model_too_large_for_the_factor_is_refused(monkeypatch):
    monkeypatch.setattr(flow_factor, "_MAX_ENTRIES", 1000)
    with pytest.raises(ValueError, match=r"needs a factor of .* entries for this model of 64 states"):
        lpal(model("grid")[0], np.zeros(16), method="flow")
