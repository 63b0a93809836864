"""Brackets of arrays of models: both methods against HiGHS, and the bounds that cost no iteration."""

import numpy as np
import oracles
import pytest

from jaxhom import Status
from jaxhom.similarity.brackets import METHODS, Goal, bracket_errors
from jaxhom.similarity.free_bounds import lower_bounds_without_iterations
from jaxhom.similarity.model_pairs import ModelPairs
from jaxhom.solvers import lane_queue

PAIRS = 24


def models(seed, n, m, num_actions=2, concentration=1.0):
    rng = np.random.default_rng(seed)
    return tuple(rng.dirichlet(np.full(k, concentration), (PAIRS, k, num_actions)) for k in (n, m))


def errors(source, target, anchored=True, labels=None):
    kept = [None] * len(source) if labels is None else zip(*labels, strict=True)
    pairs = zip(source.astype(float), target.astype(float), kept, strict=True)
    return np.array([oracles.homomorphism_lp(s, t, anchored, both)[0] for s, t, both in pairs])


def assert_holds(found, optimum, tolerance=1e-4):
    assert (found.status == Status.SOLVED).all() and (found.upper - found.lower <= tolerance).all()
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("method", METHODS)
def test_brackets_hold_the_optimum(method, number):
    """Any two of method, tolerance and anchor meet."""
    tolerance, anchored = (1e-4, 1e-6)[number], bool((number + METHODS.index(method)) % 2)
    source, target = models(0, 4, 3)
    found = bracket_errors(source, target, anchored=anchored, goal=Goal(method=method, tolerance=tolerance))
    optimum = errors(source, target, anchored)
    assert (found.upper - found.lower <= tolerance).all() and (found.status == 0).all()
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


@pytest.mark.parametrize("method", ["pdhg", "interior_point"])
def test_padding_changes_nothing(method):
    source, target = models(1, 4, 3)
    size = np.full(PAIRS, 4), np.full(PAIRS, 3)
    wide = np.zeros((PAIRS, 6, 2, 6)), np.zeros((PAIRS, 5, 2, 5))
    wide[0][:, :4, :, :4], wide[1][:, :3, :, :3] = source, target
    found = bracket_errors(*wide, source_size=size[0], target_size=size[1], goal=Goal(method=method, tolerance=1e-6))
    optimum = errors(source, target)
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


def test_interior_point_is_finished_by_pdhg_where_it_stalls():
    """Tolerances at the edge of rounding: no lane may be left open without saying so."""
    source, target = models(2, 4, 3)
    found = bracket_errors(source, target, goal=Goal(method="interior_point", tolerance=1e-9, max_iterations=2000))
    gap = found.upper - found.lower
    optimum = errors(source, target)
    assert ((gap <= 1e-9) == (found.status == 0)).all()
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


@pytest.mark.parametrize("concentration", [0.1, 1.0])
def test_bounds_without_iterations(concentration):
    source, target = models(3, 4, 3, concentration=concentration)
    bound = lower_bounds_without_iterations(ModelPairs.of(source, target))
    assert (bound <= errors(source, target) + 1e-9).all()
    assert (bound > 0.01).any()


@pytest.mark.parametrize("method", METHODS)
def test_decisions(method):
    source, target = models(4, 4, 3, concentration=0.3)
    optimum = errors(source, target)
    for threshold in np.quantile(optimum, [0.2, 0.6]) + 1e-3:
        found = bracket_errors(source, target, goal=Goal(threshold=threshold, method=method))
        np.testing.assert_array_equal(found.upper <= threshold + 1e-4, optimum <= threshold)
        assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()
        assert (found.iterations == 0).any()


def test_no_pairs():
    found = bracket_errors(np.zeros((0, 3, 2, 3)), np.zeros((0, 3, 2, 3)))
    assert found.lower.shape == found.status.shape == (0,)


def test_one_state_models():
    ones = np.ones((2, 1, 2, 1))
    found = bracket_errors(ones, ones, goal=Goal(threshold=0.0))
    assert (found.upper <= 1e-4).all()


@pytest.mark.parametrize("method", METHODS)
def test_one_state_source(method):
    """Anchored, nothing is free: the error is what the two centres differ by."""
    source, target = models(5, 1, 3)
    found = bracket_errors(source, target, goal=Goal(method=method))
    by_hand = np.maximum(1 - target[:, 0, :, 0], target[:, 0, :, 1:].max(axis=-1)).max(axis=1)
    assert_holds(found, by_hand)


# ------------------------------------------------------------------------------------ labels, actions that are missing


def labelled(seed, dtype=float):
    """Models of four and three states with two labels each; some rows lead nowhere, which the first label says."""
    rng = np.random.default_rng(seed)
    sides = []
    for model in models(seed, 4, 3):
        labels = rng.random((*model.shape[:3], 2))
        missing = rng.random(model.shape[:3]) < 0.2
        labels[..., 0] = missing
        sides.append((np.where(missing[..., None], 0.0, model).astype(dtype), labels.astype(dtype)))
    (source, source_labels), (target, target_labels) = sides
    return source, target, {"source_labels": source_labels, "target_labels": target_labels}


@pytest.mark.parametrize(
    ("method", "dtype", "anchored"),
    [
        ("pdhg", np.float64, True),
        ("pdhg", np.float64, False),
        ("interior_point", np.float64, False),
        ("auto", np.float32, True),
    ],
)
def test_labels(method, dtype, anchored):
    source, target, labels = labelled(6, dtype)
    optimum = errors(source, target, anchored, labels.values())
    assert (optimum > errors(source, target, anchored) + 0.05).any()
    assert_holds(bracket_errors(source, target, anchored=anchored, **labels, goal=Goal(method=method)), optimum)


