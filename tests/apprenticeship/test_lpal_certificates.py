"""LPAL's certificates where numbers are awkward: float32, discounts near 1, features of two scales, missing actions.

The truth about a model is found in NumPy by two roads: HiGHS on the linear program without the variables of actions
that are not allowed, and from its multipliers and occupancies policy iteration and a linear solve, whose results are an
upper and a lower bound on v* that no tolerance of HiGHS can spoil.
"""

import jax
import numpy as np
import oracles
import pytest
import small_models
from scipy.optimize import linprog

import jaxhom
from jaxhom import MDP, Status, lpal
from jaxhom.apprenticeship import exact as exact_module
from jaxhom.apprenticeship.exact import Exact, exact_rows
from jaxhom.apprenticeship.flow_splitting import project_weighted_simplex
from jaxhom.apprenticeship.presolve import Reach, default_tolerance, reduce_expectations
from jaxhom.solvers.normal_equations import Rows

METHODS = ["auto", "columns", "interior_point", "pdhg"]
S, A, K = 6, 2, 3


def arrays_of(mdp, normalised=False):
    """The model's own numbers in float64; with rows as they are stored, or brought to sum 1."""
    transition, discount, initial, features = (
        np.asarray(leaf, np.float64) for leaf in (mdp.transition, mdp.discount, mdp.initial, mdp.features)
    )
    if normalised:
        total = transition.sum(axis=-1, keepdims=True)
        transition = transition / np.where(total > 0, total, 1.0)
    return transition, float(discount), initial, features


def best_value(transition, discount, reward, allowed):
    """Optimal values [S] by policy iteration over what is allowed."""
    states = np.arange(len(reward))
    actions = np.where(allowed, reward, -np.inf).argmax(axis=1)
    for _ in range(100):
        step = transition[states, actions]
        value = np.linalg.solve(np.eye(len(states)) - discount * step, reward[states, actions])
        action_value = np.where(allowed, reward + discount * transition @ value, -np.inf)
        own = action_value[states, actions]
        is_better = action_value.max(axis=1) > own + 1e-11 * np.abs(own)
        if not is_better.any():
            break
        actions = np.where(is_better, action_value.argmax(axis=1), actions)
    return value


def bounds_on_best(arrays, allowed, expectations):
    """(low, high) around v*, from HiGHS's policy and weights; the program in units of time and of each feature."""
    transition, discount, initial, features = arrays
    time, pairs = 1.0 / (1.0 - discount), np.flatnonzero(allowed)
    unit = np.abs(features).max(axis=(0, 1))
    unit = np.where(unit > 0, unit, 1.0)
    num_states, num_actions, num_features = features.shape
    flow = np.repeat(np.eye(num_states), num_actions, axis=1) - discount * transition.reshape(-1, num_states).T
    phi = features.reshape(-1, num_features)[pairs] / unit
    program = {
        "c": np.append(np.zeros(len(pairs)), -1.0),
        "A_ub": np.hstack([-phi.T, (unit.min() / unit)[:, None]]),
        "b_ub": -expectations / unit / time,
        "A_eq": np.hstack([flow[:, pairs], np.zeros((len(initial), 1))]),
        "b_eq": initial / time,
        "bounds": [(0, None)] * len(pairs) + [(None, None)],
    }
    for accuracy in (1e-10, 1e-8):  # what it cannot reach is no matter: see above
        options = {"primal_feasibility_tolerance": accuracy, "dual_feasibility_tolerance": accuracy}
        result = linprog(**program, options=options)
        if result.status == 0:
            break
    assert result.status == 0
    weights = np.maximum(-result.ineqlin.marginals, 0.0) / unit
    weights /= weights.sum()
    high = best_value(transition, discount, features @ weights, allowed) @ initial - weights @ expectations
    x = np.zeros(allowed.shape)
    x.ravel()[pairs] = np.maximum(result.x[:-1], 0.0)
    x += 1e-15 * allowed
    return oracles.margin(*arrays, expectations, x / x.sum(axis=1, keepdims=True)), high


