"""LPAL under jit, vmap and grad: its bounds against HiGHS, its factor against NumPy, its lanes against themselves."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import LPAL, MDP, LPALMethod, Status, feature_expectations, gridworld, lpal
from jaxhom.apprenticeship import flow_factor_in_program
from jaxhom.apprenticeship.presolve import Reach, default_tolerance, reduce_expectations
from jaxhom.models.mdp import uniform_policy

NAMES = [*small_models.NAMES, "grid"]


@functools.cache
def model(name):
    """An MDP with the arrays that the oracles take. Grids have more than one block, and features that add up to 1."""
    if name in small_models.NAMES:
        case = small_models.case(name)
        return case.mdp, case.arrays
    size = {"grid": 8, "small grid": 4}[name]
    mdp = gridworld(size, num_regions=size**2 // 4, discount=0.9).mdp
    return mdp, (small_models.dense_transition(mdp), 0.9, np.asarray(mdp.initial), np.asarray(mdp.features))


def expectations_of(name, lanes, rng):
    """Around what policies reach."""
    mdp, arrays = model(name)
    policies = rng.dirichlet(0.3 * np.ones(mdp.num_actions), size=(lanes, mdp.num_states))
    policies = np.where(np.asarray(mdp.allowed), policies, 0.0)
    policies /= policies.sum(axis=-1, keepdims=True)
    exact = np.stack([oracles.feature_expectations(*arrays, policy) for policy in policies])
    return exact * rng.uniform(0.9, 1.1, size=exact.shape)


def check_against_highs(name, expectations, solution, tolerance):
    """Bounds around the optimum, as close as asked for, and the margin is one that the policy has."""
    _, arrays = model(name)
    for k, expected in enumerate(expectations):
        best = oracles.lpal(*arrays, expected)[0]
        lane = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], solution)
        assert lane.margin - 1e-9 <= best <= lane.margin_bound + 1e-9
        assert lane.margin <= oracles.margin(*arrays, expected, lane.policy) + 1e-9
        assert lane.status == Status.SOLVED
        assert lane.margin_bound - lane.margin <= tolerance
        np.testing.assert_allclose(lane.policy.sum(axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(lane.weights.sum(), 1.0, atol=1e-12)
        assert lane.weights.min() >= 0


# Each model once, each kind of trace with dense models and with lists of successors. `test_the_factor_made_inside` has
# them all, and further tests trace the expectations of the grid.
@pytest.mark.parametrize("name", ["one_state", "dense_krylov", "restart"])
def test_bounds_of_traced_expectations(name, rng):
    mdp, _ = model(name)
    expectations = expectations_of(name, 3, rng)
    solution = jax.jit(lambda e: lpal(mdp, e, tolerance=1e-3))(expectations)
    check_against_highs(name, expectations, solution, 1e-3)
    assert set(np.asarray(solution.decided_by).tolist()) <= {LPALMethod.PDHG, LPALMethod.COLUMNS}


@pytest.mark.parametrize("name", ["one_action", "dense", "absorbing"])
def test_bounds_of_traced_models(name, rng):
    """The whole model as an argument, whose graph is traced."""
    mdp, _ = model(name)
    expectations = expectations_of(name, 3, rng)
    solution = jax.jit(lambda mdp, e: lpal(mdp, e, tolerance=1e-3, method="pdhg"))(mdp, expectations)
    check_against_highs(name, expectations, solution, 1e-3)


@pytest.mark.parametrize("name", ["dense", "sparse", "grid"])
def test_bounds_of_traced_numbers(name, rng):
    """Those of the model alone, whose graph is known."""
    mdp, _ = model(name)
    expectations = expectations_of(name, 3, rng)

    def of_numbers(probability, discount, features, initial):
        model = mdp.replace(probability=probability, discount=discount, features=features, initial=initial)
        return lpal(model, expectations, tolerance=1e-3)

    solution = jax.jit(of_numbers)(mdp.probability, mdp.discount, mdp.features, mdp.initial)
    check_against_highs(name, expectations, solution, 1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_the_factor_made_inside(name, rng):
    """(M M^T)^-1 of the affine rows, against NumPy."""
    mdp, (transition, discount, _, features) = model(name)
    right = rng.normal(size=(mdp.num_states, 2)), rng.normal(size=(mdp.num_features, 2))

    def solve(probability, right):
        traced = mdp.replace(probability=probability)
        unit = jnp.ones(mdp.num_features)
        factor = flow_factor_in_program.split_flow_in_program(traced, traced.features, unit).factor
        return factor.solve(*right), factor.diagonal

    (y, m), diagonal = jax.jit(solve)(mdp.probability, right)
    assert (len(diagonal) > 1) == (name in ("absorbing", "grid"))
    num_pairs = mdp.num_states * mdp.num_actions
    allowed = np.asarray(mdp.allowed, float)
    outflow = (np.eye(mdp.num_states)[:, None] * allowed[..., None]).reshape(num_pairs, -1).T
    flow = outflow - discount * transition.reshape(num_pairs, -1).T
    rows = np.block(
        [
            [flow, np.zeros((len(flow), mdp.num_features))],
            [features.reshape(num_pairs, -1).T, -np.eye(mdp.num_features)],
        ]
    )
    expected = np.linalg.solve(rows @ rows.T, np.concatenate(right))
    np.testing.assert_allclose(np.concatenate([y, m]), expected, rtol=1e-7, atol=1e-8)


def test_presolving_inside_is_presolving_outside(rng):
    """Cliffs, constant features, and expectations out of reach."""
    mdp, _ = model("grid")
    features = np.array(mdp.features)
    features[..., 0], features[..., 1] = 1.0, np.where(rng.uniform(size=features.shape[:2]) < 0.1, -50.0, 0.0)
    features[..., 1] += 1e-2 * rng.uniform(size=features.shape[:2])
    mdp = mdp.replace(features=features)
    expectations = expectations_of("grid", 3, rng)
    expectations[1, 2], expectations[2] = -1e3, 1e4

    def presolve(mdp, expectations):
        reach = Reach.of(mdp)
        reduction = reduce_expectations(reach, expectations)
        weights = reduction.weights(slice(None), jnp.full(expectations.shape, 1 / 16))
        return reduction, default_tolerance(reach, reduction), weights

    reach = Reach.of(mdp)
    reduction = reduce_expectations(reach, expectations)
    outside = reduction, default_tolerance(reach, reduction), reduction.weights(slice(None), np.full((3, 16), 1 / 16))
    assert reduction.is_idle.any()
    chex.assert_trees_all_close(jax.jit(presolve)(mdp, expectations), outside, rtol=1e-12)


def test_lanes_do_not_depend_on_their_batch(rng):
    """One at a time, as a batch of more lanes than are solved at a time, and under vmap of vmap."""
    mdp, _ = model("small grid")
    expectations = jnp.asarray(expectations_of("small grid", 18, rng))
    solve = jax.jit(lambda e: lpal(mdp, e))
    batch = solve(expectations)
    nested = jax.vmap(jax.vmap(solve))(expectations.reshape(2, 9, -1))
    alone = solve(expectations[4])
    merged = jax.tree.map(lambda leaf: leaf.reshape(18, *leaf.shape[2:]), nested)
    chex.assert_trees_all_close(merged, batch, rtol=0, atol=1e-9)
    # Programs of other widths round differently; the bounds are each other's.
    assert alone.margin <= batch.margin_bound[4]
    assert batch.margin[4] <= alone.margin_bound
    outside = lpal(mdp, expectations)
    assert np.all(batch.margin <= outside.margin_bound)
    assert np.all(outside.margin <= batch.margin_bound)


def test_models_of_their_own_under_vmap(rng):
    mdp, arrays = model("absorbing")
    expectations, discounts = expectations_of("absorbing", 2, rng), np.array([0.8, 0.9])
    solutions = jax.vmap(lambda g, e: lpal(mdp.replace(discount=g), e, tolerance=1e-4))(discounts, expectations)
    for k, discount in enumerate(discounts):
        best = oracles.lpal(arrays[0], discount, *arrays[2:], expectations[k])[0]
        assert solutions.margin[k] <= best + 1e-9
        assert best <= solutions.margin_bound[k] + 1e-9
        assert solutions.status[k] == Status.SOLVED


@pytest.mark.parametrize(
    "parameters", [("expectations",), ("features", "initial", "probability", "discount")], ids=", ".join
)
def test_derivatives_are_those_outside(parameters, rng):
    """Which are held to finite differences of HiGHS in their own tests."""
    mdp, _ = model("restart")
    expectations = expectations_of("restart", 2, rng)

    def bounds(values):
        model = mdp.replace(**{name: value for name, value in values.items() if name != "expectations"})
        found = lpal(model, values.get("expectations", expectations), tolerance=1e-9, max_iterations=4000)
        return jnp.stack([found.margin.sum(), found.margin_bound.sum()])

    values = {name: expectations if name == "expectations" else getattr(mdp, name) for name in parameters}
    inside, outside = jax.jit(jax.jacrev(bounds))(values), jax.jacrev(bounds)(values)
    for name in parameters:
        # Where a policy hardly ever is, the gap leaves open what it does: some 1e-8 of the largest derivative.
        largest = np.abs(outside[name]).max()
        np.testing.assert_allclose(inside[name], outside[name], rtol=1e-4, atol=1e-7 * largest, err_msg=name)


def test_derivatives_of_each_lane_under_vmap(rng):
    mdp, _ = model("grid")
    expectations = expectations_of("grid", 3, rng)
    solve = functools.partial(lpal, mdp, tolerance=1e-4)

    def bound(expectations):
        solution = solve(expectations)
        return solution.margin_bound, solution.weights

    gradients, weights = jax.jit(jax.vmap(jax.grad(bound, has_aux=True)))(expectations)
    np.testing.assert_allclose(gradients, -weights, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="first derivatives only"):
        jax.jit(jax.hessian(lambda e: solve(e).margin))(expectations[0])


def test_a_start_is_looked_at_first(rng):
    """The answer itself as the start closes the lanes without an iteration."""
    mdp, _ = model("small grid")
    expectations = expectations_of("small grid", 3, rng)
    found = lpal(mdp, expectations, tolerance=1e-6)
    again = jax.jit(lambda e, start: lpal(mdp, e, warm_start=start, tolerance=1e-3))(expectations, found)
    assert np.all(again.status == Status.SOLVED)
    assert np.all(again.iterations <= 2)
    policy = jax.jit(lambda p: lpal(mdp, expectations[0], initial_policy=p, tolerance=1e-3))(found.policy[0])
    assert policy.margin_bound - policy.margin <= 1e-3


def test_the_limit_leaves_valid_bounds(rng):
    mdp, arrays = model("grid")
    expectations = expectations_of("grid", 3, rng)
    solution = jax.jit(lambda e: lpal(mdp, e, tolerance=1e-9, max_iterations=50))(expectations)
    assert np.all(solution.status == Status.ITERATION_LIMIT)
    for k in range(3):
        best = oracles.lpal(*arrays, expectations[k])[0]
        assert solution.margin[k] <= best <= solution.margin_bound[k]


def test_nan_ends():
    """In one of the arguments at a time."""
    mdp, _ = model("absorbing")
    values = {name: getattr(mdp, name) for name in ("discount", "features", "probability")}
    solve = jax.jit(lambda expectations, values: lpal(mdp.replace(**values), expectations))
    expectations = jnp.zeros(mdp.num_features)
    assert solve(expectations, values).status == Status.SOLVED
    assert solve(jnp.full_like(expectations, jnp.nan), values).status != Status.SOLVED
    for name, value in values.items():
        assert solve(expectations, {**values, name: jnp.full_like(value, jnp.nan)}).status != Status.SOLVED, name


def test_bounds_in_float32(rng):
    _, arrays = model("grid")
    short = MDP.from_dense(
        arrays[0].astype(np.float32),
        discount=0.9,
        features=arrays[3].astype(np.float32),
        initial=arrays[2].astype(np.float32),
    )
    expectations = expectations_of("grid", 3, rng).astype(np.float32)
    solution = jax.jit(lambda e: lpal(short, e, tolerance=1e-2))(expectations)
    assert solution.margin.dtype == np.float32
    assert np.all(solution.status == Status.SOLVED)
    for k, expected in enumerate(expectations.astype(float)):
        best = oracles.lpal(*arrays, expected)[0]
        assert solution.margin[k] <= best + 1e-6
        assert best <= solution.margin_bound[k] + 1e-6


def test_concrete_calls_inside_a_program_are_constants(rng):
    mdp, _ = model("grid")
    expectations = expectations_of("grid", 2, rng)
    inside = jax.jit(lambda x: x + lpal(mdp, expectations).margin)(jnp.zeros(2))
    np.testing.assert_array_equal(inside, lpal(mdp, expectations).margin)


def test_a_second_call_traces_nothing(rng):
    mdp, _ = model("absorbing")
    solve = jax.jit(chex.assert_max_traces(lambda mdp, e: lpal(mdp, e).margin, n=1))
    for scale in (1.0, 1.1):
        solve(mdp, scale * expectations_of("absorbing", 2, rng))


@pytest.mark.parametrize("method", ["columns", "interior_point"])
def test_methods_of_the_host_are_refused(method):
    mdp, _ = model("restart")
    with pytest.raises(ValueError, match=f"method='{method}' works on the host"):
        jax.jit(lambda e: lpal(mdp, e, method=method))(jnp.zeros(mdp.num_features))


def test_traced_options_are_refused():
    mdp, _ = model("restart")
    with pytest.raises(ValueError, match="tolerance is a traced value"):
        jax.jit(lambda t: lpal(mdp, np.zeros(mdp.num_features), tolerance=t))(1e-3)


def test_shapes_are_checked_under_a_trace():
    mdp, _ = model("restart")
    with pytest.raises(ValueError, match="expectations must have shape"):
        jax.jit(lambda e: lpal(mdp, e))(jnp.zeros(mdp.num_features + 1))
    with pytest.raises(ValueError, match="initial_policy must have shape"):
        jax.jit(lambda p: lpal(mdp, np.zeros((3, mdp.num_features)), initial_policy=p))(
            jnp.zeros((2, mdp.num_states, mdp.num_actions))
        )


def test_a_traced_graph_that_is_too_large(monkeypatch):
    monkeypatch.setattr(flow_factor_in_program, "_MOST_STATES", 20)
    mdp, _ = model("grid")
    with pytest.raises(ValueError, match=r"close over it, and exchange its arrays by mdp.replace"):
        jax.jit(lambda mdp: lpal(mdp, np.zeros(16)))(mdp)


def test_a_prepared_model_inside(rng):
    """Its factor is made once, whatever traces it."""
    mdp, _ = model("small grid")
    prepared, expectations = LPAL(mdp), expectations_of("small grid", 3, rng)
    found = jax.jit(prepared.solve)(expectations)
    chex.assert_trees_all_close(found, jax.jit(lambda e: lpal(mdp, e))(expectations), rtol=0, atol=1e-9)
    own = jax.jit(lambda e: prepared.solve(e, initial_policy=uniform_policy(mdp)))(
        feature_expectations(mdp, uniform_policy(mdp))
    )
    assert own.margin >= -1e-4
    assert own.iterations <= 2
