"""Decisions without iterations: bounds and answers of profiles and intervals against HiGHS, on hundreds of small pairs.

Nothing may be told wrongly far or wrongly similar, whatever the models: what is not decided goes to a solver.
"""

import functools

import numpy as np
import oracles
import pytest

from jaxhom import MDP, SimilarityTable, Status
from jaxhom.similarity import blocks, propagation, settling
from jaxhom.similarity.brackets import Goal, bracket_errors
from jaxhom.similarity.free_bounds import lower_bounds_without_iterations, upper_bounds_without_iterations
from jaxhom.similarity.model_pairs import ModelPairs
from jaxhom.similarity.propagation import bounds_by_intervals

THRESHOLDS = (0.0, 0.05, 0.2, 0.5)
TOLERANCE = 1e-4
MODELS, NUM_ACTIONS = 8, 2  # of each side
SOURCE_WIDTH, TARGET_WIDTH = 6, 4
KINDS, MARKS = ("deterministic", "sparse", "stochastic", "hub"), ("none", "refused", "large")


def probabilities(rng, kind, size):
    """[size, A, size], of one kind."""
    shape = (size, NUM_ACTIONS)
    successor = np.eye(size)[rng.integers(size, size=shape)]
    if kind == "stochastic":
        return rng.dirichlet(np.ones(size), shape)
    if kind == "hub":
        return np.where(rng.random((*shape, 1)) < 0.7, np.eye(size)[-1], successor)
    other = np.eye(size)[rng.integers(size, size=shape)]
    return successor if kind == "deterministic" else 0.9 * successor + 0.1 * other


def marks_of(rng, marks, size):
    """Labels [size, A, L] of one kind."""
    if marks == "large":
        return rng.choice([-2.0, 0.0, 0.1, 3.0], (size, NUM_ACTIONS, 2))
    return (rng.random((size, NUM_ACTIONS, 1)) < 0.3).astype(float)


def lifted(rng, model, labels):
    """A model that a map of error 0 leads from to the given one, with up to two states more."""
    size = len(model) + rng.integers(SOURCE_WIDTH - TARGET_WIDTH + 1)
    image = np.append(np.arange(len(model)), rng.integers(len(model), size=size - len(model)))
    share = rng.random((size, NUM_ACTIONS, size)) * (rng.random((size, NUM_ACTIONS, size)) < 0.5)
    share[..., : len(model)] += 1e-3 * (share[..., : len(model)] == 0.0)  # of states with the same image
    share /= (share @ np.eye(len(model))[image])[..., image]
    return model[image][..., image] * share, labels[image]


@functools.cache
def case(kind, marks, dtype, anchored):
    """Pairs of models and their optimal errors: any source with any target, and those that were lifted from it."""
    rng = np.random.default_rng([KINDS.index(kind), MARKS.index(marks), len(dtype), anchored])
    arrays = [np.zeros((MODELS, width, NUM_ACTIONS, width)) for width in (SOURCE_WIDTH, TARGET_WIDTH)]
    num_labels = 2 if marks == "large" else 1
    labels = [np.zeros((*side.shape[:3], num_labels)) for side in arrays]
    sizes = np.ones((2, MODELS), int)
    for k in range(MODELS):
        model, label = None, None
        for side in (1, 0):
            if side == 0 and k % 2:
                model, label = lifted(rng, model, label)
            else:
                size = rng.integers(1, arrays[side].shape[1] + 1)
                model, label = probabilities(rng, kind, size), marks_of(rng, marks, size)
            sizes[side, k] = n = len(model)
            allowed = 1.0 - label[:, :, :1] * (marks == "refused")
            arrays[side][k, :n, :, :n], labels[side][k, :n] = model * allowed, label
    source, target = (side.astype(dtype) for side in arrays)
    names = ("source_labels", "target_labels")
    given = {} if marks == "none" else {name: side.astype(dtype) for name, side in zip(names, labels, strict=True)}
    pairs = np.concatenate([rng.integers(MODELS, size=(MODELS, 2)), np.repeat(np.arange(MODELS)[:, None], 2, axis=1)])
    models = ModelPairs.of(
        source, target, source_size=sizes[0], target_size=sizes[1], **given, anchored=anchored, pairs=pairs
    )
    return models, np.array([optimum(models, *pair) for pair in pairs])