def assert_bounds_hold(solution, mdp, expectations, *, tolerance=None):
    """margin <= v* <= margin_bound, margin <= that of the returned policy; for rows as stored and as they should be."""
    low, high = np.float64(solution.margin), np.float64(solution.margin_bound)
    for leaf in jax.tree.leaves(solution):
        assert np.isfinite(leaf).all()
    assert low <= high
    policy, allowed = np.asarray(solution.policy, np.float64), np.asarray(mdp.allowed)
    np.testing.assert_array_equal(policy.sum(axis=1), 1.0)
    np.testing.assert_array_equal(policy[~allowed], 0.0)
    for normalised in (False, True):
        arrays = arrays_of(mdp, normalised)
        size = np.abs(arrays[3]).max() / (1 - arrays[1])
        rounding = 1e-13 * size * (1 + 1e-3 / (1 - arrays[1])) + 1e-15 * np.abs(expectations).max()
        worst, best = bounds_on_best(arrays, allowed, expectations)
        assert low <= best + rounding
        assert high >= worst - rounding
        assert low <= oracles.margin(*arrays, expectations, policy) + rounding
    if tolerance is not None and solution.status == Status.SOLVED:
        assert high - low <= tolerance


# ------------------------------------------------------------------------------- features of two scales


def one_state(features, discount=0.95):
    features = np.asarray(features, float)[None]
    return MDP.from_dense(np.ones((1, features.shape[1], 1)), discount=discount, features=features)


@pytest.mark.parametrize("method", METHODS)
def test_features_of_two_scales(method):
    """The second action attains what is asked for, and all others lose 20 of the small feature: v* = 0."""
    mdp = one_state([[0, -0.9e6], [1, -1e6], [0, -0.5e6]])
    solution = lpal(mdp, np.array([20.0, -2e7]), method=method)
    assert solution.status == Status.SOLVED
    assert -1e-5 * 20 <= solution.margin <= 0.0 <= solution.margin_bound <= 1e-5 * 20


TABLE = np.random.default_rng(8).random((S, A, K))
TRANSITION, _, INITIAL, _ = oracles.random_mdp(np.random.default_rng(9), S, A, K=K)
AWKWARD = {
    "collinear, 1e8": 1e8 * TABLE[..., :1] * [1.0, 2.0, 0.5],
    "two scales": TABLE * [1.0, 1e6, 1e-3],
    "far from 0": 1e6 + TABLE,
    "cliffs": np.where(TABLE < 0.2, -1e6, TABLE),
    "1e-8": 1e-8 * TABLE,
    "duplicates": TABLE[..., [0, 0, 1]],
    "all equal": TABLE[..., [0, 0, 0]],
    "constant": np.ones((S, A, K)),
    "zero": np.zeros((S, A, K)),
    "1e300": 1e300 * TABLE,
    "1e-300": 1e-300 * TABLE,
}


CASES = [(name, method) for name in AWKWARD for method in ("columns", "interior_point")]
CASES += [(name, "pdhg") for name in ("collinear, 1e8", "two scales", "cliffs", "1e300")]


@pytest.mark.parametrize(("name", "method"), CASES)
def test_awkward_features(name, method):
    """Solved, whatever the units; a gap is small against each feature's range in all of them."""
    features = AWKWARD[name]
    mdp = MDP.from_dense(TRANSITION, discount=0.9, initial=INITIAL, features=features)
    policy = small_models.random_policy(np.random.default_rng(1), S, A)
    expectations = oracles.feature_expectations(TRANSITION, 0.9, INITIAL, features, policy) * [1.1, 0.9, 1.0]
    solution = lpal(mdp, expectations, method=method)
    size = np.abs(features).max() or 1.0
    scaled = mdp.replace(features=features / size)
    inside = solution.replace(margin=solution.margin / size, margin_bound=solution.margin_bound / size)
    assert_bounds_hold(inside, scaled, expectations / size)
    assert solution.status == Status.SOLVED
    ranges = np.ptp(features, axis=(0, 1))
    least = ranges[ranges > 0].min(initial=size) if name != "cliffs" else 2.0
    assert solution.margin_bound - solution.margin <= 1.01e-5 * 10 * least


