"""LPAL against HiGHS: margins, bounds, and the certificates that they come with."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import LPAL, MDP, Status, gridworld, lpal
from jaxhom.apprenticeship import certificate, column_rounds, interior_point, pdhg, presolve, quickest

METHODS = ["columns", "pdhg", "interior_point", "auto"]


class Instance(NamedTuple):
    """A model with its arrays, an expert's policy, and expectations by name."""

    mdp: MDP
    arrays: tuple
    policy: np.ndarray
    expectations: dict


def arrays_of(mdp):
    """What the oracles take: the model's own numbers, in float64."""
    leaves = (mdp.transition, mdp.discount, mdp.initial, mdp.features)
    return tuple(np.asarray(leaf, np.float64) for leaf in leaves)


@functools.cache
def grid(size):
    """A gridworld of 16 regions, an expert for random rewards of them, and its expectations by several roads."""
    rng = np.random.default_rng(size)
    mdp = gridworld(size, num_regions=16).mdp
    transition, discount, initial, features = arrays_of(mdp)
    _, action_value = oracles.optimal_value(transition, discount, features @ rng.uniform(size=16))
    policy = np.eye(4)[action_value.argmax(axis=1)]
    trajectories = oracles.sample_trajectories(rng, transition, initial, policy, 10, 50)
    exact = oracles.feature_expectations(transition, discount, initial, features, policy)
    expectations = {
        "Monte Carlo": oracles.monte_carlo_feature_expectations(features, discount, trajectories),
        "exact": exact,
        "perturbed": exact * rng.uniform(0.8, 1.2, size=16),
        "far too much": np.full(16, 1000.0),
        "far too little": np.full(16, -1000.0),
        "of both signs": rng.uniform(-100, 100, size=16),
        "one feature alone": np.where(np.arange(16) == 9, 0.0, -500.0),
    }
    return Instance(mdp, arrays_of(mdp), policy, expectations)


@functools.cache
def dense(num_features, dtype=np.float64):
    """A random model of six states, and eight expectations around what can be reached."""
    rng = np.random.default_rng(num_features)
    transition, discount, initial, features = oracles.random_mdp(rng, 6, 2, K=num_features)
    mdp = MDP.from_dense(transition.astype(dtype), discount=discount, initial=initial, features=features)
    policy = rng.dirichlet(np.ones(2), size=6)
    exact = oracles.feature_expectations(transition, discount, initial, features, policy)
    expectations = exact * rng.uniform(0.5, 1.5, size=(8, num_features))
    return Instance(mdp, arrays_of(mdp), policy, expectations)


def optimum(arrays, expectations):
    return oracles.lpal(*arrays, np.asarray(expectations, np.float64))[0]


def assert_certified(solution, arrays, expectations, *, eps=1e-6, slack=np.inf):
    """Every claim of one solution, each by an independent road; returns v*. `slack` is what planning may add."""
    transition, discount, initial, features = arrays
    expectations = np.asarray(expectations, np.float64)
    best = optimum(arrays, expectations)
    policy, weights = (np.asarray(leaf, np.float64) for leaf in (solution.policy, solution.weights))
    chex.assert_shape([solution.policy, solution.occupancy], features.shape[:2])
    chex.assert_shape(solution.weights, features.shape[2:])
    chex.assert_shape([solution.margin, solution.margin_bound, solution.status], ())
    np.testing.assert_allclose(policy.sum(axis=1), 1.0, rtol=0, atol=eps)
    assert policy.min() >= 0
    # the margin is that of the returned policy, and no policy has a larger one
    margin = oracles.margin(transition, discount, initial, features, expectations, policy)
    np.testing.assert_allclose(solution.margin, margin, rtol=0, atol=eps)
    assert solution.margin <= best + eps
    occupancy = oracles.occupancy(transition, discount, initial, policy)
    np.testing.assert_allclose(solution.occupancy, occupancy, rtol=0, atol=10 * eps)
    # the bound holds, and the weights prove it
    assert solution.margin_bound >= best - min(eps, 1e-6)
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=0, atol=eps)
    assert weights.min() >= 0
    reward = (features @ weights)[:, :, None]
    proved = oracles.lpal(transition, discount, initial, reward, [weights @ expectations])[0]
    assert proved - eps <= solution.margin_bound
    assert solution.margin_bound <= proved + slack
    return best


def assert_solved(solution, arrays, expectations, tolerance):
    best = assert_certified(solution, arrays, expectations, slack=tolerance)
    assert solution.status == Status.SOLVED
    assert solution.margin_bound - solution.margin <= tolerance
    assert abs(solution.margin - best) <= tolerance + 1e-6


