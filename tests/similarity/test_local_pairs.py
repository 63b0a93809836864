"""Errors of LP (9) between states of a model and decisions about them, against HiGHS.

Most models here have four actions and a local model of six states, and most calls meet one of those: each
size of the largest model in a call is a program to compile.
"""

import functools

import chex
import jax
import numpy as np
import oracles
import pytest

from jaxhom import SimilarityTable, Status, local_similarity, locally_similar
from jaxhom.domains.gridworld import gridworld
from jaxhom.models.mdp import MDP
from jaxhom.similarity import class_pairs, settling
from jaxhom.similarity.classes import local_model_classes, model_rounding


def block_diagonal(blocks):
    """One transition tensor of models that never meet."""
    size, num_actions = sum(map(len, blocks)), blocks[0].shape[1]
    transition, first = np.zeros((size, num_actions, size)), 0
    for block in blocks:
        last = first + len(block)
        transition[first:last, :, first:last] = block
        first = last
    return transition


def random_model(rng, size, num_actions, concentration=0.5):
    return rng.dirichlet(np.full(size, concentration), size=(size, num_actions))


def cycle(*targets):
    """Deterministic, four actions alike: state i goes to targets[i]."""
    return np.repeat(np.eye(len(targets))[list(targets)][:, None], 4, axis=1)


@functools.cache
def transition_of(name):
    rng = np.random.default_rng(3)
    if name == "blocks":  # every state's local model is its whole block
        return block_diagonal([random_model(rng, size, 4) for size in (1, 2, 3, 4, 5, 6) * 2])
    if name == "degenerate":
        lumpable = np.zeros((3, 4, 3))
        lumpable[0, :, 1:] = rng.dirichlet(np.ones(2), size=4)
        lumpable[1:, :, 0] = rng.uniform(size=(1, 4)) * 0.9
        lumpable[1:, :, 1] = 0.7 * (1 - lumpable[1:, :, 0])
        lumpable[1:, :, 2] = 0.3 * (1 - lumpable[1:, :, 0])
        lumped = np.zeros((2, 4, 2))
        lumped[0, :, 1] = 1.0
        lumped[1, :, 0] = lumpable[1, :, 0]
        lumped[1, :, 1] = 1.0 - lumped[1, :, 0]
        mixed = cycle(1, 0)
        mixed[:, 2:] = np.eye(2)[:, None]  # two actions swap, two stay
        cycles = [cycle(0), cycle(0), cycle(1, 1), cycle(1, 0), cycle(1, 2, 2), cycle(1, 2, 0)]
        others = [mixed, lumpable, lumped, random_model(rng, 3, 4), random_model(rng, 6, 4)]
        return block_diagonal(cycles + others)
    if name == "grid":
        return block_diagonal([oracles.gridworld_transition(6), *(random_model(rng, 6, 4) for _ in "ab")])
    if name == "strip":  # one to six states within two steps
        strip = np.zeros((12, 4, 12))
        for s in range(12):
            ahead = np.arange(s + 1, min(s + (4 if s == 0 else 3), 12)) if s < 11 else [11]
            strip[s][:, ahead] = rng.dirichlet(np.ones(len(ahead)), size=4)
        return strip
    return block_diagonal([random_model(rng, 18, 1), random_model(rng, 5, 1)])  # "large"


@functools.cache
def model_of(name, dtype=np.float64):
    mdp = MDP.from_dense(transition_of(name).astype(dtype), discount=0.9)
    return mdp, np.asarray(mdp.transition, np.float64)


@functools.cache
def exact_error(name, dtype, source, target, distance=1, anchored=True):
    """The optimal error between two states by HiGHS, on the model as it was rounded to `dtype`."""
    _, transition = model_of(name, dtype)
    models = (oracles.local_model(transition, s, distance)[1] for s in (source, target))
    return oracles.homomorphism_lp(*models, anchored)[0]


def exact_errors(name, sources, targets, dtype=np.float64, **options):
    pairs = zip(map(int, sources), map(int, targets), strict=True)
    return np.array([exact_error(name, dtype, s, t, **options) for s, t in pairs])


def random_pairs(name, count):
    rng = np.random.default_rng(4)
    return rng.integers(len(transition_of(name)), size=(2, count))


def all_pairs(states):
    return np.repeat(states, len(states)), np.tile(states, len(states))


def assert_brackets(result, error, tolerance):
    chex.assert_shape([result.lower, result.upper, result.iterations, result.status], error.shape)
    assert np.all(result.lower >= 0)
    assert np.all(result.lower <= error + 1e-9)
    assert np.all(error <= result.upper + 1e-9)
    np.testing.assert_array_equal(result.status, Status.SOLVED)
    assert np.all(result.upper - result.lower <= tolerance)


