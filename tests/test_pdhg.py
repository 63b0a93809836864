"""The PDHG engine and its parts: projections against jaxopt, products against einsum, values against HiGHS."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models
from jaxopt.projection import projection_l1_ball, projection_simplex
from scipy.optimize import linprog

from jaxhom.pdhg import Status, engine, projections, solve_many
from jaxhom.pdhg.flow_lp import FlowProblem
from jaxhom.pdhg.homomorphism_lp import HomomorphismProblem, plain_adjoint, plain_forward
from jaxhom.pdhg.matrix_game import MatrixGame
from jaxhom.pdhg.projections import project_l1_ball, project_simplex, reduce_leading

DTYPES = [np.float32, np.float64]


def game_value(payoff):
    """Value of the game of the row player w, who pays: min over w of max_j (M^T w)_j."""
    rows, columns = payoff.shape
    result = linprog(
        np.append(np.zeros(rows), 1.0),
        A_ub=np.hstack([payoff.T, -np.ones((columns, 1))]),
        b_ub=np.zeros(columns),
        A_eq=np.append(np.ones(rows), 0.0)[None],
        b_eq=[1.0],
        bounds=[(0, None)] * rows + [(None, None)],
        method="highs",
    )
    assert result.success
    return result.fun


# ----------------------------------------------------------------------------------- projections


def points(dtype, length):
    """Name -> [length, 3]: arguments of a projection, of every size that an iteration can make."""
    rng = np.random.default_rng(length)
    shape = (length, 3)
    distribution = rng.dirichlet(np.ones(length), size=3).T
    one_large = np.zeros(shape)
    one_large[-1] = [1e3, 1e6, -1e6]
    cases = {
        "normal": rng.normal(size=shape),
        "around the simplex": distribution + 0.01 * rng.normal(size=shape),
        "huge": 1e6 * rng.normal(size=shape),
        "large and close": 1e3 + rng.integers(-1, 2, size=shape) / 2.0,
        "tiny": 1e-6 * rng.normal(size=shape),
        "tied": rng.integers(-1, 2, size=shape) / 2.0,
        "all equal": np.full(shape, [0.3, 1.0, -2.0]),
        "zero": np.zeros(shape),
        "feasible": distribution,
        "inside the ball": 0.9 * distribution * rng.choice([-1, 1], size=shape),
        "corner of the simplex": np.eye(length, 3),
        "one large entry": one_large,
        "negative": -rng.uniform(1, 5, size=shape),
    }
    return {name: point.astype(dtype) for name, point in cases.items()}


def assert_projects(dtype, cases):
    """Onto the simplex and the ball, all cases in one call; jaxopt in float64 is the oracle.

    A threshold next to the largest entry is good to that entry's rounding. jaxopt's own is not always: it sums
    all entries, hence the shift.
    """
    stacked = np.concatenate(list(cases.values()), axis=1)
    exact = stacked.astype(float)
    onto_simplex = np.asarray(jax.jit(project_simplex)(stacked))
    onto_ball = np.asarray(jax.jit(functools.partial(project_l1_ball, axes=(0,)))(stacked))
    assert onto_simplex.dtype == onto_ball.dtype == dtype
    every_lane = functools.partial(jax.vmap, in_axes=1, out_axes=1)
    expected_simplex = every_lane(projection_simplex)(exact - exact.max(axis=0))
    expected_ball = every_lane(projection_l1_ball)(exact)
    largest = np.maximum(1.0, np.abs(exact.max(axis=0)))
    rounding = 4 * np.finfo(dtype).eps * largest
    worst = np.abs(onto_simplex - expected_simplex).max(axis=0) / rounding
    assert_lanes(worst <= 1, cases, "simplex")
    assert_lanes((onto_simplex >= 0).all(axis=0), cases, "not negative")
    rounding = 4 * np.finfo(dtype).eps * np.maximum(1.0, np.abs(exact).max(axis=0))
    oracle_rounding = 1e-16 * np.abs(exact).sum(axis=0)
    worst = np.abs(onto_ball - expected_ball).max(axis=0) / (rounding + oracle_rounding)
    assert_lanes(worst <= 1, cases, "ball")
    assert_lanes(np.abs(onto_ball).sum(axis=0) <= 1 + len(stacked) * rounding, cases, "norm")


def assert_lanes(good, cases, what):
    wrong = [name for i, name in enumerate(cases) if not good[3 * i : 3 * i + 3].all()]
    assert not wrong, f"{what}: {wrong}"


@pytest.mark.parametrize("length", [1, 7, 40])
@pytest.mark.parametrize("dtype", DTYPES)
def test_projections_against_jaxopt(dtype, length):
    assert_projects(dtype, points(dtype, length))


@pytest.mark.parametrize(
    "dtype",
    [
        np.float64,
        pytest.param(
            np.float32,
            marks=pytest.mark.xfail(
                reason="the threshold is kept as a number next to 1e6, where float32 moves by 1/16", strict=True
            ),
        ),
    ],
)
def test_projections_of_huge_ties(dtype, rng):
    close = 1e6 + rng.integers(-1, 2, size=(40, 3))
    assert_projects(dtype, {"tied": np.full((40, 3), 1e6, dtype), "close": close.astype(dtype)})


@pytest.mark.parametrize("dtype", DTYPES)
def test_points_of_the_ball_stay_where_they_are(dtype):
    point = points(dtype, 7)["inside the ball"]
    np.testing.assert_array_equal(project_l1_ball(point, axes=(0,)), point)


def test_simplex_of_another_total_along_another_axis():
    """proj onto {x >= 0, sum x = t} is t times the projection of point / t onto the simplex."""
    point = np.random.default_rng(0).normal(size=(3, 7, 4))
    total = np.array([0.5, 1.0, 2.0, 30.0])
    result = project_simplex(point, total, axis=1)
    for i, lane in np.ndindex(3, 4):
        expected = total[lane] * projection_simplex(point[i, :, lane] / total[lane])
        np.testing.assert_allclose(result[i, :, lane], expected, rtol=0, atol=1e-13)


def test_ball_over_several_axes():
    point = np.random.default_rng(1).normal(size=(2, 3, 4, 5))
    result = project_l1_ball(point, axes=(0, 1, 2))
    for lane in range(5):
        expected = projection_l1_ball(point[..., lane].ravel()).reshape(2, 3, 4)
        np.testing.assert_allclose(result[..., lane], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("project", [project_simplex, functools.partial(project_l1_ball, axes=(0,))])
def test_a_lane_that_is_not_a_number_stays_so_and_spoils_no_other(project):
    point = np.random.default_rng(2).normal(size=(7, 3))
    spoilt = point.copy()
    spoilt[0, 0] = np.nan
    result = project(spoilt)
    assert np.isnan(result[:, 0]).any()
    np.testing.assert_allclose(result[:, 1:], project(point)[:, 1:], rtol=0, atol=1e-14)


# ------------------------------------------------------------------------------ sums over leading axes

_LENGTHS = [1, 2, 31, 32, 33, 34, 63, 64, 65, 96, 97, 100]


@pytest.mark.parametrize("length", _LENGTHS)
def test_reduce_leading_of_every_remainder(length):
    array = np.random.default_rng(length).normal(size=(length, 3))
    total, largest = jax.jit(
        lambda x: (reduce_leading(x, (0,)), reduce_leading(x, (0,), jnp.maximum))
    )(array)
    np.testing.assert_allclose(total, jnp.sum(array, axis=0), rtol=0, atol=1e-13)
    np.testing.assert_array_equal(largest, jnp.max(array, axis=0))


def test_reduce_leading_nests_its_groups(monkeypatch):
    """Chains of three terms: lengths up to 40 go three levels deep, with every remainder."""
    monkeypatch.setattr(projections, "_MAX_TERMS", 3)
    array = np.random.default_rng(0).normal(size=(40, 2))
    totals = jax.jit(lambda x: [reduce_leading(x[:n], (0,)) for n in range(1, 41)])(array)
    np.testing.assert_allclose(totals, np.cumsum(array, axis=0), rtol=0, atol=1e-13)


@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1), (2, 0), (0, 1, 2)])
def test_reduce_leading_over_several_axes(axes):
    array = np.random.default_rng(3).normal(size=(3, 2, 35, 4))
    np.testing.assert_allclose(
        jax.jit(functools.partial(reduce_leading, axes=axes))(array),
        array.sum(axis=axes),
        rtol=0,
        atol=1e-13,
    )


# --------------------------------------------------------------------------------------- products

SIZES = [(1, 1), (3, 5), (5, 2), (17, 16)]  # the last one is beyond what is written out


def random_pair(rng, n, m, num_actions=3, lanes=4, dtype=float):
    """Transition tensors of random models, lanes last, with Dirichlet(1/2) rows."""
    models = (rng.dirichlet(np.full(k, 0.5), size=(lanes, k, num_actions)) for k in (n, m))
    return [np.moveaxis(model, 0, -1).astype(dtype) for model in models]


def homomorphism_problem(source, target, anchored=False):
    lanes = source.shape[-1]
    return HomomorphismProblem(
        source=jnp.asarray(source),
        target=jnp.asarray(target),
        source_size=jnp.full(lanes, len(source), jnp.int32),
        target_size=jnp.full(lanes, len(target), jnp.int32),
        anchored=anchored,
    )


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_homomorphism_products(n, m, rng):
    source, target = random_pair(rng, n, m)
    problem = homomorphism_problem(source, target)
    f, y = rng.normal(size=(n, m, 4)), rng.normal(size=(n, 3, m, 4))
    forward, adjoint = jax.jit(lambda: (problem.forward(f), problem.adjoint(y)))()
    for lane in range(4):
        models = source[..., lane], target[..., lane]
        expected = plain_forward(*models, f[..., lane])
        np.testing.assert_allclose(forward[..., lane], expected, rtol=0, atol=1e-13)
        residual = oracles.homomorphism_residual(*models, f[..., lane])
        assert np.abs(forward[..., lane]).max() == pytest.approx(residual, rel=1e-12)
        expected = plain_adjoint(*models, y[..., lane])
        np.testing.assert_allclose(adjoint[..., lane], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose((y * forward).sum((0, 1, 2)), (f * adjoint).sum((0, 1)), rtol=1e-11)


@pytest.mark.parametrize("lanes", [1, 4])
def test_game_products(lanes, rng):
    payoff = rng.normal(size=(5, 7, lanes))
    game = MatrixGame(payoff=jnp.asarray(payoff), is_column=jnp.ones((7, lanes), bool))
    w, q = rng.normal(size=(5, lanes)), rng.normal(size=(7, lanes))
    forward, adjoint = game.forward(w), game.adjoint(q)
    np.testing.assert_allclose(forward, np.einsum("kmb,kb->mb", payoff, w), rtol=0, atol=1e-13)
    np.testing.assert_allclose(adjoint, np.einsum("kmb,mb->kb", payoff, q), rtol=0, atol=1e-13)


@pytest.mark.parametrize("lanes", [1, 3])
@pytest.mark.parametrize("name", ["dense", "absorbing", "restart"])
def test_flow_products(name, lanes, rng):
    """forward is Phi w + (gamma T h - h) / (1 - gamma), and adjoint its transpose."""
    case = small_models.case(name)
    problem = FlowProblem(mdp=case.mdp, expectations=jnp.zeros((case.features.shape[2], lanes)))
    num_states = case.shape[0]
    w, h = rng.normal(size=(case.features.shape[2], lanes)), rng.normal(size=(num_states, lanes))
    x = rng.normal(size=(*case.shape, lanes))
    primal = np.concatenate([w, h])
    forward, adjoint = jax.jit(lambda: (problem.forward(primal), problem.adjoint(x)))()
    moved = case.discount * np.einsum("saz,zb->sab", case.transition, h) - h[:, None]
    expected = np.einsum("sak,kb->sab", case.features, w) + moved / (1 - case.discount)
    np.testing.assert_allclose(forward, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        (x * forward).sum((0, 1)), (primal * adjoint).sum(0), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize(("n", "m"), [(3, 5), (5, 2)])
@pytest.mark.parametrize("anchored", [True, False])
def test_padding_changes_nothing(n, m, anchored, rng):
    """A pair padded to 6 x 6: same start, products, projections and bounds on the real entries, zero elsewhere."""
    source, target = random_pair(rng, n, m)
    plain = homomorphism_problem(source, target, anchored)
    room = [(0, 6 - n), (0, 0), (0, 6 - n), (0, 0)], [(0, 6 - m), (0, 0), (0, 6 - m), (0, 0)]
    padded = homomorphism_problem(np.pad(source, room[0]), np.pad(target, room[1]), anchored)
    sizes = jnp.full(4, n, jnp.int32), jnp.full(4, m, jnp.int32)
    padded = HomomorphismProblem(
        source=padded.source,
        target=padded.target,
        source_size=sizes[0],
        target_size=sizes[1],
        anchored=anchored,
    )
    f, y = rng.normal(size=(6, 6, 4)), np.zeros((6, 3, 6, 4))
    y[:n, :, :m] = rng.normal(size=(n, 3, m, 4))

    @jax.jit
    def everything(problem, f, y):
        f, y = problem.project_primal(f, None), problem.project_dual(y, None)
        forward, adjoint = problem.forward(f), problem.adjoint(y)
        return problem.start()[0], f, y, forward, problem.bounds(f, y, forward, adjoint)

    small = everything(plain, f[:n, :m], y[:n, :, :m])
    large = everything(padded, f, y)
    cut = large[0][:n, :m], large[1][:n, :m], large[2][:n, :, :m], large[3][:n, :, :m], large[4]
    chex.assert_trees_all_close(cut, small, rtol=0, atol=1e-13)
    for array, real in zip(large[:4], small[:4], strict=True):
        np.testing.assert_allclose(np.abs(array).sum(), np.abs(real).sum(), rtol=1e-12)


# ------------------------------------------------------------------------------------ step lengths


def operator(problem, size):
    """K as a matrix, lane 0, from its products with unit vectors."""
    shape = problem.start()[0].shape[:-1]
    columns = [
        np.asarray(problem.forward(unit.reshape(*shape, 1))).ravel() for unit in np.eye(size)
    ]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_steps_are_short_enough(seed):
    """eta |K| < 1, the condition of convergence, and |K| within the problem's own bound; SVD is the oracle."""
    rng = np.random.default_rng(seed)
    case = small_models.case(["dense", "absorbing", "one_action"][seed])
    num_features = case.features.shape[2]
    problems = [
        homomorphism_problem(*random_pair(rng, 4, 3, lanes=1)),
        MatrixGame(payoff=jnp.asarray(rng.normal(size=(5, 7, 1))), is_column=jnp.ones((7, 1), bool)),
        FlowProblem(mdp=case.mdp, expectations=jnp.zeros((num_features, 1))),
    ]
    for problem, size in zip(problems, (12, 5, num_features + case.shape[0]), strict=True):
        norm = np.linalg.norm(operator(problem, size), 2)
        assert norm <= problem.norm_bound()[0] * (1 + 1e-12)
        eta = float(engine.init(problem).eta[0])
        assert 0.5 < eta * norm < 1