def test_rows_that_lead_nowhere():
    source, target, _ = labelled(7)
    for anchored in (True, False):
        found = bracket_errors(source, target, anchored=anchored, goal=Goal(method="pdhg"))
        assert_holds(found, errors(source, target, anchored))


def test_labels_that_say_nothing():
    """Constant ones change nothing; a large range raises the bound that costs nothing."""
    source, target = models(0, 4, 3)
    labels = {
        "source_labels": np.full((*source.shape[:3], 2), 3.0),
        "target_labels": np.full((*target.shape[:3], 2), 3.0),
    }
    assert_holds(bracket_errors(source, target, **labels, goal=Goal(method="interior_point")), errors(source, target))


def test_labels_of_a_renamed_copy():
    """Renaming states leaves e = 0, and every other action gives away who is who."""
    source, _, labels = labelled(8)
    order = [0, 2, 3, 1]
    target = source[:, order][..., order]
    options = {"source_labels": labels["source_labels"], "goal": Goal(method="interior_point")}
    copied = bracket_errors(source, target, target_labels=labels["source_labels"][:, order], **options)
    assert (copied.upper <= 1e-4).all()
    other = bracket_errors(source, target, target_labels=1 - labels["source_labels"][:, order], **options)
    assert (other.lower > 0.1).all()


def test_bounds_without_iterations_with_labels():
    source, target, labels = labelled(9)
    bound = lower_bounds_without_iterations(ModelPairs.of(source, target, **labels))
    assert (bound <= errors(source, target, labels=labels.values()) + 1e-9).all()
    assert (
        bound >= np.abs(labels["source_labels"][:, 0] - labels["target_labels"][:, 0]).max(axis=(1, 2)) - 1e-12
    ).all()
    large = {name: 5.0 * label for name, label in labels.items()}
    found = bracket_errors(source, target, **large, goal=Goal(threshold=0.01))
    optimum = errors(source, target, labels=large.values())
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all() and (optimum > 1).any()


# ------------------------------------------------------------------------------------------- float32, the same answers


def test_float32_reaches_the_default_tolerance():
    """The rounding of the device's own bounds is beyond it; judged in float64 the points prove it."""
    rng = np.random.default_rng(10)
    source, target = (rng.dirichlet(np.ones(13), (4, 13, 4)).astype(np.float32) for _ in "ab")
    found = bracket_errors(source, target)
    assert found.lower.dtype == found.upper.dtype == np.float32
    assert_holds(found, errors(source, target))
    assert found.iterations.max() < 20_000


def lumping(num_states, num_blocks, num_actions, seed=11):
    """A model [n, A, n] and its exact lumping [m, A, m]: blocks of states with the block's row, spread at random."""
    rng = np.random.default_rng(seed)
    lumped = rng.dirichlet(np.ones(num_blocks), (num_blocks, num_actions))
    block = np.append(0, np.arange(num_states - 1) % (num_blocks - 1) + 1)
    model = np.zeros((num_states, num_actions, num_states))
    for k in range(num_blocks):
        (inside,) = np.nonzero(block == k)
        share = rng.dirichlet(np.ones(len(inside)), (num_states, num_actions))
        model[:, :, inside] = lumped[block][:, :, k, None] * share
    return model, lumped


def test_exact_lumpings_of_many_states_in_float32():
    """At threshold 0 an exact lumping is similar however many states it has, and one that is not exact is not."""
    model, lumped = (array.astype(np.float32)[None] for array in lumping(150, 3, 2))
    moved = lumped.copy()
    moved[0, 0, 0] = [0.2, 0.3, 0.5]
    source, target = np.repeat(model, 2, axis=0), np.concatenate([lumped, moved])
    found = bracket_errors(source, target, goal=Goal(threshold=0.0))
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    assert found.upper[0] <= 1e-4 < found.upper[1] and found.lower[1] > 1e-5


def test_the_same_answer_to_the_last_bit(monkeypatch):
    """Twice on two threads, and in another order: which lanes share a batch does not matter."""
    monkeypatch.setattr(lane_queue, "num_cores", lambda: 2)
    rng = np.random.default_rng(12)
    source, target = (rng.dirichlet(np.ones(3), (400, 3, 2)) for _ in "ab")
    first, again = (bracket_errors(source, target, goal=Goal(method="pdhg", tolerance=1e-5)) for _ in "ab")
    order = rng.permutation(400)
    reordered = bracket_errors(source[order], target[order], goal=Goal(method="pdhg", tolerance=1e-5))
    for field in ("lower", "upper", "iterations", "status"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
        np.testing.assert_array_equal(getattr(first, field)[order], getattr(reordered, field))


@pytest.mark.parametrize("method", METHODS)
def test_a_pair_that_is_not_a_number_ends_and_spoils_no_other(method):
    source, target = models(0, 4, 3)
    broken = source.copy()
    broken[3, 0, 0, 0] = np.nan
    found = bracket_errors(broken, target, goal=Goal(method=method))
    others = np.arange(PAIRS) != 3
    assert found.status[3] != Status.SOLVED and (found.status[others] == Status.SOLVED).all()
    whole = bracket_errors(source, target, goal=Goal(method=method))
    np.testing.assert_array_equal(found.upper[others], whole.upper[others])
