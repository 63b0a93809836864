"""Matrix games by interior points: values against HiGHS, bounds against NumPy products, strategies on the simplex."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxhom.solvers.game_interior_point import solve_game

SMALL, TALL = (8, 20), (64, 30)  # a program each: tests differ in what stands in the arrays


def solve(payoff, is_column, tolerance, share, bound, w, q):
    return solve_game(payoff, is_column, tolerance=tolerance, share=share, bound=bound, start=(w, q))


ONE, MANY = jax.jit(solve), jax.jit(jax.vmap(solve))


@pytest.fixture(params=["in a program", "in NumPy"], autouse=True)
def _either(request, monkeypatch):
    """Every game is played by JAX and by NumPy."""
    if request.param == "in NumPy":
        monkeypatch.setitem(globals(), "ONE", solve)


def arguments(payoff, count=None, *, tolerance=0.0, share=0.0, bound=np.inf, start=None):
    """What `solve` takes, in arrays of the payoff's type, so that all games of a shape share one program."""
    rows, columns = payoff.shape
    w, q = (np.zeros(rows), np.zeros(columns)) if start is None else start
    is_column = np.arange(columns) < (columns if count is None else count)
    given = (np.asarray(array, payoff.dtype) for array in (tolerance, share, bound, w, q))
    return payoff, is_column, *given


def play(payoff, count=None, **options):
    return jax.tree.map(np.asarray, ONE(*arguments(payoff, count, **options)))


def size(payoff):
    return np.abs(payoff).max() or 1.0


def value_of(payoff):
    """HiGHS on payoffs of size 1, because its tolerances are absolute."""
    return size(payoff) * oracles.game_value(payoff / size(payoff))


def assert_proved(solution, payoff, eps):
    """Strategies are distributions, and the bounds those that they prove; `payoff` has no padding."""
    columns = payoff.shape[1]
    w, q = solution.w.astype(float), solution.q.astype(float)
    for strategy in (w, q):
        assert strategy.min() >= 0
        np.testing.assert_allclose(strategy.sum(), 1.0, rtol=0, atol=eps)
    np.testing.assert_array_equal(q[columns:], 0.0)
    np.testing.assert_allclose(solution.lower, (payoff @ q[:columns]).min(), rtol=0, atol=eps * size(payoff))
    np.testing.assert_allclose(solution.upper, (w @ payoff).max(), rtol=0, atol=eps * size(payoff))
    value = value_of(payoff)
    assert solution.lower - eps * size(payoff) <= value <= solution.upper + eps * size(payoff)