# ------------------------------------------------------------------------------------------ bounds


@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(3, 5), (17, 16)])
def test_homomorphism_bounds_of_feasible_points(n, m, dtype, anchored, rng):
    """Random points, and the optimal map of HiGHS: bounds hold strictly, rounding included."""
    lanes = 2 if n > 10 else 6
    source, target = random_pair(rng, n, m, lanes=lanes, dtype=dtype)
    problem = homomorphism_problem(source, target, anchored)
    answers = [
        oracles.homomorphism_lp(source[..., b].astype(float), target[..., b].astype(float), anchored)
        for b in range(lanes)
    ]
    error, best = (np.stack(leaves, axis=-1) for leaves in zip(*answers, strict=True))

    @jax.jit
    def bounds(f, y):
        f, y = problem.project_primal(f, None), problem.project_dual(y, None)
        return problem.bounds(f, y, problem.forward(f), problem.adjoint(y))

    for scale in (0.1, 1.0, 10.0):
        f = (best + scale * rng.normal(size=best.shape)).astype(dtype)
        y = (scale * rng.normal(size=(n, 3, m, lanes))).astype(dtype)
        lower, upper = bounds(f, y)
        assert np.all(lower >= 0) and np.all(lower <= error + 1e-9)
        assert np.all(upper >= error - 1e-9)
    _, upper = bounds(best.astype(dtype), y)
    slack = 1e-7 + 20 * (n + m) * np.finfo(dtype).eps
    assert np.all(upper >= error - 1e-9) and np.all(upper <= error + slack)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("constant", [None, 0.1, -3.3])