def lane(solution, index):
    return jax.tree.map(lambda leaf: leaf[index], solution)


# ------------------------------------------------------------------------------------- gridworlds

HARD = ["Monte Carlo", "perturbed", "of both signs", "far too much", "far too little", "one feature alone"]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", HARD)
def test_a_gridworld(name, method):
    here = grid(8)
    expectations, tolerance = here.expectations[name], 1e-2
    solution = lpal(here.mdp, expectations, tolerance=tolerance, method=method)
    assert_solved(solution, here.arrays, expectations, tolerance)


@pytest.mark.parametrize(("is_small", "max_steps"), [(True, 2), (False, 2), (False, 50)])
def test_columns_and_the_interior_point_together(is_small, max_steps, monkeypatch):
    """Half of what is reached in every region can be exceeded in all of them: few policies do not mix so.

    On a small model the interior point begins, else it has what columns leave. If it is stopped too soon, they go on.
    """
    here, asked = grid(8 if is_small else 16), []

    class Program(interior_point.LinearProgram):
        def solve(self, expectations, tolerance, **options):
            asked.append(expectations)
            return super().solve(expectations, tolerance, **options | {"max_iterations": max_steps})

    monkeypatch.setattr(interior_point, "LinearProgram", Program)
    monkeypatch.setattr(quickest, "_SMALL_STATES", 64 if is_small else 255)
    expectations = np.stack([0.5 * here.expectations["exact"], here.expectations["of both signs"]])
    solution = lpal(here.mdp, expectations)
    assert len(asked) == (2 if is_small else 1)
    np.testing.assert_array_equal(asked[0], expectations[0])
    for i, expected in enumerate(expectations):
        assert_solved(lane(solution, i), here.arrays, expected, 1e-3)
    if max_steps == 50:
        by_columns = lpal(here.mdp, expectations[0], method="columns")
        assert solution.iterations[0] < by_columns.iterations


@pytest.mark.parametrize("name", ["Monte Carlo", "perturbed", "of both signs"])
def test_a_larger_gridworld(name):
    here = grid(16)
    expectations = here.expectations[name]
    assert_solved(lpal(here.mdp, expectations), here.arrays, expectations, 1e-3)


@pytest.mark.parametrize("method", ["columns", "pdhg"])
def test_the_policy_that_the_expectations_came_from_is_optimal(method):
    """Regions add up to a constant, so v* = 0; as a first guess the policy closes the gap at once."""
    here = grid(8)
    expectations = here.expectations["exact"]
    solution = lpal(here.mdp, expectations, initial_policy=here.policy, method=method)
    assert_solved(solution, here.arrays, expectations, 1e-3)
    assert abs(solution.margin) <= 1e-3
    assert solution.iterations <= 2
    cut_short = lpal(here.mdp, expectations, method=method, max_iterations=10)
    assert_certified(cut_short, here.arrays, expectations)


# ------------------------------------------------------------------------------------ small models


@pytest.mark.parametrize("method", METHODS)
def test_dense_models(method):
    """As many features as states; eight lanes at once."""
    here = dense(6)
    solution = lpal(here.mdp, here.expectations, tolerance=1e-4, method=method)
    for i, expectations in enumerate(here.expectations):
        assert_solved(lane(solution, i), here.arrays, expectations, 1e-4)