# -------------------------------------------------------------------------------------- the errors


@pytest.mark.parametrize(
    ("anchored", "tolerance", "method"),
    [(True, 1e-4, "pdhg"), (True, 1e-6, "interior_point"), (False, 1e-4, "interior_point"), (False, 1e-6, "pdhg")],
)
def test_random_pairs_of_states(anchored, tolerance, method):
    """Local models of one to six states, two of each size, in every combination; any two of the options meet."""
    mdp, _ = model_of("blocks")
    sizes = np.array([1, 2, 3, 4, 5, 6] * 2)
    states = np.cumsum(sizes) - sizes + np.random.default_rng(4).integers(sizes)
    pairs = all_pairs(states)
    options = {"anchored": anchored, "tolerance": tolerance, "method": method}
    result = local_similarity(mdp, *pairs, **options)
    error = exact_errors("blocks", *pairs, anchored=anchored)
    assert np.median(error) > 0.05
    assert_brackets(result, error, tolerance)


@pytest.mark.parametrize("anchored", [True, False])
def test_all_pairs_of_classes_of_a_gridworld(anchored):
    states = local_model_classes(gridworld(6).mdp).representative
    sources, targets = all_pairs(states)
    assert len(sources) == 81
    mdp, transition = model_of("grid")
    np.testing.assert_allclose(transition[:36, :, :36], gridworld(6).mdp.transition, rtol=0, atol=1e-15)
    pairs = np.append(sources, 36), np.append(targets, 42)
    result = local_similarity(mdp, *pairs, anchored=anchored, tolerance=1e-5)
    error = exact_errors("grid", *pairs, anchored=anchored)
    assert 10 < (error > 1e-6).sum() < 80
    assert_brackets(result, error, 1e-5)


@pytest.mark.parametrize("anchored", [True, False])
def test_degenerate_models(anchored):
    """Absorbing states, one state, deterministic cycles, models that can be lumped."""
    mdp, transition = model_of("degenerate")
    pairs = all_pairs(np.arange(len(transition)))
    result = local_similarity(mdp, *pairs, anchored=anchored)
    some = np.random.default_rng(5).permutation(len(pairs[0]))[:250]
    chosen = jax.tree.map(lambda leaf: leaf[some], result)
    error = exact_errors("degenerate", *(side[some] for side in pairs), anchored=anchored)
    assert (error < 1e-9).sum() > 30 and (error > 0.1).sum() > 10
    assert_brackets(chosen, error, 1e-4)
    upper = result.upper.reshape(len(transition), -1)
    assert np.all(upper[:, 0] <= 1e-4)  # into one state everything fits
    if not anchored:
        assert np.all(upper[:, [3, 10]] <= 1e-4)  # and so it does into an absorbing one
    lumpable, lumped = 15, 18
    assert upper[lumpable, lumped] <= 1e-4  # an exact homomorphism, many to one


@pytest.mark.parametrize("anchored", [True, False])
def test_errors_by_hand(anchored):
    """A state alone, the end of 0 -> 1, 0 <-> 1; the last pair is there for its six states."""
    mdp, transition = model_of("degenerate")
    alone, chain, end, swap, last = 0, 2, 3, 4, len(transition) - 1
    pairs = [swap, swap, alone, chain, last], [end, alone, swap, swap, last - 1]
    result = local_similarity(mdp, *pairs, tolerance=1e-6, anchored=anchored)
    # All of the swap can go to the absorbing state. Anchored, the state alone goes to the swap's centre,
    # which leaves at once; and the chain's end, a share p of it to the centre: max(p, |2 p - 1|) is least
    # at 1/3. As printed, half of everything goes here and half there.
    by_hand = [0.0, 0.0, 1.0, 1 / 3] if anchored else [0.0] * 4
    np.testing.assert_allclose(result.lower[:4], by_hand, rtol=0, atol=2e-6)
    np.testing.assert_allclose(result.upper[:4], by_hand, rtol=0, atol=2e-6)


@pytest.mark.parametrize("anchored", [True, False])
def test_two_steps(anchored):
    mdp, transition = model_of("strip")
    sizes = {len(oracles.reach(transition, s, 2)) for s in range(12)}
    assert sizes == {1, 2, 3, 4, 5, 6}
    pairs = all_pairs(np.arange(12))
    result = local_similarity(mdp, *pairs, distance=2, anchored=anchored)
    assert_brackets(result, exact_errors("strip", *pairs, distance=2, anchored=anchored), 1e-4)


def test_models_of_different_groups_of_sizes():
    """18 states are beyond the written-out products; 5 states are padded to meet them."""
    mdp, _ = model_of("large")
    pairs = [0, 3, 20, 7], [5, 3, 8, 19]
    result = local_similarity(mdp, *pairs, tolerance=1e-2)
    assert_brackets(result, exact_errors("large", *pairs), 1e-2)