def test_game_bounds_of_feasible_points(dtype, constant, rng):
    """A constant game has one value for all strategies, so its bounds can only be good to rounding."""
    payoff = (rng.normal(size=(5, 7, 6)) if constant is None else np.full((5, 7, 6), constant)).astype(dtype)
    is_column = np.arange(7)[:, None] < np.array([7, 7, 1, 2, 4, 6])
    game = MatrixGame(payoff=jnp.asarray(payoff), is_column=jnp.asarray(is_column))
    value = [game_value(payoff[:, is_column[:, b], b].astype(float)) for b in range(6)]
    rounding = 16 * np.finfo(dtype).eps * np.abs(payoff).max() + 1e-12
    for _ in range(5):
        w = game.project_primal(rng.normal(size=(5, 6)).astype(dtype), None)
        q = game.project_dual(rng.normal(size=(7, 6)).astype(dtype), None)
        assert np.all(np.asarray(q)[~is_column] == 0)
        lower, upper = game.bounds(w, q, game.forward(w), game.adjoint(q))
        assert np.all(lower <= value + rounding) and np.all(upper >= value - rounding)


@functools.cache
def lpal_value(name, in_float32=False):
    """A model, expectations that no policy reaches exactly, and the margin by HiGHS."""
    case = small_models.case(name)
    if in_float32:
        case = small_models.in_float32(case)
    rng = np.random.default_rng(11)
    shape = case.features.shape[2]
    expectations = rng.uniform(0.3, 0.7, size=shape).astype(case.mdp.dtype) / (1 - case.discount)
    return case, expectations, oracles.lpal(*case.arrays, expectations.astype(float))[0]