def test_one_feature_of_awkward_size():
    mdp = MDP.from_dense(TRANSITION, discount=0.9, initial=INITIAL, features=1e-8 * TABLE[..., :1])
    solution = lpal(mdp, np.zeros(1))
    best = best_value(TRANSITION, 0.9, 1e-8 * TABLE[..., 0], np.ones((S, A), bool)) @ INITIAL
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose([solution.margin, solution.margin_bound], best, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("features", "scale"),
    [
        ([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]], 1.0),  # indicators
        ([[0.0, -0.9e6], [1.0, -1e6], [0.0, -0.5e6]], 1.0),
        ([[0.0, 5.0], [1.0, 5.0], [-1e6, 5.0]], 2.0),  # a cliff, and a constant
        ([[0.1 + 0.2, 0.0], [0.3, 4.0], [0.3, 0.0]], 4.0),  # a constant up to rounding
        ([[1.0, 3.0], [1.0, 3.0], [1.0, 3.0]], 3.0),  # nothing but constants
        ([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], 1.0),
    ],
)
def test_the_default_tolerance_is_small_against_what_features_can_do(features, scale):
    mdp = one_state(features)
    expectations = 20.0 * np.asarray(features)[1:2]  # those of the second action
    reach = Reach.of(mdp)
    reduction = reduce_expectations(reach, expectations)
    np.testing.assert_allclose(default_tolerance(reach, reduction), 1e-5 / 0.05 * scale, rtol=1e-12)