def test_float32():
    """Bounds hold for the rounded model, rounding included, and the gap is what was asked for."""
    mdp, _ = model_of("blocks", np.float32)
    pairs = random_pairs("blocks", 150)
    result = local_similarity(mdp, *pairs, tolerance=2e-4)
    assert result.lower.dtype == result.upper.dtype == np.float32
    assert_brackets(result, exact_errors("blocks", *pairs, dtype=np.float32), 2e-4)


def test_float32_says_so_where_it_cannot_reach_the_tolerance():
    mdp, _ = model_of("blocks", np.float32)
    pairs = np.array([[40, 41, 30], [20, 40, 30]])
    result = local_similarity(mdp, *pairs, tolerance=3e-6, max_iterations=5000)
    error = exact_errors("blocks", *pairs, dtype=np.float32)
    assert np.all(result.lower <= error + 1e-9) and np.all(result.upper >= error - 1e-9)
    settled = result.upper - result.lower <= 3e-6
    np.testing.assert_array_equal(settled, result.status == Status.SOLVED)
    np.testing.assert_array_equal(settled, [False, False, True])


# ---------------------------------------------------------------------- pairs, limits, options


def test_isomorphic_models_need_no_iterations():
    mdp, _ = model_of("grid")
    result = local_similarity(mdp, [7, 14, 36], [8, 14, 42])
    np.testing.assert_array_equal(result.iterations[:2], 0)
    np.testing.assert_array_equal(result.lower[:2], 0)
    assert np.all(result.upper[:2] <= model_rounding(np.float64))
    assert result.iterations[2] > 0


def test_repeated_pairs_share_one_answer():
    mdp, _ = model_of("blocks")
    sources, targets = random_pairs("blocks", 20)
    once = local_similarity(mdp, sources, targets)
    order = np.resize(np.random.default_rng(0).permutation(20), 50)
    again = local_similarity(mdp, sources[order].tolist(), targets[order].tolist())
    for one, other in ((again.lower, once.lower), (again.upper, once.upper)):
        np.testing.assert_allclose(one, other[order], rtol=0, atol=1e-4)
    chex.assert_trees_all_equal(
        jax.tree.map(lambda leaf: leaf[20:40], again), jax.tree.map(lambda leaf: leaf[:20], again)
    )


def test_no_pairs_at_all():
    mdp, _ = model_of("blocks")
    result = local_similarity(mdp, [], [])
    chex.assert_shape([result.lower, result.upper, result.iterations, result.status], (0,))
    assert locally_similar(mdp, [], []).shape == (0,)
    assert locally_similar(mdp, np.zeros(0, int), [], mutual=True).dtype == bool


def test_out_of_iterations():
    mdp, _ = model_of("blocks")
    pairs = random_pairs("blocks", 60)
    result = local_similarity(mdp, *pairs, tolerance=1e-6, max_iterations=32, method="pdhg")
    error = exact_errors("blocks", *pairs)
    assert np.all(result.lower <= error + 1e-9) and np.all(result.upper >= error - 1e-9)
    assert np.all(result.iterations <= 32)
    settled = result.upper - result.lower <= 1e-6
    assert 0 < settled.sum() < 60
    np.testing.assert_array_equal(result.status == Status.SOLVED, settled)
    np.testing.assert_array_equal(result.status[~settled], Status.ITERATION_LIMIT)
    np.testing.assert_array_equal(result.iterations[~settled], 32)


def test_chunks_of_pairs(monkeypatch):
    """A few pairs at a time give what all at once give."""
    mdp, _ = model_of("blocks")
    pairs = random_pairs("blocks", 12)
    whole = local_similarity(mdp, *pairs, method="pdhg")
    calls = []
    bracket_errors = class_pairs.bracket_errors

    def recorded(source, target, **options):
        calls.append(len(options["pairs"]))
        return bracket_errors(source, target, **options)

    monkeypatch.setattr(class_pairs, "_CHUNK_BYTES", 5000)
    monkeypatch.setattr(class_pairs, "bracket_errors", recorded)
    parts = local_similarity(mdp, *pairs, method="pdhg")
    assert len(calls) > 1 and sum(calls) == (whole.iterations > 0).sum()
    np.testing.assert_allclose(parts.lower, whole.lower, rtol=0, atol=1e-4)
    np.testing.assert_allclose(parts.upper, whole.upper, rtol=0, atol=1e-4)