@pytest.mark.parametrize("in_float32", [False, True])
@pytest.mark.parametrize("name", ["dense", "absorbing", "restart"])
def test_flow_bounds_of_feasible_points(name, in_float32, rng):
    case, expectations, margin = lpal_value(name, in_float32)
    scaled = ((1 - case.discount) * expectations[:, None]).astype(case.mdp.dtype)
    problem = FlowProblem(mdp=case.mdp, expectations=jnp.asarray(scaled))
    primal, x = problem.start()
    policy = small_models.random_policy(rng, *case.shape)
    flow = (1 - case.discount) * oracles.occupancy(*case.arrays[:3], policy)[..., None]

    @jax.jit
    def bounds(primal, x):
        primal = problem.project_primal(primal, jnp.zeros(1, case.mdp.dtype))
        x = problem.project_dual(x, None)
        return problem.bounds(primal, x, problem.forward(primal), problem.adjoint(x))

    rounding = 200 * np.finfo(case.mdp.dtype).eps / (1 - case.discount)
    for point in (x, flow.astype(case.mdp.dtype), rng.normal(size=x.shape).astype(case.mdp.dtype)):
        noise = rng.normal(size=primal.shape).astype(case.mdp.dtype)
        lower, upper = bounds(primal + noise, point)
        assert lower[0] <= (1 - case.discount) * margin + rounding
        assert upper[0] >= (1 - case.discount) * margin - rounding
    # an occupancy's bound is its policy's margin: nothing is lost to the flow
    lower, _ = bounds(primal, flow.astype(case.mdp.dtype))
    true_margin = oracles.margin(*case.arrays, expectations.astype(float), policy)
    assert float(lower[0]) == pytest.approx((1 - case.discount) * true_margin, abs=rounding)