def optimum(models, one, other):
    """e of one pair, by HiGHS."""
    n, m = models.source_size[one], models.target_size[other]
    labels = None
    if models.source_labels is not None:
        labels = models.source_labels[one, :n].astype(float), models.target_labels[other, :m].astype(float)
    source, target = models.source[one, :n, :, :n].astype(float), models.target[other, :m, :, :m].astype(float)
    return oracles.homomorphism_lp(source, target, models.anchored, labels)[0]


every_case = pytest.mark.parametrize(
    ("kind", "marks", "dtype", "anchored"),
    [(kind, marks, "float64", True) for kind in KINDS for marks in MARKS]
    + [(kind, "refused", "float32", True) for kind in KINDS]
    + [(kind, marks, "float64", False) for kind in KINDS[:3] for marks in MARKS],
)


@every_case
def test_what_is_proved_is_true(kind, marks, dtype, anchored):
    models, error = case(kind, marks, dtype, anchored)
    asked = np.arange(len(error))
    for threshold in THRESHOLDS:
        lower, upper = bounds_by_intervals(models, asked, threshold, TOLERANCE)
        assert (lower <= error + 1e-9).all() and (error <= upper + 1e-9).all()
        assert ((lower > threshold) | np.isfinite(upper)).all() and lower.dtype == upper.dtype == models.dtype
    if anchored:
        assert (lower_bounds_without_iterations(models) <= error + 1e-9).all()
    assert (error <= upper_bounds_without_iterations(models) + 1e-9).all()


@every_case
def test_decisions(kind, marks, dtype, anchored):
    """Whatever decides: the answer is that of HiGHS, and says how it was found."""
    models, error = case(kind, marks, dtype, anchored)
    decided = 0
    for threshold in THRESHOLDS:
        found = bracket_errors(**models._asdict(), goal=Goal(threshold=threshold, tolerance=TOLERANCE))
        assert (found.lower <= error + 1e-9).all() and (error <= found.upper + 1e-9).all()
        np.testing.assert_array_equal(found.status, Status.SOLVED)
        is_clear = (error <= threshold + 1e-9) | (error > threshold + TOLERANCE)
        is_similar = found.upper <= threshold + TOLERANCE
        np.testing.assert_array_equal(is_similar[is_clear], (error <= threshold + 1e-9)[is_clear])
        assert (is_similar | (found.lower > threshold)).all()
        decided += (found.iterations == 0).sum()
    assert decided > 0
    if anchored and kind == "deterministic":
        found = bracket_errors(**models._asdict(), goal=Goal(threshold=0.0))
        assert not found.iterations.any() and (found.upper <= TOLERANCE).sum() >= MODELS // 2


# ----------------------------------------------------------------------------------------------------- whole models


def irregular(*, dtype=np.float64, num_states=40, num_actions=3):
    """A deterministic model whose states lead to one to three of the next six, and lack the other actions."""
    rng = np.random.default_rng(5)
    allowed = np.arange(num_actions) < rng.integers(1, num_actions + 1, num_states)[:, None]
    ahead = rng.integers(1, 7, (num_states, num_actions))
    next_state = (np.arange(num_states)[:, None] + ahead) % num_states
    return next_state[..., None], np.ones((num_states, num_actions, 1), dtype), allowed


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("refuses", [True, False])
def test_deterministic_models_need_no_iterations(refuses, dtype):
    next_state, probability, allowed = irregular(dtype=dtype)
    if not refuses:  # exits that are not there lead to the first
        next_state = np.where(allowed[..., None], next_state, next_state[:, :1])
    mdp = MDP.from_successors(next_state, probability, discount=0.9, allowed=allowed if refuses else None)
    table = SimilarityTable(mdp, distance=2)
    table.classes()
    sources, targets = np.divmod(np.random.default_rng(6).choice(1600, 60, replace=False), 40)
    similar = table.decide(sources, targets)
    assert table.num_solved == 0
    pairs, known = table.known()
    assert not known.iterations.any() and len(pairs) > 40 and table.num_classes > 15
    errors = [exact_error(mdp, *pair) for pair in zip(sources, targets, strict=True)]
    np.testing.assert_array_equal(similar, np.array(errors) <= 1e-6)
    assert similar.any() and not similar.all()


