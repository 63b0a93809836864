"""PDHG's parts: its projection against least squares, its iteration against NumPy and HiGHS, models of every shape."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, LPALMethod, Status, gridworld, lpal
from jaxhom.apprenticeship import flow_factor, flow_splitting, pdhg
from jaxhom.apprenticeship.flow_splitting import RELAXATION, STEPS_PER_WEIGHT, Goal, State

iterate, reading = jax.jit(flow_splitting._iterate), jax.jit(flow_splitting.reading)


@functools.cache
def model(name):
    """An MDP with the arrays that the oracles take. Grids have more than one block, and features of the state alone."""
    if name in small_models.NAMES:
        case = small_models.case(name)
        return case.mdp, case.arrays
    mdp = gridworld(8, num_regions=16).mdp
    return mdp, (small_models.dense_transition(mdp), 0.99, np.asarray(mdp.initial), np.asarray(mdp.features))


@functools.cache
def program(name):
    """In float64, whatever the discount."""
    return pdhg.FlowProgram(model(name)[0], np.float64)


def affine_rows(arrays, order):
    """M and c of the affine set M (x, u) = c, entry by entry from eqs. (3)-(4), the states in the given order."""
    transition, discount, initial, features = arrays
    num_states, num_actions, num_features = features.shape
    inflow = discount * transition.reshape(-1, num_states).T
    on_flow = np.repeat(np.eye(num_states), num_actions, axis=1) - inflow
    on_flow = on_flow.reshape(num_states, num_states, num_actions)[order][:, order].reshape(num_states, -1)
    phi = features[order].reshape(-1, num_features) / np.abs(features).max()
    top = np.hstack([on_flow, np.zeros((num_states, num_features))])
    rows = np.vstack([top, np.hstack([phi.T, -np.eye(num_features)])])
    return rows, np.concatenate([(1 - discount) * initial[order], np.zeros(num_features)])


def random_problem(name, lanes, rng):
    """A goal, and a state in the middle of nowhere."""
    mdp, _ = model(name)
    pairs, features = (mdp.num_states, mdp.num_actions, lanes), (mdp.num_features, lanes)
    w = rng.dirichlet(np.ones(features[0]), size=lanes).T
    goal = Goal(expectations=rng.uniform(size=features), x=rng.uniform(size=pairs), w=w)
    one = np.ones(lanes)
    state = State(
        t=rng.normal(size=pairs),
        v=rng.normal(size=features),
        weight=rng.uniform(0.1, 10.0, size=lanes),
        x=np.zeros(pairs),
        value=np.zeros((pairs[0], lanes)),
        change=one,
        moved=one,
        iterations=one.astype(np.int32),
    )
    return jax.tree.map(jnp.asarray, (goal, state))


def projected(rows, right, point):
    """The nearest point of the affine set, by least squares on the dense rows."""
    return point + np.linalg.lstsq(rows, right[:, None] - rows @ point, rcond=None)[0]


def simplex(point):
    """The projection of [K, lanes] by sorting (Duchi et al. 2008)."""
    largest = -np.sort(-point, axis=0)
    excess = (np.cumsum(largest, axis=0) - 1.0) / np.arange(1, len(point) + 1)[:, None]
    count = (largest > excess).sum(axis=0)
    return np.maximum(point - excess[count - 1, np.arange(point.shape[1])], 0.0)


@pytest.mark.parametrize(("name", "lanes"), [("dense", 3), ("absorbing", 3), ("restart", 3), ("grid", 1), ("grid", 3)])
def test_one_iteration(name, lanes, rng):
    """The fused pass against its formulas in NumPy: prox, projection of the reflected point, relaxation."""
    mdp, arrays = model(name)
    here, (goal, state) = program(name), random_problem(name, lanes, rng)
    assert (len(here.splitting.factor.diagonal) > 1) == (name in ("absorbing", "grid"))
    assert here.splitting.features.shape[1] == (1 if name == "grid" else mdp.num_actions)
    t, v = np.asarray(state.t).reshape(-1, lanes), np.asarray(state.v)
    x, w = np.maximum(t, 0.0), simplex((np.asarray(goal.expectations) - v) / np.asarray(state.weight))
    u = v + np.asarray(state.weight) * w
    near = projected(*affine_rows(arrays, here.order), np.concatenate([2 * x - t, 2 * u - v]))
    after = iterate(here.splitting, goal, state)
    np.testing.assert_allclose(after.t.reshape(-1, lanes), t + RELAXATION * (near[: len(t)] - x), rtol=0, atol=1e-8)
    np.testing.assert_allclose(after.v, v + RELAXATION * (near[len(t) :] - u), rtol=0, atol=1e-8)
    _, weights, _ = reading(here.splitting, goal, state)
    np.testing.assert_allclose(weights, w, rtol=0, atol=1e-12)


def test_the_weight_changes_no_point(rng):
    """A look at the weight leaves x, the multipliers, w and u where the iterations have brought them."""
    here, (goal, state) = program("dense"), random_problem("dense", 3, rng)
    after = jax.jit(flow_splitting.advance)(here.splitting, goal, state)
    plain = state
    for _ in range(STEPS_PER_WEIGHT):
        before, plain = plain, iterate(here.splitting, goal, plain)
    assert np.all(after.weight != state.weight)
    points = [flow_splitting.point(here.splitting, goal, one) for one in (plain, after)]
    chex.assert_trees_all_close(*points, rtol=0, atol=1e-9)
    change = np.abs(plain.t - before.t).sum(axis=(0, 1)) / RELAXATION
    np.testing.assert_allclose(after.change, change, rtol=1e-9)
    x = np.maximum(before.t, 0.0) + (plain.t - before.t) / RELAXATION
    np.testing.assert_allclose(after.x, x, rtol=0, atol=1e-9)
    read, _, value = reading(here.splitting, goal, after)
    np.testing.assert_allclose(read, np.maximum(x, 0.0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(value, plain.value, rtol=0, atol=1e-9)
    first = flow_splitting.point(here.splitting, goal, state)
    np.testing.assert_allclose(after.moved, np.abs(points[0].w - first.w).sum(axis=0), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(after.iterations, 1 + STEPS_PER_WEIGHT)


def test_blocks_of_which_the_last_is_padded(rng):
    """A noisy chain of eleven states, whose band is cut into blocks of two; the inverse against NumPy's."""
    transition = np.zeros((11, 2, 11))
    for action, step in enumerate((-1, 1)):
        for direction, probability in ((step, 0.9), (-step, 0.1)):
            transition[np.arange(11), action, np.clip(np.arange(11) + direction, 0, 10)] += probability
    features = rng.uniform(-1, 1, size=(11, 2, 3))
    features /= np.abs(features).max()
    mdp = MDP.from_dense(transition, discount=0.9, features=features)
    splitting, order = flow_factor.split_flow(mdp, np.ones(3), np.float64)
    chex.assert_shape([splitting.factor.lower, splitting.factor.diagonal], (6, 2, 2))
    rows, _ = affine_rows((transition, 0.9, np.full(11, 1 / 11), features), order)
    right = rng.normal(size=(14, 2))
    solution = np.concatenate(splitting.factor.solve(jnp.asarray(right[:11]), jnp.asarray(right[11:])))
    np.testing.assert_allclose(solution, np.linalg.solve(rows @ rows.T, right), rtol=0, atol=1e-9)