def games(shape):
    """Name -> payoff: plain and degenerate games of one shape."""
    rng = np.random.default_rng(shape)
    rows, columns = shape
    normal = rng.normal(size=shape)
    saddle = rng.uniform(1, 2, size=shape)
    saddle[2, :] = rng.uniform(-2, -1, size=columns)  # the row to play, whatever the columns do
    saddle[2, 3] = -0.5  # ... who then play this one
    return {
        "normal": normal,
        "positive": rng.uniform(size=shape),
        "of integers": rng.integers(-2, 3, size=shape).astype(float),
        "equal rows": np.tile(normal[: rows // 4], (4, 1)),
        "equal columns": np.repeat(normal[:, : columns // 5], 5, axis=1),
        "rank one": np.outer(rng.normal(size=rows), rng.normal(size=columns)),
        "constant": np.full(shape, -3.0),
        "zero": np.zeros(shape),
        "a saddle point": saddle,
        "one large payoff": np.where(np.arange(columns) == 4, 1e6, 1.0) * normal,
        "rows of all sizes": np.geomspace(1e-6, 1e6, rows)[:, None] * normal,
        "columns of all sizes": np.geomspace(1e-6, 1e6, columns) * normal,
        "tiny": 1e-6 * normal,
        "huge": 1e6 * normal,
        "far from zero": 100.0 + normal,
    }


# ------------------------------------------------------------------------------------------ values


@pytest.mark.parametrize("shape", [SMALL, TALL], ids=str)
@pytest.mark.parametrize("name", games(SMALL))
def test_values(name, shape):
    payoff = games(shape)[name]
    solution = play(payoff, tolerance=1e-6 * size(payoff))
    assert solution.upper - solution.lower <= 1e-6 * size(payoff)
    assert_proved(solution, payoff, 1e-8)


@pytest.mark.parametrize(("shape", "count", "best"), [((1, 6), 6, np.max), (SMALL, 1, np.min), (TALL, 1, np.min)])
def test_a_player_without_a_choice(shape, count, best):
    payoff = np.random.default_rng(5).normal(size=shape)
    solution = play(payoff, count, tolerance=1e-8)
    assert_proved(solution, payoff[:, :count], 1e-9)
    np.testing.assert_allclose([solution.lower, solution.upper], best(payoff[:, :count]), rtol=0, atol=1e-8)


def test_a_saddle_point_is_found():
    solution = play(games(SMALL)["a saddle point"], tolerance=1e-8)
    np.testing.assert_allclose([solution.w[2], solution.q[3]], 1.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose([solution.lower, solution.upper], -0.5, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", games(SMALL))
def test_without_a_tolerance_it_goes_as_far_as_rounding_allows(name):
    payoff = games(SMALL)[name]
    solution = play(payoff)
    assert_proved(solution, payoff, 1e-8)
    assert solution.upper - solution.lower <= 1e-6 * size(payoff)


@pytest.mark.parametrize("name", games(SMALL))
def test_float32(name):
    if ONE is solve:
        pytest.skip("in NumPy games are float64")
    payoff = games(SMALL)[name].astype(np.float32)
    solution = play(payoff)
    assert solution.w.dtype == solution.q.dtype == solution.lower.dtype == np.float32
    assert_proved(solution, payoff.astype(float), 2e-6)
    assert solution.upper - solution.lower <= 2e-3 * size(payoff)


def test_types_without_a_start():
    payoff = np.zeros(SMALL, np.float32)
    solution = jax.eval_shape(lambda payoff: solve_game(payoff, np.ones(20, bool), tolerance=1e-3), payoff)
    assert {leaf.dtype for leaf in (solution.w, solution.q, solution.lower, solution.upper)} == {jnp.dtype("float32")}


# ----------------------------------------------------------------------------------------- padding


@pytest.mark.parametrize(("shape", "count"), [(SMALL, 1), (SMALL, 5), (SMALL, 11), (TALL, 7)], ids=str)
def test_columns_that_do_not_exist(shape, count):
    payoff = games(shape)["normal"]
    solutions = []
    for padding in (0.0, 1e9, -1e9):
        padded = np.where(np.arange(shape[1]) < count, payoff, padding)
        solutions.append(play(padded, count, tolerance=1e-7))
        assert_proved(solutions[-1], payoff[:, :count], 1e-8)
        assert solutions[-1].upper - solutions[-1].lower <= 1e-7
    jax.tree.map(np.testing.assert_array_equal, solutions[0], solutions[1])
    jax.tree.map(np.testing.assert_array_equal, solutions[0], solutions[2])


# --------------------------------------------------------------------------------- stopping, starts


@pytest.mark.parametrize("shape", [SMALL, TALL], ids=str)
def test_it_stops_early_where_much_is_open(shape):
    payoff, share = games(shape)["positive"], 0.5
    bound = payoff.max()
    early, late = play(payoff, share=share, bound=bound), play(payoff, tolerance=1e-7)
    assert 1e-3 < early.upper - early.lower <= share * (bound - early.lower)
    assert early.steps < late.steps
    assert_proved(early, payoff, 1e-8)


def test_a_share_of_nothing_is_left_to_the_tolerance():
    """A bound that lies below what is proved leaves nothing open, and no bound asks for nothing."""
    payoff = games(SMALL)["positive"]
    late = play(payoff, tolerance=1e-7)
    closed = play(payoff, tolerance=1e-7, share=0.5, bound=-1.0)
    jax.tree.map(np.testing.assert_array_equal, closed, late)
    assert play(payoff, tolerance=1e-7, share=0.5).steps == 0
    jax.tree.map(np.testing.assert_array_equal, play(payoff, tolerance=1e-7, share=0.0, bound=5.0), late)


@pytest.mark.parametrize("shape", [SMALL, TALL], ids=str)
def test_a_start_near_the_solution_saves_steps(shape):
    saved = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        payoff = rng.normal(size=shape)
        former = play(payoff, tolerance=1e-2)
        changed = payoff + 1e-3 * rng.normal(size=shape)
        cold, warm = (play(changed, tolerance=1e-2, start=start) for start in (None, (former.w, former.q)))
        assert_proved(warm, changed, 1e-8)
        assert warm.upper - warm.lower <= 1e-2
        saved.append(cold.steps - warm.steps)
    assert min(saved) >= 0 and sum(saved) >= 4


@pytest.mark.parametrize("shape", [SMALL, TALL], ids=str)
@pytest.mark.parametrize("scale", [1.0, 1e-3, 50.0])
def test_any_start_will_do(shape, scale):
    """Pure, wrong, not normalised, with weight on columns that do not exist: the bounds hold, the gap closes."""
    rows, columns = shape
    payoff, count = games(shape)["normal"], columns - 4
    w, first, gone = scale * np.eye(rows)[1], scale * np.eye(columns)[0], scale * np.eye(columns)[-1]
    for q in (first, first + gone, gone):
        solution = play(payoff, count, tolerance=1e-6, start=(w, q))
        assert_proved(solution, payoff[:, :count], 1e-8)
        assert solution.upper - solution.lower <= 1e-6


def test_a_start_at_the_solution():
    """Nothing is open there: no slack has room."""
    payoff = games(SMALL)["a saddle point"]
    start = np.eye(8)[2], np.eye(20)[3]
    for name in ("a saddle point", "zero", "constant"):
        payoff = games(SMALL)[name]
        solution = play(payoff, start=start)
        assert_proved(solution, payoff, 1e-8)
        assert solution.upper - solution.lower <= 1e-6


# --------------------------------------------------------------------------------------------- vmap


def test_vmap_agrees_with_single_calls():
    """Easy games, hard ones, padded ones and warm ones side by side."""
    former = play(games(SMALL)["normal"], tolerance=1e-2)
    many = [arguments(payoff, tolerance=1e-6 * size(payoff)) for payoff in games(SMALL).values()]
    many += [arguments(payoff, 9, tolerance=1e-6 * size(payoff)) for payoff in games(SMALL).values()]
    many.append(arguments(games(SMALL)["normal"], tolerance=1e-6, start=(former.w, former.q)))
    many.append(arguments(games(SMALL)["positive"], share=0.5, bound=1.0))
    batch = jax.tree.map(np.asarray, MANY(*map(np.stack, zip(*many, strict=True))))
    for k, given in enumerate(many):
        alone, here = jax.tree.map(np.asarray, ONE(*given)), jax.tree.map(lambda leaf, k=k: leaf[k], batch)
        assert_proved(here, given[0][:, given[1]], 1e-8)
        assert abs(here.steps - alone.steps) <= 1
        within = 2e-6 * size(given[0]) if given[3] == 0 else 1e-8
        np.testing.assert_allclose([here.lower, here.upper], [alone.lower, alone.upper], rtol=0, atol=within)