def exact_error(mdp, one, other):
    """e between the local models of two states at distance 2, by HiGHS."""
    tensor, refused = np.asarray(mdp.transition, float), ~np.asarray(mdp.allowed)
    (states, source), (other_states, target) = (oracles.local_model(tensor, state, 2) for state in (one, other))
    labels = tuple(refused[members][..., None].astype(float) for members in (states, other_states))
    return oracles.homomorphism_lp(source, target, labels=labels)[0]


def test_a_few_entries_at_a_time(monkeypatch):
    """The same bounds to the last bit."""
    models, error = case("sparse", "refused", "float64", True)
    whole = bounds_by_intervals(models, np.arange(len(error)), 0.05, TOLERANCE)
    monkeypatch.setattr(blocks, "_MAX_SHARES", 100)
    monkeypatch.setattr(propagation, "_CHUNK_ENTRIES", 1000)
    parts = bounds_by_intervals(models, np.arange(len(error)), 0.05, TOLERANCE)
    np.testing.assert_array_equal(whole, parts)


def test_pairs_of_models_with_too_many_entries_are_left_alone(monkeypatch):
    models, error = case("stochastic", "none", "float64", True)
    asked = np.arange(len(error))
    work = 2 * (models.source_size**2)[models.pairs[:, 0]] * NUM_ACTIONS * TARGET_WIDTH
    work += 2 * (models.target_size**2)[models.pairs[:, 1]] * NUM_ACTIONS * SOURCE_WIDTH
    whole = bounds_by_intervals(models, asked, 0.05, TOLERANCE)
    limit = int(np.median(work))
    monkeypatch.setattr(propagation, "_MAX_WORK", limit)
    for found, before, nothing in zip(
        bounds_by_intervals(models, asked, 0.05, TOLERANCE), whole, (0, np.inf), strict=True
    ):
        np.testing.assert_array_equal(found, np.where(work <= limit, before, nothing))


def test_pairs_that_are_not_numbers_are_not_decided():
    models, error = case("sparse", "none", "float64", True)
    source = models.source.copy()
    source[0, 0, 0, 0] = np.nan
    lower, upper = bounds_by_intervals(models._replace(source=source), np.arange(len(error)), 0.05, TOLERANCE)
    whole_lower, whole_upper = bounds_by_intervals(models, np.arange(len(error)), 0.05, TOLERANCE)
    is_broken = models.pairs[:, 0] == 0
    assert is_broken.any() and not (lower > 0.05)[is_broken].any() and not (upper <= 0.06)[is_broken].any()
    np.testing.assert_array_equal(lower[~is_broken], whole_lower[~is_broken])
    np.testing.assert_array_equal(upper[~is_broken], whole_upper[~is_broken])


def test_what_is_far_is_far_for_higher_thresholds_too():
    """Lower bounds are found where they serve more than the threshold that was asked for."""
    models, error = case("deterministic", "none", "float64", True)
    lower, _ = bounds_by_intervals(models, np.arange(len(error)), 0.0, TOLERANCE)
    assert (lower[error > 0.5] > 0.2).all() and (lower > 0.2).any()


def test_without_pairs():
    models, _ = case("sparse", "none", "float64", True)
    assert [bounds.shape for bounds in bounds_by_intervals(models, np.zeros(0, int), 0.0, TOLERANCE)] == [(0,), (0,)]


def test_progress_counts_every_pair_once(monkeypatch):
    """Those that centres decide, intervals and solvers; and a class with itself."""
    bars = []

    class Recorded(settling.tqdm):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            bars.append(self)

    monkeypatch.setattr(settling, "tqdm", Recorded)
    table = SimilarityTable(MDP.from_dense(np.random.default_rng(7).dirichlet(np.ones(6), (6, 2)), discount=0.9))
    for threshold in (0.3, 0.2):
        table.complete(threshold, progress=True)
    _, known = table.known()
    assert table.num_solved > 0 and (known.iterations == 0).any()
    assert bars and all(bar.n == bar.total > 0 for bar in bars)