def test_the_iteration_converges_to_the_program():
    """Without any certificate: x feasible and optimal, w the multipliers, on a model whose optimum is unique."""
    mdp, arrays = model("dense")
    expectations = np.random.default_rng(11).uniform(0.3, 0.7, size=(1, 2)) / (1 - arrays[1])
    _, x, weights = oracles.lpal(*arrays, expectations[0])
    here = pdhg.FlowProgram(mdp, np.float64)
    goal = here.goal(expectations)
    state = here.advance(goal, None, 2000, 1)
    found = here.read(goal, state, 1)
    np.testing.assert_allclose(found.x[0], x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.weights[0], weights, rtol=0, atol=1e-5)
    values, _ = oracles.optimal_value(*arrays[:2], arrays[3] @ weights)
    visited = x.sum(axis=1) > 1e-6
    np.testing.assert_allclose(found.value[0, visited], values[visited], rtol=0, atol=1e-3)
    assert found.iterations[0] == 2000


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_lanes_do_not_depend_on_each_other(dtype):
    """Seven lanes in parts of two, of which the last is filled up, and alone."""
    mdp, _ = model("grid")
    here = pdhg.FlowProgram(mdp, dtype)
    expectations = np.random.default_rng(2).uniform(0.0, 12.0, size=(7, 16))
    goal = here.goal(expectations)
    state = here.advance(goal, None, 50, 2)
    for lane in (0, 6):
        one = here.advance(here.goal(expectations[lane : lane + 1]), None, 50, 2)
        tolerance = 1e-9 if dtype == np.float64 else 1e-3
        np.testing.assert_allclose(one.t[..., 0], state.t[..., lane], rtol=0, atol=tolerance)


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
    solution = lpal(mdp, batch, method="pdhg")
    chex.assert_tree_all_finite((solution.policy, solution.margin, solution.margin_bound, solution.weights))
    for i, expectations in enumerate(batch):
        assert_solved(jax.tree.map(lambda leaf, i=i: leaf[i], solution), arrays, expectations, 1e-3)
    np.testing.assert_allclose(solution.margin[:2], 0.0, rtol=0, atol=1e-3)
    assert len(set(solution.iterations.tolist())) > 1  # each lane's own
    assert LPALMethod.PDHG in solution.decided_by.tolist()