def test_a_batch_agrees_with_its_lanes_alone():
    here = dense(6)
    batch = lpal(here.mdp, here.expectations, tolerance=1e-4)
    chex.assert_shape([batch.policy, batch.occupancy], (8, 6, 2))
    chex.assert_shape(batch.weights, (8, 6))
    chex.assert_shape([batch.margin, batch.margin_bound, batch.iterations, batch.status], (8,))
    for i, expectations in enumerate(here.expectations):
        alone = lpal(here.mdp, expectations, tolerance=1e-4)
        assert_solved(alone, here.arrays, expectations, 1e-4)
        np.testing.assert_allclose(batch.margin[i], alone.margin, rtol=0, atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_first_guesses_of_a_batch(method):
    """One policy for all lanes, or one for each."""
    here = dense(6)
    policies = np.random.default_rng(3).dirichlet(np.ones(2), size=(8, 6))
    for first in (here.policy, policies):
        solution = lpal(here.mdp, here.expectations, initial_policy=first, method=method, tolerance=1e-4)
        for i, expectations in enumerate(here.expectations):
            assert_solved(lane(solution, i), here.arrays, expectations, 1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_one_feature_is_a_planning_problem(method):
    here = dense(1)
    transition, discount, initial, features = here.arrays
    value, _ = oracles.optimal_value(transition, discount, features[:, :, 0])
    solution = lpal(here.mdp, here.expectations, tolerance=1e-4, method=method)
    expected = value @ initial - here.expectations[:, 0]
    np.testing.assert_allclose(solution.margin, expected, rtol=0, atol=1e-4)
    np.testing.assert_allclose(solution.weights, 1.0, rtol=0, atol=1e-12)
    for i, expectations in enumerate(here.expectations):
        assert_solved(lane(solution, i), here.arrays, expectations, 1e-4)


def test_states_that_nothing_reaches():
    """Where eq. (5) is 0 / 0; the shapes are those of `dense(6)`, so nothing is compiled."""
    transition, discount, initial, _ = small_models.case("absorbing").arrays
    features = np.random.default_rng(1).uniform(-1, 1, size=(6, 2, 6))
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    expectations = np.random.default_rng(2).uniform(-5, 5, size=(8, 6))
    solution = lpal(mdp, expectations, tolerance=1e-5)
    for i in range(8):
        assert_solved(lane(solution, i), arrays_of(mdp), expectations[i], 1e-5)
        np.testing.assert_array_equal(solution.occupancy[i, 3], 0.0)


def test_one_state_and_one_policy():
    case = small_models.case("one_state")
    expectations = np.array([-1.0, 2.0])
    solution = lpal(case.mdp, expectations, tolerance=1e-5)
    assert_solved(solution, case.arrays, expectations, 1e-5)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_float32(scale):
    """The certificate holds for the rounded model; where rounding keeps it open, the status says so."""
    here = dense(6, np.float32)
    expectations = (scale * here.expectations).astype(np.float32)
    solution = lpal(here.mdp, expectations, tolerance=1e-3, max_iterations=8)
    assert solution.policy.dtype == solution.margin_bound.dtype == jnp.float32
    for i, expected in enumerate(expectations):
        best = assert_certified(lane(solution, i), here.arrays, expected, eps=1e-5 * scale)
        assert solution.margin_bound[i] >= best
    is_closed = solution.margin_bound - solution.margin <= 1e-3
    stopped = Status.ITERATION_LIMIT if solution.iterations[0] == 8 else Status.STALLED
    expected = np.where(is_closed, Status.SOLVED, stopped)
    np.testing.assert_array_equal(solution.status, expected)
    assert scale > 1 or np.all(is_closed)


@pytest.mark.parametrize("seed", range(2))
def test_float32_bounds_hold_where_features_hardly_differ(seed):
    """The game is then indifferent between them, and its weights leave the simplex by more than a rounding."""
    rng = np.random.default_rng(seed)
    transition, discount, initial, feature = oracles.random_mdp(rng, 6, 2, K=1, discount=0.99)
    features = feature + 1e-6 * rng.normal(size=(6, 2, 6))
    mdp = MDP.from_dense(transition.astype(np.float32), discount=discount, initial=initial, features=features)
    sizes = -np.array([1e2, 3e2, 1e3, 3e3, 1e4, 3e4, 1e5, -1e3], np.float32)
    solution = lpal(mdp, np.repeat(sizes[:, None], 6, axis=1), tolerance=1e-5, max_iterations=8)
    for i, size in enumerate(sizes):
        best = optimum(arrays_of(mdp), np.full(6, size))
        assert solution.margin_bound[i] >= best
        np.testing.assert_allclose(solution.margin[i], best, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_warm_starts(method):
    """From a solution for other expectations: one for all lanes, or one for each."""
    here = dense(6)
    former = lpal(here.mdp, 1.01 * here.expectations, tolerance=1e-4, method=method)
    for start in (former, lane(former, 2)):
        solution = lpal(here.mdp, here.expectations, tolerance=1e-4, method=method, warm_start=start)
        for i, expectations in enumerate(here.expectations):
            assert_solved(lane(solution, i), here.arrays, expectations, 1e-4)


def test_a_warm_start_saves_columns():
    here = grid(8)
    cold = lpal(here.mdp, here.expectations["perturbed"], tolerance=1e-2)
    again = lpal(here.mdp, here.expectations["perturbed"], tolerance=1e-2, warm_start=cold)
    assert again.iterations <= 2 < cold.iterations
    assert_solved(again, here.arrays, here.expectations["perturbed"], 1e-2)


# ---------------------------------------------------------------------------------- limits, options


@pytest.mark.parametrize("method", METHODS)
def test_one_iteration_gives_valid_bounds(method):
    here = dense(6)
    solution = lpal(here.mdp, here.expectations, tolerance=1e-9, max_iterations=1, method=method)
    for i, expectations in enumerate(here.expectations):
        assert_certified(lane(solution, i), here.arrays, expectations)
    open_gap = solution.margin_bound - solution.margin > 1e-9
    assert open_gap.sum() > 4
    assert np.all(solution.status[open_gap] == Status.ITERATION_LIMIT)
    assert np.all(solution.status[~open_gap] == Status.SOLVED)


def test_the_default_tolerance_follows_discount_and_features():
    """1e-5 / (1 - discount) times the largest feature: the same columns for features in other units."""
    here = dense(6)
    tolerance = 1e-5 / (1 - 0.9) * np.abs(here.arrays[3]).max()
    solution = lpal(here.mdp, here.expectations)
    gap = solution.margin_bound - solution.margin
    assert np.all(gap <= tolerance) and gap.max() > 1e-3 * tolerance
    scaled = lpal(here.mdp.replace(features=1e3 * here.mdp.features), 1e3 * here.expectations)
    np.testing.assert_array_equal(scaled.iterations, solution.iterations)
    np.testing.assert_allclose(scaled.margin, 1e3 * solution.margin, rtol=0, atol=1e3 * tolerance)
    nothing = lpal(here.mdp.replace(features=0.0 * here.mdp.features), np.zeros((8, 6)))
    assert np.all(nothing.margin == 0) and np.all(nothing.status == Status.SOLVED)


@pytest.mark.parametrize("method", METHODS)
def test_progress_is_shown_when_asked_for(method, capsys):
    here = dense(6)
    lpal(here.mdp, here.expectations, method=method, max_iterations=2)
    assert capsys.readouterr().err == ""
    lpal(here.mdp, here.expectations, method=method, max_iterations=2, progress=True)
    assert "LPAL" in capsys.readouterr().err


# ------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("expectations", "message"),
    [
        (np.zeros(4), r"expectations must have shape \(6,\) or \(B, 6\), got \(4,\)"),
        (np.zeros((6, 4)), r"expectations must have shape \(6,\) or \(B, 6\), got \(6, 4\)"),
        (np.zeros((1, 2, 6)), r"expectations must have shape .*, got \(1, 2, 6\)"),
        (np.zeros((0, 6)), r"expectations must have shape .*, got \(0, 6\)"),
        (1.0, r"expectations must have shape .*, got \(\)"),
        (np.where(np.arange(6) == 1, np.nan, 0), r"expectations\[1\] must be finite, got nan"),
        (np.where(np.eye(6) > 0, np.inf, 0), r"expectations\[0, 0\] must be finite, got inf"),
        (["a", "b", "c", "d", "e", "f"], "expectations must hold real numbers"),
        ([[0.0], [0.0, 0.0]], "expectations is not a rectangular array"),
    ],
)
def test_expectations_that_do_not_fit_are_refused(expectations, message):
    with pytest.raises(ValueError, match=message):
        lpal(dense(6).mdp, expectations)


@pytest.mark.parametrize(
    ("initial_policy", "message"),
    [
        (np.full((2, 6), 0.5), r"initial_policy must have shape \(6, 2\) or \(B, 6, 2\), got \(2, 6\)"),
        (np.full((3, 6, 2), 0.5), r"initial_policy must have shape \(8, S, A\), got \(3, 6, 2\)"),
        (np.full((6, 2), 0.6), r"sum of initial_policy\[0\] must be 1, got 1.2"),
        (np.tile([2.0, -1.0], (6, 1)), r"initial_policy\[0, 1\] must not be negative, got -1.0"),
        (np.full((6, 2), np.nan), r"initial_policy\[0, 0\] must be finite, got nan"),
    ],
)
def test_initial_policies_that_do_not_fit_are_refused(initial_policy, message):
    here = dense(6)
    with pytest.raises(ValueError, match=message):
        lpal(here.mdp, here.expectations, initial_policy=initial_policy)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "simplex"}, r"method must be one of .*, got 'simplex'"),
        ({"tolerance": 0.0}, "tolerance must be positive, got 0.0"),
        ({"tolerance": [0.1, 0.1]}, r"tolerance must have shape \(\), got \(2,\)"),
        ({"tolerance": np.nan}, "tolerance must be finite, got nan"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        lpal(dense(6).mdp, np.zeros(6), **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda former: "solution", "warm_start must be an LPALSolution, got str"),
        (lambda former: former.replace(weights=np.ones(5)), r"warm_start.weights must have shape \(8, K\), got \(5,\)"),
        (lambda former: former.replace(weights=np.ones(6)), "sum of warm_start.weights must be 1"),
        (lambda former: former.replace(policy=former.policy[:3]), r"warm_start.policy must have shape \(8, S, A\)"),
    ],
)
def test_warm_starts_that_do_not_fit_are_refused(change, message):
    here = dense(6)
    former = lpal(here.mdp, here.expectations, tolerance=1e-4)
    with pytest.raises(ValueError, match=message):
        lpal(here.mdp, here.expectations, warm_start=change(former))