# -------------------------------------------------------------------------------------- the engine


@functools.cache
def games():
    """16 games of at most 6 x 8 and their values: absent columns, ties, constants, saddles, sizes."""
    rng = np.random.default_rng(5)
    payoff = rng.normal(size=(6, 8, 16))
    payoff[..., 1] *= 1e-3
    payoff[..., 2] *= 1e3
    payoff[..., 3] = 0.7
    payoff[..., 4] = 0.0
    payoff[..., 5] = np.sign(payoff[..., 5])
    payoff[:, :, 6] = payoff[:, :1, 6]  # all columns alike
    payoff[..., 7] = payoff[:1, :, 7]  # all rows alike
    payoff[:6, :6, 8] = np.eye(6)
    payoff[..., 9] += 100.0
    payoff[..., 10] = np.arange(6)[:, None] + np.arange(8)  # a pure saddle
    num_columns = np.full(16, 8)
    num_columns[8] = 6
    num_columns[11:] = [1, 2, 3, 5, 7]
    is_column = np.arange(8)[:, None] < num_columns
    values = [game_value(payoff[:, : num_columns[b], b]) for b in range(16)]
    return MatrixGame(payoff=payoff, is_column=is_column), np.array(values)


def relative_tolerance(game, tolerance):
    return tolerance * np.maximum(np.abs(game.payoff).max(axis=(0, 1)), 1e-3)


