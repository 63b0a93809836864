"""The table of similarities: asked in any order, it answers as if it were new, and solves nothing twice."""

import concurrent.futures
import copy
import functools
import pickle
import sys

import numpy as np
import oracles
import pytest

from jaxhom import MDP, SimilarityTable, Status, gridworld, local_similarity, locally_similar, programs, racetrack
from jaxhom.similarity import class_pairs, classes, pair_bounds, relations, settling
from jaxhom.similarity import table as table_module
from jaxhom.similarity.local_models import local_models


@functools.cache
def model(dtype=np.float64):
    """Four models of three to five states that never meet, every one of them dense."""
    rng, transition, first = np.random.default_rng(0), np.zeros((16, 2, 16), dtype), 0
    for size in (3, 4, 4, 5):
        last = first + size
        transition[first:last, :, first:last] = rng.dirichlet(np.ones(size), size=(size, 2))
        first = last
    return MDP.from_dense(transition, discount=0.9)


SOURCES, TARGETS = np.repeat([0, 3, 8, 11], 4), np.tile([1, 4, 9, 14], 4)


@functools.cache
def optima():
    tensor = np.asarray(model().transition)
    around = [oracles.local_model(tensor, s, 1)[1] for s in range(16)]
    return np.array([oracles.homomorphism_lp(around[s], around[t])[0] for s, t in zip(SOURCES, TARGETS, strict=True)])


def test_brackets_serve_every_threshold():
    table = SimilarityTable(model())
    found = table.brackets(SOURCES, TARGETS)
    assert np.all(found.lower <= optima() + 1e-9) and np.all(optima() <= found.upper + 1e-9)
    solved = table.num_solved
    for threshold in np.linspace(0.0, 1.0, 9):
        if np.abs(optima() - threshold).min() > 1e-3:
            np.testing.assert_array_equal(table.decide(SOURCES, TARGETS, threshold), optima() <= threshold)
    assert table.num_solved == solved


def test_bounds_only_get_better():
    """Decisions at one threshold and another, then brackets, loose and tight: the better bounds stay."""
    table, lower, upper = SimilarityTable(model()), 0.0, np.inf
    table.decide(SOURCES, TARGETS, 0.3)
    table.decide(SOURCES, TARGETS, 0.1)
    for tolerance in (2.0, 1e-2, 1e-6, 1e-4):
        found = table.brackets(SOURCES, TARGETS, tolerance=tolerance)
        assert np.all(found.lower >= lower) and np.all(found.upper <= upper)
        assert np.all(found.upper - found.lower <= tolerance) and np.all(found.status == Status.SOLVED)
        assert np.all(found.lower <= optima() + 1e-9) and np.all(optima() <= found.upper + 1e-9)
        lower, upper = found.lower, found.upper


def test_what_was_decided_is_not_solved_again():
    table = SimilarityTable(model())
    first = table.decide(SOURCES, TARGETS, 0.2, mutual=True, tolerance=1e-3)
    solved = table.num_solved
    assert 0 < solved <= 2 * len(SOURCES)
    np.testing.assert_array_equal(table.decide(TARGETS, SOURCES, 0.2, mutual=True, tolerance=1e-3), first)
    np.testing.assert_array_equal(first, locally_similar(model(), SOURCES, TARGETS, 0.2, mutual=True, tolerance=1e-3))
    assert table.num_solved == solved


def test_a_pair_that_stays_open_is_tried_once_for_each_limit():
    table = SimilarityTable(model())
    options = {"tolerance": 1e-9, "method": "pdhg"}
    found = table.brackets(SOURCES, TARGETS, **options, max_iterations=32)
    is_open = found.status != Status.SOLVED
    assert is_open.any() and np.all(found.status[is_open] == Status.ITERATION_LIMIT)
    solved = table.num_solved
    again = table.brackets(SOURCES, TARGETS, **options, max_iterations=32)
    assert table.num_solved == solved
    np.testing.assert_array_equal(again.upper, found.upper)
    more = table.brackets(SOURCES, TARGETS, **options, max_iterations=512)
    assert table.num_solved > solved and (more.upper - more.lower).sum() < (found.upper - found.lower).sum()


def test_statuses_of_decisions(monkeypatch):
    """A pair is open only while neither direction is known to be too far."""
    near, far = (int(k) for k in (np.argmin(optima()), np.argmax(optima())))
    monkeypatch.setattr(programs, "pays", lambda seconds: True)  # all by programs, whose iterations are limited
    monkeypatch.setattr(class_pairs, "_MAX_PRODUCTS", 0.0)
    monkeypatch.setattr(class_pairs, "_MIN_ITERATIONS", 1)
    table = SimilarityTable(model())
    sources, targets = SOURCES[[near, far]], TARGETS[[near, far]]
    threshold = optima()[near] - 1e-6  # just missed: takes many iterations to tell
    found = table.decisions(sources, targets, threshold, tolerance=1e-9)
    assert not found.similar.any() and found.status[0] == Status.ITERATION_LIMIT
    for mutual in (False, True):
        assert table.decisions(sources, targets, 1.0, mutual=mutual).status.tolist() == [0, 0]
    assert table.decisions([0], [0], mutual=True).status.tolist() == [Status.SOLVED]