def test_a_model_without_features_is_refused():
    with pytest.raises(ValueError, match="the model has no features"):
        lpal(gridworld(4).mdp, np.zeros(0))


# ------------------------------------------------------------------------------------- prepared models


def count_calls(monkeypatch, owner, name, counts):
    made = getattr(owner, name)

    def counted(*args, **keywords):
        counts[name] = counts.get(name, 0) + 1
        return made(*args, **keywords)

    monkeypatch.setattr(owner, name, counted)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["grid", "dense"])
def test_a_prepared_model_gives_the_same_and_prepares_nothing_twice(name, method, monkeypatch):
    """Two solves through one handle are two calls of `lpal`, to the bit; the second makes no matrix and no factor."""
    here = grid(8) if name == "grid" else dense(6)
    mdp = here.mdp.replace(features=3.0 * here.mdp.features)  # in another unit than that of the methods
    first = here.expectations["Monte Carlo"] if name == "grid" else here.expectations
    options = {"method": method, "tolerance": 1e-2}
    plain = [lpal(mdp, factor * first, **options) for factor in (3.0, 2.0)]
    counts = {}
    for owner, what in (
        (certificate, "Exact"),
        (presolve.Reach, "of"),
        (interior_point, "LinearProgram"),
        (pdhg, "FlowProgram"),
        (column_rounds, "with_compact_features"),
    ):
        count_calls(monkeypatch, owner, what, counts)
    prepared = LPAL(mdp)
    solutions = [prepared.solve(3.0 * first, **options)]
    made = dict(counts)
    assert made["Exact"] == made["of"] == 1
    solutions.append(prepared.solve(2.0 * first, **options))
    assert counts == made
    jax.tree.map(np.testing.assert_array_equal, solutions, plain)