def test_features_that_are_never_the_smallest_have_no_say_in_the_tolerance():
    mdp = one_state([[0.0, 0.0], [1e-8, 1.0]])
    reach = Reach.of(mdp)
    reduction = reduce_expectations(reach, np.array([[-100.0, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(default_tolerance(reach, reduction), [1e-5 / 0.05, 1e-13 / 0.05], rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_factorisations_that_fail(method, monkeypatch):
    """Whatever rounding does to them, bounds are there."""

    def fail(self, d):
        raise np.linalg.LinAlgError("leading minor 1 of a block is not positive definite")

    monkeypatch.setattr(Rows, "factor", fail)
    mdp = MDP.from_dense(TRANSITION, discount=0.9, initial=INITIAL, features=TABLE)
    expectations = np.array([5.0, 4.0, 6.0])
    solution = lpal(mdp, expectations, method=method)
    assert_bounds_hold(solution, mdp, expectations)
    assert solution.status == (Status.STALLED if method == "interior_point" else Status.SOLVED)


@pytest.mark.parametrize(
    ("features", "expectations", "message"),
    [
        (1e303 * TABLE, np.zeros(K), r"features\[0, 0, 0\] is too large for sums over time in float64"),
        (TABLE, np.array([0.0, 1e305, 0.0]), r"expectations\[1\] is too large for margins in float64"),
    ],
)
def test_numbers_that_overflow_are_refused(features, expectations, message):
    mdp = MDP.from_dense(TRANSITION, discount=0.9, initial=INITIAL, features=features)
    with pytest.raises(ValueError, match=message):
        lpal(mdp, expectations)


# --------------------------------------------------------------------------------- types and discounts


def slow(rng):
    """Most of the time nothing happens."""
    chance = 10 ** -rng.uniform(1, 6, size=(S, A, 1))
    return (1 - chance) * np.eye(S)[:, None] + chance * np.eye(S)[rng.integers(S, size=(S, A))]


MODELS = {
    "random": lambda rng: oracles.random_mdp(rng, S, A, K=K)[0],
    "sevenths": lambda rng: np.eye(S)[rng.integers(S, size=(S, A, 7))].mean(axis=2),
    "deterministic": lambda rng: np.eye(S)[rng.integers(S, size=(S, A))],
    "slow": slow,
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", MODELS)
def test_bounds_hold_in_both_types_at_every_discount(name, dtype):
    """Solved where the type can be, and never a margin above the best possible."""
    rng = np.random.default_rng(len(name))
    for discount in (0.9, 0.99, 0.999, 0.9999, 0.99999):
        transition, initial, features = MODELS[name](rng), rng.dirichlet(np.ones(S)), rng.random((S, A, K))
        mdp = MDP.from_dense(transition.astype(dtype), discount=discount, initial=initial, features=features)
        policy = small_models.random_policy(rng, S, A)
        exact = oracles.feature_expectations(*arrays_of(mdp), policy)
        for expectations in (exact, exact * rng.uniform(0.8, 1.2, size=K)):
            solution = lpal(mdp, expectations)
            assert_bounds_hold(solution, mdp, expectations, tolerance=1.01e-5 / (1 - float(mdp.discount)))
            if dtype == np.float64 or discount < 0.95:
                assert solution.status == Status.SOLVED
            else:
                assert solution.status in (Status.SOLVED, Status.STALLED)


def test_rows_with_six_decimals():
    """Seven times 0.142857 is 0.999999: what is returned is consistent all the same."""
    rng = np.random.default_rng(3)
    transition = np.round(MODELS["sevenths"](rng), 6)
    mdp = MDP.from_dense(transition, discount=0.9999, initial=INITIAL, features=TABLE)
    solution = lpal(mdp, np.array([4000.0, 5000.0, 6000.0]))
    assert solution.status == Status.SOLVED
    assert_bounds_hold(solution, mdp, np.array([4000.0, 5000.0, 6000.0]))
    np.testing.assert_allclose(solution.occupancy.sum(), 1e4, rtol=1e-9)


def test_rough_guesses_are_accounted_for():
    """Whatever mu and V are guessed, the bounds that they prove hold; with and without linear solves behind them."""
    rng = np.random.default_rng(5)
    mdp = MDP.from_dense(TRANSITION, discount=0.99, initial=INITIAL, features=TABLE)
    exact, weights = Exact(mdp), np.array([0.2, 0.8, 0.0])
    policy = exact_rows(small_models.random_policy(rng, S, A), float)
    true = oracles.feature_expectations(TRANSITION, 0.99, INITIAL, TABLE, policy)
    mu = oracles.occupancy(TRANSITION, 0.99, INITIAL, policy).sum(axis=1)
    value = best_value(TRANSITION, 0.99, TABLE @ weights, np.ones((S, A), bool))
    for noise in (0.0, 1e-9, 1e-4, 0.1):
        _, expected, error = exact.expectations(policy, mu * (1 + noise * rng.normal(size=S)), np.inf)
        assert np.all(np.abs(expected - true) <= error + 1e-12)
        bound, *_ = exact.plan(weights, value + noise * rng.normal(size=S), None, np.inf)
        assert bound >= value @ INITIAL
        assert noise or (error.max() <= 1e-9 and bound <= value @ INITIAL + 1e-9)


@pytest.mark.parametrize("is_direct", [True, False])
def test_solves_on_the_host(is_direct, monkeypatch):
    """By LU, and by Krylov steps where a factor would fill up."""
    monkeypatch.setattr(exact_module.Exact, "is_direct", is_direct)
    case = small_models.case("restart")
    exact, rng = Exact(case.mdp), np.random.default_rng(0)
    policy = exact_rows(small_models.random_policy(rng, *case.shape), float)
    mu, expected, error = exact.expectations(policy, None, 1e-6)
    x = oracles.occupancy(case.transition, case.discount, case.initial, policy)
    np.testing.assert_allclose(mu, x.sum(axis=1), rtol=0, atol=1e-7)
    true = oracles.feature_expectations(*case.arrays, policy)
    assert np.all(np.abs(expected - true) <= error + 1e-12) and error.max() <= 1e-6
    bound, value, actions = exact.plan(np.array([0.3, 0.7]), None, None, 1e-6)
    best, action_value = oracles.optimal_value(case.transition, case.discount, case.features @ [0.3, 0.7])
    assert best @ case.initial <= bound <= best @ case.initial + 1e-6
    np.testing.assert_allclose(value, best, rtol=0, atol=1e-6)
    own = np.take_along_axis(action_value, actions[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(own, action_value.max(axis=1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rows_that_sum_to_exactly_one(dtype, rng):
    policy = small_models.random_policy(rng, 200, 7)
    policy[:50, 2:] = 0.0
    policy /= policy.sum(axis=1, keepdims=True)
    rows = exact_rows(policy, dtype)
    assert rows.dtype == dtype
    np.testing.assert_array_equal(rows.astype(float).sum(axis=1), 1.0)
    np.testing.assert_array_equal(rows[:50, 2:], 0.0)
    np.testing.assert_allclose(rows, policy, rtol=0, atol=8 * np.finfo(dtype).eps)


# ----------------------------------------------------------------------------------------------- limits


def grid():
    mdp = jaxhom.gridworld(8, num_regions=16).mdp
    expert = jaxhom.optimal_policy(mdp, mdp.features[..., 15]).policy
    expectations = np.asarray(jaxhom.feature_expectations(mdp, expert))
    return mdp, expectations * np.random.default_rng(0).uniform(0.5, 1.5, size=16)


def test_a_limit_does_not_change_the_method():
    """On this grid the interior point begins: with a limit too, and a generous limit changes nothing."""
    mdp, expectations = grid()
    free, limited = lpal(mdp, expectations), lpal(mdp, expectations, max_iterations=400)
    jax.tree.map(np.testing.assert_array_equal, free, limited)
    few = lpal(mdp, expectations, max_iterations=2)
    alone = lpal(mdp, expectations, max_iterations=2, method="interior_point")
    jax.tree.map(np.testing.assert_array_equal, few, alone)
    assert few.status == Status.ITERATION_LIMIT and few.iterations == 2


@pytest.mark.parametrize(("method", "limit"), [("auto", 3), ("columns", 3), ("interior_point", 3), ("pdhg", 32)])
def test_limits_are_kept_and_named(method, limit):
    mdp, expectations = grid()
    solution = lpal(mdp, expectations, method=method, max_iterations=limit, tolerance=1e-7)
    assert solution.iterations == limit
    assert solution.status == Status.ITERATION_LIMIT
    assert solution.margin <= solution.margin_bound


def test_what_stalls_says_so():
    """No limit, and a tolerance below what rounding leaves."""
    mdp, expectations = grid()
    solution = lpal(mdp, expectations, method="interior_point", tolerance=1e-15)
    assert solution.status == Status.STALLED
    assert solution.iterations < 100


@pytest.mark.parametrize("limit", [0, -1, 1.5, "many"])
def test_limits_out_of_range_are_refused(limit):
    mdp, expectations = grid()
    with pytest.raises(ValueError, match="max_iterations must be"):
        lpal(mdp, expectations, max_iterations=limit)


# --------------------------------------------------------------------------------- actions that are missing


def with_missing_actions(dtype=np.float64, sparse=False):
    """A model in which every other action is missing, and what is not allowed would be worth most."""
    rng = np.random.default_rng(12)
    transition, features = TRANSITION, TABLE.copy()
    if sparse:
        transition = small_models.case("restart").transition
        features = rng.random((*transition.shape[:2], K))
    allowed = rng.random(transition.shape[:2]) < 0.6
    allowed[np.arange(len(allowed)), rng.integers(allowed.shape[1], size=len(allowed))] = True
    features[~allowed] = 1e3
    return MDP.from_dense(transition.astype(dtype), discount=0.9, features=features, allowed=allowed)


@pytest.mark.parametrize(
    ("method", "sparse"),
    [("auto", False), ("columns", True), ("interior_point", False), ("interior_point", True), ("pdhg", False)],
)
def test_what_is_not_allowed_is_not_done(method, sparse):
    """HiGHS on the program without those variables; expectations of policies, perturbed, and out of reach."""
    mdp = with_missing_actions(sparse=sparse)
    allowed = np.asarray(mdp.allowed)
    assert mdp.restricts_actions and mdp.is_dense != sparse
    exact = oracles.feature_expectations(*arrays_of(mdp), allowed / allowed.sum(axis=1, keepdims=True))
    batch = np.stack([exact, exact * [1.2, 0.8, 1.0], [1e4, 1e4, -1e4]])
    solution = lpal(mdp, batch, method=method)
    for lane, expectations in enumerate(batch):
        alone = jax.tree.map(lambda leaf, lane=lane: leaf[lane], solution)
        assert_bounds_hold(alone, mdp, expectations, tolerance=1.01e-4)
        assert alone.status == Status.SOLVED
    again = lpal(mdp, batch, method=method, warm_start=solution)
    np.testing.assert_array_equal(np.asarray(again.policy)[:, ~allowed], 0.0)


def test_first_guesses_that_do_what_is_not_allowed_are_refused():
    mdp = with_missing_actions()
    with pytest.raises(ValueError, match=r"initial_policy\[.*\] is an action that is not allowed"):
        lpal(mdp, np.zeros(K), initial_policy=np.full((S, A), 0.5))


def test_float32_with_missing_actions():
    mdp = with_missing_actions(np.float32)
    expectations = np.array([5.0, 4.0, 6.0])
    assert_bounds_hold(lpal(mdp, expectations), mdp, expectations)


# ------------------------------------------------------------------------------------- parts of PDHG


def test_projection_on_a_weighted_simplex(rng):
    """The conditions of optimality: q - point = -t share where q > 0, and at least that elsewhere."""
    share = 10.0 ** -rng.uniform(0, 6, size=8)
    point = rng.normal(size=(8, 5)) * 10.0 ** rng.uniform(-3, 3, size=5)
    q = np.asarray(project_weighted_simplex(point, share, 3.0))
    assert q.min() >= 0
    np.testing.assert_allclose(share @ q, 3.0, rtol=1e-9)
    t = (point - q) / share[:, None]
    for lane in range(5):
        threshold = t[q[:, lane] > 0, lane]
        size = np.abs(point[:, lane]).max() / share.min()
        np.testing.assert_allclose(threshold, threshold[0], rtol=1e-6, atol=1e-9 * size)
        assert np.all(t[q[:, lane] == 0, lane] <= threshold[0] + 1e-9 * size)


@pytest.mark.parametrize("discount", [0.9, 0.999])
def test_float32_bounds_hold_for_an_initial_distribution_that_misses_one(discount):
    """A seventh seven times is 1 + 4.5e-8: one feature, whose best expectation planning gives to the last digit."""
    rng = np.random.default_rng(3)
    transition = np.eye(7)[rng.integers(7, size=(7, 2))]
    features, initial = rng.random((7, 2, 1)).astype(np.float32), np.full(7, 1 / 7, np.float32)
    assert initial.sum(dtype=float) > 1
    mdp = MDP.from_dense(transition.astype(np.float32), discount=discount, initial=initial, features=features)
    value, _ = oracles.optimal_value(transition, float(mdp.discount), features[..., 0].astype(float))
    stored = np.asarray(mdp.initial, float)
    bests = [start @ value for start in (stored, stored / stored.sum())]
    expected = np.float32(bests[0])
    solution = lpal(mdp, np.array([expected]))
    assert solution.margin <= min(bests) - float(expected)
    assert max(bests) - float(expected) <= solution.margin_bound