def test_the_complete_table_decides_without_solving():
    table = SimilarityTable(gridworld(6)).complete(0.2)
    pairs, bounds = table.known()
    assert table.num_classes == 9 and pairs.tolist() == [[i, j] for i in range(9) for j in range(9)]
    assert np.all((bounds.lower > 0.2) | (bounds.upper <= 0.2 + 1e-4))
    solved = table.num_solved
    sources, targets = np.divmod(np.arange(36 * 36), 36)
    found = table.decide(sources, targets, 0.2, mutual=True)
    np.testing.assert_array_equal(found, locally_similar(gridworld(6), sources, targets, 0.2, mutual=True))
    assert table.num_solved == solved


def test_one_table_for_other_functions():
    table = SimilarityTable(model())
    first = local_similarity(model(), SOURCES, TARGETS, table=table)
    assert table.num_solved == len(SOURCES)
    np.testing.assert_array_equal(locally_similar(model(), SOURCES, TARGETS, 0.3, table=table), first.upper <= 0.3001)
    assert table.num_solved == len(SOURCES)
    for options, message in (
        ({"table": 3}, "table must be a SimilarityTable, got int"),
        ({"table": table, "anchored": False}, "anchored=True, not with distance=1 and anchored=False"),
        ({"table": SimilarityTable(gridworld(3))}, "table was made for another model"),
    ):
        with pytest.raises(ValueError, match=message):
            local_similarity(model(), [0], [1], **options)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_maps_are_carried_over_to_every_member_of_a_class(dtype):
    """On a grid the nine classes' maps serve all pairs of states; each proves its own upper bound."""
    grid = gridworld(4, dtype=dtype).mdp
    table = SimilarityTable(grid)
    sources, targets = np.divmod(np.arange(16 * 16), 16)
    found = table.maps(sources, targets)
    assert table.num_solved == 72 and len(table._maps) == 81
    models = local_models(grid, np.arange(16))
    for p in range(0, 256, 7):
        s, t = sources[p], targets[p]
        n, m = models.size[[s, t]]
        np.testing.assert_array_equal(found.sources[p, :n], models.members[s, :n])
        f = found.maps[p, :n, :m].astype(float)
        product = np.einsum("iaj,jk->iak", models.transition[s, :n, :, :n].astype(float), f)
        product -= np.einsum("il,lak->iak", f, models.transition[t, :m, :, :m].astype(float))
        np.testing.assert_allclose(f.sum(axis=1), 1.0, atol=1e-5)
        assert np.abs(product).max() <= found.upper[p] + 1e-12 and f[0, 0] > 0.999
    assert (found.status == Status.SOLVED).all()
    assert (found.upper - found.lower).max() <= (1e-6 if dtype == np.float64 else 1e-4)


def interrupted_at(line, files, call):
    """Whether a call was interrupted, at the given line of all that it runs of some files."""
    left = [line]

    def trace(frame, event, _):
        if event == "line" and frame.f_code.co_filename in files:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
        return trace if event != "call" or frame.f_code.co_filename in files else None

    former = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(former)
    return False


@pytest.mark.parametrize("relation", ["weisfeiler_lehman", "homomorphism"])
def test_an_interruption_at_any_line_loses_time_and_no_truth(relation):
    """Asked again, the table answers as one that was never interrupted."""
    transition, asked = np.asarray(model().transition)[:7, :, :7], ([0, 1, 3], [5, 0, 6])
    make = functools.partial(SimilarityTable, MDP.from_dense(transition, discount=0.9), relation=relation)
    expected, files = make(), {module.__file__ for module in (classes, pair_bounds, relations, settling, table_module)}
    bounds = expected.brackets(*asked, tolerance=1e-2)
    for line in range(0, 10**6, 5 if relation == "weisfeiler_lehman" else 23):
        table = make()
        table.brackets([0], [3], tolerance=1e-2)
        is_over = not interrupted_at(line, files, lambda table=table: table.brackets(*asked, tolerance=1e-2))
        found = table.brackets(*asked, tolerance=1e-2)
        for name, leaf in dict(bounds).items():
            np.testing.assert_allclose(found[name], leaf, atol=1e-9)
        if is_over:
            break
    assert line > 100


def test_it_says_what_it_holds():
    table = SimilarityTable(gridworld(6))
    table.decide([0, 7], [7, 8])
    assert repr(table) == "SimilarityTable(36 states, distance 1, anchored; so far 2 classes, 2 pairs of them)"


def test_threads_share_a_table():
    """Each asks for pairs of its own, and all get what a single thread gets."""
    mdp = racetrack(["S...F", "S...F"]).mdp
    rng = np.random.default_rng(0)
    asked = rng.integers(0, mdp.num_states, (8, 2, 200))
    table, alone = SimilarityTable(mdp), SimilarityTable(mdp)
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda pairs: table.decide(*pairs, 0.1), asked))
    np.testing.assert_array_equal(found, [alone.decide(*pairs, 0.1) for pairs in asked])


def test_a_table_can_be_copied_and_pickled():
    table = SimilarityTable(gridworld(4), relation="lax", labels=np.ones((16, 1)))
    decided = table.decide([0, 1], [3, 2])
    for copied in (pickle.loads(pickle.dumps(table)), copy.deepcopy(table)):
        np.testing.assert_array_equal(copied.decide([0, 1], [3, 2]), decided)
        assert repr(copied) == repr(table)