def test_pdhg_alone_closes_a_lane():
    """One region to be visited: the best response to the weights that PDHG arrives at."""
    mdp, arrays = model("grid")
    expectations = np.where(np.arange(16) == 9, 50.0, -500.0)
    solution = lpal(mdp, expectations, method="pdhg")
    assert_solved(solution, arrays, expectations, 1e-3)
    assert solution.decided_by == LPALMethod.PDHG
    assert solution.iterations >= 100


@pytest.mark.parametrize("method", ["columns", "interior_point", "pdhg"])
def test_who_decided(method):
    """On a model of one block, columns finish what PDHG has begun."""
    mdp, arrays = model("dense")
    solution = lpal(mdp, np.full(2, 0.4) / (1 - arrays[1]), method=method)
    by = {"columns": [LPALMethod.COLUMNS], "interior_point": [LPALMethod.INTERIOR_POINT]}
    assert solution.decided_by in by.get(method, [LPALMethod.PDHG, LPALMethod.COLUMNS])


@pytest.mark.parametrize("limit", [1, 5, 30, 120, 251])
def test_limits(limit):
    mdp, arrays = model("grid")
    expectations = np.random.default_rng(1).uniform(0.0, 12.0, size=(3, 16))
    solution = lpal(mdp, expectations, method="pdhg", max_iterations=limit)
    assert solution.iterations.max() <= limit
    for lane, given in enumerate(expectations):
        best = oracles.lpal(*arrays, given)[0]
        assert solution.margin[lane] - 1e-6 <= best <= solution.margin_bound[lane] + 1e-6
        is_closed = solution.margin_bound[lane] - solution.margin[lane] <= 1e-3
        assert solution.status[lane] == (Status.SOLVED if is_closed else Status.ITERATION_LIMIT)


def test_float32_bounds_hold():
    case = small_models.in_float32(small_models.case("dense"))
    expectations = (np.random.default_rng(3).uniform(0.3, 0.7, size=2) / (1 - case.discount)).astype(np.float32)
    solution = lpal(case.mdp, expectations, method="pdhg", tolerance=1e-3)
    assert solution.margin.dtype == solution.weights.dtype == jnp.float32
    best = oracles.lpal(*case.arrays, expectations.astype(float))[0]
    assert solution.margin - 1e-4 <= best <= solution.margin_bound
    assert solution.margin_bound - solution.margin <= 1e-3


def test_a_model_too_large_for_the_factor_is_refused(monkeypatch):
    monkeypatch.setattr(flow_factor, "MAX_ENTRIES", 1000)
    with pytest.raises(ValueError, match=r"needs a factor of .* entries for this model of 64 states"):
        lpal(model("grid")[0], np.zeros(16), method="pdhg")


def test_the_former_name_warns():
    mdp, _ = model("dense")
    with pytest.warns(DeprecationWarning, match="now called 'pdhg'"):
        former = lpal(mdp, np.zeros(2), method="flow", tolerance=1e-2)
    chex.assert_trees_all_equal(former, lpal(mdp, np.zeros(2), method="pdhg", tolerance=1e-2))


def test_iterations_that_overflow_are_no_guess(monkeypatch):
    """Whatever PDHG says, lanes are solved: by columns and the interior point."""
    mdp, arrays = model("grid")
    read = pdhg.FlowProgram.read

    def spoiled(self, *arguments):
        found = read(self, *arguments)
        found.x[:], found.value[:], found.weights[:] = np.nan, np.nan, np.nan
        return found

    monkeypatch.setattr(pdhg.FlowProgram, "read", spoiled)
    expectations = np.random.default_rng(1).uniform(0.0, 12.0, size=(2, 16))
    solution = lpal(mdp, expectations, method="pdhg")
    for lane, given in enumerate(expectations):
        assert_solved(jax.tree.map(lambda leaf, lane=lane: leaf[lane], solution), arrays, given, 1e-3)