@jax.jit
def solve(problem, tolerance, max_iterations=100_000):
    return engine.solve(
        problem, engine.init(problem), tolerance=tolerance, max_iterations=max_iterations
    )


def assert_brackets(state, values, slack=1e-9):
    slack = slack * (1 + np.abs(values))
    assert np.all(state.lower <= values + slack)
    assert np.all(state.upper >= values - slack)


def test_games_against_highs():
    game, values = games()
    tolerance = relative_tolerance(game, 1e-6)
    state = solve(game, tolerance)
    assert_brackets(state, values)
    assert np.all(state.upper - state.lower <= tolerance)
    # the points that are kept prove the bounds
    w, q = np.asarray(state.best_primal), np.asarray(state.best_dual)
    np.testing.assert_allclose(w.sum(axis=0), 1, atol=1e-12)
    np.testing.assert_allclose(q.sum(axis=0), 1, atol=1e-12)
    assert np.all(q[~game.is_column] == 0)
    reached = np.where(game.is_column, np.einsum("kmb,kb->mb", game.payoff, w), -np.inf)
    chex.assert_trees_all_close(reached.max(axis=0), np.asarray(state.upper), rtol=1e-12, atol=1e-12)
    reached = np.einsum("kmb,mb->kb", game.payoff, q).min(axis=0)
    chex.assert_trees_all_close(reached, np.asarray(state.lower), rtol=1e-12, atol=1e-12)


def test_games_in_float32():
    game, values = games()
    narrow = game.replace(payoff=game.payoff.astype(np.float32))
    state = solve(narrow, relative_tolerance(game, 1e-4).astype(np.float32))
    assert state.lower.dtype == np.float32
    assert_brackets(state, values, slack=1e-5)
    assert np.all(state.upper - state.lower <= relative_tolerance(game, 1.01e-4))


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_games_of_one_row_or_column(shape, rng):
    payoff = rng.normal(size=shape)
    game = MatrixGame(payoff=payoff[..., None], is_column=np.ones((shape[1], 1), bool))
    state = solve(game, 1e-9)
    expected = payoff.max() if shape[0] == 1 else payoff.min()
    np.testing.assert_allclose([state.lower[0], state.upper[0]], expected, rtol=0, atol=1e-9)


def test_a_warm_start_is_used():
    game, _ = games()
    tolerance = relative_tolerance(game, 1e-6)
    cold = solve(game, tolerance)
    assert cold.steps.max() > 10 * engine.STEPS_PER_CHECK
    start = engine.init(game, (cold.best_primal, cold.best_dual))
    loose = jax.jit(engine.solve)(game, start, tolerance=100 * tolerance)
    assert loose.steps.max() <= 2 * engine.STEPS_PER_CHECK


def test_the_limit_stops_and_the_bounds_hold():
    game, values = games()
    state = solve(game, 0.0, 2 * engine.STEPS_PER_CHECK)
    np.testing.assert_array_equal(state.steps, 2 * engine.STEPS_PER_CHECK)
    assert_brackets(state, values)
    assert not engine.is_settled(state, 1e-9)[0]


@pytest.mark.parametrize(
    ("lower", "upper", "threshold", "settled"),
    [
        (0.2, 0.25, None, True),
        (0.2, 0.35, None, False),
        (0.2, 0.9, 0.1, True),  # lower > threshold: no
        (0.2, 0.9, 0.2, False),
        (0.0, 0.3, 0.2, True),  # upper <= threshold + tolerance: yes
        (0.0, 0.31, 0.2, False),
        (0.2, 0.25, 0.22, True),  # the gap is closed
        (-np.inf, np.inf, None, False),
        (-np.inf, np.inf, 0.5, False),
    ],
)
def test_is_settled(lower, upper, threshold, settled):
    state = engine.init(MatrixGame(payoff=jnp.ones((1, 1, 1)), is_column=jnp.ones((1, 1), bool)))
    state = state.replace(lower=jnp.array([lower]), upper=jnp.array([upper]))
    assert engine.is_settled(state, 0.1 + 1e-12, threshold)[0] == settled


@pytest.mark.parametrize("status", list(Status))
def test_every_status_says_what_happened(status):
    assert len(status.message) > 20
    assert ("tolerance" in status.message) == (status != Status.SOLVED)