def test_progress_counts_all_pairs(capsys, monkeypatch):
    mdp, _ = model_of("blocks")
    bars = []

    class Recorded(settling.tqdm):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            bars.append(self)

    monkeypatch.setattr(settling, "tqdm", Recorded)
    local_similarity(mdp, [40, 6, 7], [41, 6, 20], progress=True)
    assert [(bar.n, bar.total) for bar in bars] == [(3, 3)]
    assert "0/3" in capsys.readouterr().err
    local_similarity(mdp, [40], [41])
    assert capsys.readouterr().err == ""


# ---------------------------------------------------------------------------------- yes or no


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize("threshold", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("name", ["blocks", "degenerate"])
def test_decisions(name, threshold, mutual):
    """Against HiGHS, outside the band (threshold, threshold + tolerance]."""
    mdp, _ = model_of(name)
    pairs = random_pairs(name, 150)
    tolerance = 1e-3
    similar = locally_similar(mdp, *pairs, threshold, mutual=mutual, tolerance=tolerance)
    assert similar.dtype == bool and similar.shape == (150,)
    error = exact_errors(name, *pairs)
    if mutual:
        error = np.maximum(error, exact_errors(name, *pairs[::-1]))
    assert np.all(similar[error <= threshold - 1e-9])
    assert not np.any(similar[error > threshold + tolerance])
    if threshold == 0:
        assert np.all(similar[error < 1e-9])


@pytest.mark.parametrize("tolerance", [1e-3, 3e-5])
def test_exact_homomorphisms_are_similar_in_float32(tolerance):
    """The widening by the rounding must not push a pair with e = 0 over the threshold."""
    mdp, _ = model_of("degenerate", np.float32)
    pairs = random_pairs("degenerate", 150)
    error = exact_errors("degenerate", *pairs, dtype=np.float32)
    similar = locally_similar(mdp, *pairs, 0.0, tolerance=tolerance)
    is_exact = error < 1e-7  # to the rounding of the model
    assert is_exact.sum() > 20
    assert np.all(similar[is_exact])
    assert not np.any(similar[error > tolerance])


def test_exact_lumpings_of_many_states_are_similar_in_float32():
    """110 states within one step of their centre onto two: the rounding of so many terms decides nothing."""
    size = 110
    model = np.zeros((size + 2, 1, size + 2))
    model[0, 0, 1:size] = 1.0 / (size - 1)
    model[1:size, 0, 0], model[1:size, 0, 1:size] = 0.3, 0.7 / (size - 1)
    model[size:, 0, size:] = [[0.0, 1.0], [0.3, 0.7]]
    mdp = MDP.from_dense(model.astype(np.float32), discount=0.9)
    np.testing.assert_array_equal(locally_similar(mdp, [0, 1], [size, size]), [True, False])


def test_decisions_stop_early():
    """A threshold far from the error is decided in a fraction of the iterations."""
    mdp, _ = model_of("blocks")
    pairs = random_pairs("blocks", 60)
    open_, decided = SimilarityTable(mdp), SimilarityTable(mdp)
    steps = open_.brackets(*pairs, tolerance=1e-5, method="pdhg").iterations.mean()
    decided.decide(*pairs, 0.9, tolerance=1e-5)
    # Read without solving: the bounds of the decisions are within a gap of 2.
    assert decided.brackets(*pairs, tolerance=2.0).iterations.mean() < 0.5 * steps
    assert 0 < decided.num_solved <= open_.num_solved


# ------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize("function", [local_similarity, locally_similar])
@pytest.mark.parametrize(
    ("sources", "targets", "options", "message"),
    [
        ([0, 42], [0, 0], {}, r"sources\[1\] must be below 42, got 42"),
        ([0], [-1], {}, r"targets\[0\] must not be negative, got -1"),
        ([0], [0.5], {}, r"targets\[0\] must be whole, got 0.5"),
        ([0, 1], [0], {}, r"targets must have shape \(2,\), got \(1,\)"),
        ([[0]], [[0]], {}, r"sources must have shape \[P\], got \(1, 1\)"),
        (0, 0, {}, r"sources must have shape \[P\], got \(\)"),
        ([0], [1], {"distance": 0}, "distance must be at least 1, got 0"),
        ([0], [1], {"tolerance": 0.0}, "tolerance must be positive, got 0.0"),
        ([0], [1], {"tolerance": np.nan}, "tolerance must be positive, got nan"),
    ],
)
def test_refused(function, sources, targets, options, message):
    with pytest.raises(ValueError, match=message):
        function(model_of("blocks")[0], sources, targets, **options)


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match=r"method must be one of .*, got 'simplex'"):
        local_similarity(model_of("blocks")[0], [0], [1], method="simplex")


@pytest.mark.parametrize("threshold", [-0.1, np.nan])
def test_a_negative_threshold_is_refused(threshold):
    with pytest.raises(ValueError, match=f"threshold must not be negative, got {threshold}"):
        locally_similar(model_of("blocks")[0], [0], [1], threshold)