def test_a_prepared_model_has_derivatives():
    here = dense(6)
    given = jnp.asarray(here.expectations)
    expected = jax.grad(lambda e: lpal(here.mdp, e).margin.sum())(given)
    prepared = LPAL(here.mdp)
    np.testing.assert_array_equal(jax.grad(lambda e: prepared.solve(e).margin.sum())(given), expected)
    by_discount = [
        jax.grad(lambda discount, solve=solve: solve(here.mdp.replace(discount=discount)))(here.mdp.discount)
        for solve in (lambda mdp: lpal(mdp, given[0]).margin, lambda mdp: LPAL(mdp).solve(given[0]).margin)
    ]
    assert by_discount[0] == by_discount[1] != 0.0


def test_prepared_models_and_solutions_are_short_when_printed():
    here = dense(6)
    prepared = LPAL(here.mdp)
    solution = prepared.solve(here.expectations)
    assert repr(prepared).startswith("LPAL(MDP(") and len(repr(prepared)) < 500
    assert "status=[8 SOLVED]" in repr(solution) and len(repr(solution)) < 300
    assert "margin=-" in repr(prepared.solve(here.expectations[0] + 100.0))


# ------------------------------------------------------------------------------------- who is asked


@pytest.mark.parametrize(
    ("size", "name", "lanes", "guided", "first"),
    [
        (8, "perturbed", 32, False, "pdhg"),
        (8, "perturbed", 31, False, "interior_point"),
        (16, "perturbed", 1, False, "interior_point"),
        (8, "perturbed", 8, True, "interior_point"),
        (8, "perturbed", 32, True, "columns"),
        (8, "exact", 8, False, "columns"),
    ],
)
def test_auto_looks_at_lanes_and_at_what_there_is_to_begin_with(size, name, lanes, guided, first, monkeypatch):
    here, asked = grid(size), []
    for method in ("columns", "interior_point", "pdhg"):
        made = getattr(quickest, f"solve_by_{method}")
        monkeypatch.setattr(
            quickest,
            f"solve_by_{method}",
            lambda request, made=made, method=method, **options: asked.append(method) or made(request, **options),
        )
    options = {"initial_policy": here.policy} if guided else {}
    solution = lpal(here.mdp, np.tile(here.expectations[name], (lanes, 1)), tolerance=0.1, **options)
    assert asked[0] == first
    assert (solution.status == Status.SOLVED).all()