def test_flow_problem_converges_to_lpal():
    case, expectations, margin = lpal_value("dense")
    scaled = (1 - case.discount) * expectations[:, None]
    problem = FlowProblem(mdp=case.mdp, expectations=jnp.asarray(scaled))
    state = solve(problem, 1e-5, 50_000)
    assert_brackets(state, np.array([(1 - case.discount) * margin]))
    assert state.upper - state.lower <= 1e-5


# --------------------------------------------------------------------------------- many problems


def lanes_of(game, index):
    return jax.tree.map(lambda leaf: leaf[..., index], game)


@pytest.mark.parametrize("total", [0, 1, 5, 16, 39])
def test_many_problems_through_sixteen_lanes(total):
    """Fewer and more problems than lanes, in any order: each gets its own answer."""
    game, values = games()
    order = np.random.default_rng(total).permutation(np.resize(np.arange(16), total))
    finished = []
    tolerance = 1e-4
    state = solve_many(
        lanes_of(game, order), tolerance=tolerance, lanes=16, progress=finished.append
    )
    assert sum(finished) == total
    chex.assert_shape(state.lower, (total,))
    chex.assert_shape([state.best_primal, state.best_dual], [(6, total), (8, total)])
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(state))
    assert_brackets(state, values[order])
    assert np.all(state.upper - state.lower <= tolerance)


def test_many_problems_agree_with_each_alone():
    """Lanes that were refilled saw nothing of their predecessors: the same steps as from a cold start."""
    game, _ = games()
    state = solve_many(lanes_of(game, np.arange(16)), tolerance=1e-4, lanes=4)
    for b in range(16):
        alone = solve(lanes_of(game, [b]), 1e-4)
        assert alone.steps[0] <= state.steps[b]
        assert state.lower[b] <= alone.upper[0] + 1e-12 and alone.lower[0] <= state.upper[b] + 1e-12
        same = solve(lanes_of(game, [b]), -1.0, state.steps[b])  # as many steps as it was given
        for field in ("lower", "upper", "best_primal", "best_dual"):
            np.testing.assert_allclose(
                state[field][..., b], same[field][..., 0], rtol=1e-6, atol=1e-6, err_msg=field
            )


def test_many_problems_with_a_threshold():
    """Decided against HiGHS, each with a threshold of its own, far before the gap closes."""
    game, values = games()
    offset = np.resize([0.05, -0.05], 16)
    state = solve_many(game, tolerance=1e-7, threshold=values + offset, lanes=16)
    np.testing.assert_array_equal(state.upper <= values + offset + 1e-7, offset > 0)
    np.testing.assert_array_equal(state.lower > values + offset, offset < 0)
    exact = solve_many(game, tolerance=1e-7, lanes=16)
    assert np.median(state.steps) < np.median(exact.steps)


def test_many_problems_out_of_iterations():
    game, values = games()
    state = solve_many(game, tolerance=1e-9, max_iterations=32, lanes=4)
    assert np.all(state.steps <= 32)
    assert_brackets(state, values)
    settled = engine.is_settled(state, 1e-9)
    assert np.all(state.steps[~settled] == 32) and not settled[0]


# ---------------------------------------------------------------------------------------- tracing


@chex.dataclass(frozen=True)
class CountingGame(MatrixGame):
    """Counts how often its product is traced; every call of a compiled program costs none."""

    def forward(self, w):
        traces.append(w.shape)
        return MatrixGame.forward(self, w)


traces = []


def test_other_problems_of_one_shape_are_not_traced_again(rng):
    def counting(total):
        payoff = rng.normal(size=(3, 4, total))
        return CountingGame(payoff=payoff, is_column=np.ones((4, total), bool))

    solve_many(counting(20), tolerance=1e-3, lanes=8)
    traced = len(traces)
    assert traced > 0
    solve_many(counting(30), tolerance=1e-5, lanes=8, max_iterations=500)
    solve_many(counting(2), tolerance=1e-3, lanes=8)
    assert len(traces) == traced


def test_solve_is_traced_once_for_all_tolerances(rng):
    chex.clear_trace_counter()
    game, _ = games()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(problem, tolerance, max_iterations):
        state = engine.init(problem)
        return engine.solve(problem, state, tolerance=tolerance, max_iterations=max_iterations)

    run(game, 1e-2, 100)
    run(lanes_of(game, np.arange(16)[::-1]), 1e-3, 200)
