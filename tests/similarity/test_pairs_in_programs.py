"""Pairs of states inside jit, vmap and grad: bounds against HiGHS, slopes against differences of it."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxhom import SimilarityTable, Status, gridworld, local_similarity, locally_similar
from jaxhom.models.mdp import MDP
from jaxhom.similarity import local_models

PAIRS = np.array([[0, 3, 7, 11, 5, 20], [1, 8, 2, 11, 19, 4]])


@functools.cache
def sparse_model(dtype=np.float64):
    """24 states with two actions and up to three successors each; the last one absorbs."""
    rng = np.random.default_rng(5)
    ahead = (np.arange(24)[:, None, None] + rng.integers(0, 3, (24, 2, 3))) % 24
    ahead[-1] = 23
    return MDP.from_successors(ahead, rng.dirichlet(np.ones(3), (24, 2)).astype(dtype), discount=0.9)


@functools.cache
def restricted_model():
    """The same without some actions."""
    allowed = np.ones((24, 2), bool)
    allowed[::3, 1] = allowed[1::4, 0] = False
    allowed[~allowed.any(axis=1)] = True
    return sparse_model().replace(allowed=allowed)


def exact(mdp, pairs=PAIRS, distance=1, anchored=True):
    """Optimal errors by HiGHS."""
    transition, allowed = np.asarray(mdp.transition, np.float64), np.asarray(mdp.allowed)
    structure = np.where(allowed[..., None], transition, 0.0)
    errors = []
    for pair in pairs.T:
        states, models = zip(*(oracles.local_model(structure, s, distance) for s in pair), strict=True)
        models = [np.where(allowed[s][..., None], m, 0.0) for s, m in zip(states, models, strict=True)]
        labels = [1.0 - allowed[s][..., None] for s in states]
        errors.append(oracles.homomorphism_lp(*models, anchored, labels)[0])
    return np.array(errors)


def with_probability(mdp, **options):
    """Bounds as a function of the probabilities."""
    return lambda p, *pairs: local_similarity(mdp.replace(probability=p), *(pairs or PAIRS), **options)


def assert_brackets(found, error, tolerance=1e-4):
    slack = 1e-9
    assert np.all(found.lower <= error + slack) and np.all(error <= found.upper + slack)
    assert np.all(found.lower >= 0)
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    assert np.all(found.upper - found.lower <= tolerance)


@pytest.mark.parametrize(
    ("make", "distance", "anchored"),
    [(sparse_model, 1, True), (sparse_model, 2, True), (restricted_model, 1, False), (restricted_model, 2, True)],
)
def test_bounds_under_jit(make, distance, anchored):
    mdp, options = make(), {"distance": distance, "anchored": anchored}
    found = jax.jit(with_probability(mdp, **options))(mdp.probability)
    assert_brackets(found, exact(mdp, **options))


@pytest.mark.parametrize("method", ["auto", "interior_point"])
def test_grid_in_float32_and_by_interior_points(method):
    mdp = gridworld(5).mdp
    mdp = MDP.from_dense(np.asarray(mdp.transition, np.float32 if method == "auto" else np.float64), discount=0.9)
    pairs = np.array([[0, 6, 4], [4, 7, 12]])
    found = jax.jit(with_probability(mdp, method=method))(mdp.probability, *pairs)
    assert found.lower.dtype == mdp.dtype
    assert_brackets(found, exact(mdp, pairs))


def test_traced_states_and_vmap_agree_with_eager():
    """Over batches of states and of probabilities; a second call of the same shapes compiles nothing."""
    mdp = sparse_model()
    chex.clear_trace_counter()
    traced = jax.jit(chex.assert_max_traces(lambda s, t: local_similarity(mdp, s, t), 1))
    for pairs in (PAIRS, PAIRS[::-1]):
        found, eager = traced(*pairs), local_similarity(mdp, *pairs)
        assert_brackets(found, exact(mdp, pairs))
        assert np.all(found.lower <= eager.upper) and np.all(eager.lower <= found.upper)
    split = PAIRS.reshape(2, 2, 3).swapaxes(0, 1)
    assert_brackets(jax.vmap(lambda pair: local_similarity(mdp, *pair))(jnp.asarray(split)), exact(mdp).reshape(2, 3))
    other = 0.5 * mdp.probability + 0.5 * mdp.probability.mean(axis=1, keepdims=True)
    other = jnp.where(mdp.probability > 0, other, 0.0)
    other = other / other.sum(axis=-1, keepdims=True)
    batch = jax.jit(jax.vmap(with_probability(mdp)))(jnp.stack([mdp.probability, other]))
    assert_brackets(batch, np.stack([exact(mdp), exact(mdp.replace(probability=other))]))


def test_a_traced_model_goes_with_a_table():
    for mdp in (
        restricted_model(),
        MDP.from_dense(np.random.default_rng(2).dirichlet(np.ones(4), (4, 2)), discount=0.9),
    ):
        pairs = PAIRS % mdp.num_states
        table, other = SimilarityTable(mdp), SimilarityTable(gridworld(3))
        found = jax.jit(lambda mdp, table=table, pairs=pairs: local_similarity(mdp, *pairs, table=table))(mdp)
        assert_brackets(found, exact(mdp, pairs))
        with pytest.raises(ValueError, match=r"the graph of the model is traced.*SimilarityTable\(mdp\)"):
            jax.jit(lambda mdp, pairs=pairs: local_similarity(mdp, *pairs))(mdp)
        with pytest.raises(ValueError, match="table was made with distance=1"):
            jax.jit(lambda mdp, table=table: local_similarity(mdp, [0], [1], distance=2, table=table))(mdp)
        with pytest.raises(ValueError, match="table was made for another model"):
            jax.jit(lambda mdp, other=other: local_similarity(mdp, [0], [1], table=other))(mdp)


@pytest.mark.parametrize("make", [sparse_model, restricted_model], ids=["all actions", "some actions"])
def test_derivatives_against_differences_of_highs(make):
    """In directions that keep the sums of rows; at a kink, between the one-sided slopes. Forward and in reverse."""
    mdp, rng, h, smooth = make(), np.random.default_rng(6), 1e-6, 0
    bounds = with_probability(mdp, tolerance=1e-7)
    p = np.asarray(mdp.probability)
    slopes = jax.jit(jax.jacrev(lambda p: bounds(p).upper))(p)
    middle = exact(mdp)
    for _ in range(3):
        move = np.where(p > 0, rng.normal(size=p.shape), 0.0)
        move -= np.where(
            p > 0, move.sum(axis=-1, keepdims=True) / np.maximum((p > 0).sum(axis=-1, keepdims=True), 1), 0
        )
        up, down = (exact(mdp.replace(probability=p + t * move)) for t in (h, -h))
        one_sided = np.sort([(up - middle) / h, (middle - down) / h], axis=0)
        slope = np.einsum("psan,san->p", slopes, move)
        assert np.all(one_sided[0] - 2e-3 <= slope) and np.all(slope <= one_sided[1] + 2e-3)
        smooth += np.sum((one_sided[1] - one_sided[0] < 1e-3) & (np.abs(slope) > 1e-2))
        _, forward = jax.jvp(lambda p: bounds(p).lower, (p,), (move,))
        np.testing.assert_allclose(forward, slope, rtol=0, atol=1e-4)
    assert smooth >= 4


def test_grad_without_jit_and_second_derivatives():
    mdp = sparse_model()
    error = lambda p: local_similarity(mdp.replace(probability=p), [3], [8]).upper[0]  # noqa: E731
    np.testing.assert_allclose(jax.grad(error)(mdp.probability), jax.jit(jax.grad(error))(mdp.probability), atol=1e-6)
    with pytest.raises(ValueError, match="local_similarity has first derivatives only"):
        jax.hessian(error)(mdp.probability)


@pytest.mark.parametrize(("threshold", "mutual"), [(0.0, False), (0.2, True)])
def test_decisions(threshold, mutual):
    mdp = sparse_model()
    similar = jax.jit(lambda s, t: locally_similar(mdp, s, t, threshold, mutual=mutual, tolerance=1e-3))(*PAIRS)
    error = np.maximum(exact(mdp), exact(mdp, PAIRS[::-1])) if mutual else exact(mdp)
    assert similar.dtype == bool
    assert np.all(similar[error <= threshold - 1e-9]) and not np.any(similar[error > threshold + 1e-3])
    assert similar[3]


def test_limits_and_what_is_not_a_number():
    mdp = sparse_model()
    few = jax.jit(with_probability(mdp, max_iterations=16, tolerance=1e-9))(mdp.probability)
    error = exact(mdp)
    assert np.all(few.lower <= error + 1e-9) and np.all(error <= few.upper + 1e-9)
    assert np.any(few.status == Status.ITERATION_LIMIT)
    spoilt = jax.jit(with_probability(mdp))(mdp.probability.at[PAIRS[0, 0]].set(jnp.nan))
    assert spoilt.status[0] == Status.STALLED and not np.isfinite(spoilt.upper[0] - spoilt.lower[0])
    far = ~np.any(np.isin(PAIRS, [0, 22, 23, 1]), axis=0)
    assert np.all(spoilt.status[far] == Status.SOLVED)


def test_concrete_calls_inside_are_constants():
    mdp = sparse_model()
    upper, similar = jax.jit(lambda x: (x + local_similarity(mdp, *PAIRS).upper, locally_similar(mdp, *PAIRS, 0.2)))(
        0.0
    )
    np.testing.assert_allclose(upper, local_similarity(mdp, *PAIRS).upper)
    np.testing.assert_array_equal(similar, locally_similar(mdp, *PAIRS, 0.2))


def test_what_is_refused(monkeypatch):
    mdp = sparse_model()
    for name, value in {"tolerance": 0.1, "max_iterations": 3, "distance": 1}.items():
        with pytest.raises(ValueError, match=f"{name} is a traced value"):
            jax.jit(lambda x, name=name: local_similarity(mdp, [0], [1], **{name: x}))(value)
    with pytest.raises(ValueError, match="threshold is a traced value"):
        jax.jit(lambda x: locally_similar(mdp, [0], [1], x))(0.1)
    with pytest.raises(ValueError, match=r"sources must have shape \[P\]"):
        jax.jit(lambda s: local_similarity(mdp, s, [1]))(jnp.array(0))
    with pytest.raises(ValueError, match="sources must hold integers"):
        jax.jit(lambda s: local_similarity(mdp, s, [1]))(jnp.array([0.0]))
    with pytest.raises(ValueError, match=r"targets must have shape \(2,\), got \(1,\)"):
        jax.jit(lambda s: local_similarity(mdp, s, [1]))(jnp.array([0, 1]))
    monkeypatch.setattr(local_models, "_MAX_INDICES", 100)
    with pytest.raises(ValueError, match=r"24 x \d+ x 2 x 3 indices"):
        jax.jit(lambda s: local_similarity(mdp, s, [1]))(jnp.array([0]))
