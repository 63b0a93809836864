"""Tables of similarities in files: an interrupted run goes on where it was, in another process too."""

import functools

import numpy as np
import pytest

from jaxhom import Demonstrations, SimilarityTable, gridworld, soft_local_homomorphism
from jaxhom.interop import FileError, load_similarity, save_similarity
from jaxhom.models.mdp import MDP
from jaxhom.similarity import pair_blocks
from jaxhom.similarity.class_pairs import ClassPairs

OPTIONS = {"threshold": 0.35, "mutual": True, "voters": "all", "weights": "similarity", "progress": True}


@functools.cache
def model(dtype=np.float64):
    """Twelve states on a ring, each with two successors of its own probability: no two local models are alike."""
    rng, n = np.random.default_rng(0), 12
    transition = np.zeros((n, 2, n), dtype)
    for s in range(n):
        for a in range(2):
            transition[s, a, [(s + 1 + a) % n, (s - 1) % n]] = rng.dirichlet([1.0, 1.0])
    return MDP.from_dense(transition, discount=0.9)


def same(one, other):
    """Whether two tables know the same, to the bit."""
    contents = one.contents(), other.contents()
    return contents[0].keys() == contents[1].keys() and all(
        np.array_equal(array, contents[1][name]) and array.dtype == contents[1][name].dtype
        for name, array in contents[0].items()
    )


@pytest.mark.parametrize("blocks", [0, 1, 3])
def test_interrupted_saved_and_loaded_algorithm_1_ends_as_if_in_one_go(monkeypatch, tmp_path, blocks):
    monkeypatch.setattr(pair_blocks, "_MOST", 8)
    monkeypatch.setattr(pair_blocks, "_LEAST", 8)
    monkeypatch.setattr(pair_blocks, "_UNDECIDED", 1.0)
    shown = Demonstrations.from_trajectories([([0, 1, 2, 4], [0, 0, 1, 0])])
    learn = functools.partial(soft_local_homomorphism, model(), shown, **OPTIONS)
    whole = SimilarityTable(model())
    expected = learn(table=whole)
    plain, solved = ClassPairs.brackets, []

    def interrupted(self, pairs, *options):
        if len(solved) == blocks:
            raise KeyboardInterrupt
        solved.append(len(pairs))
        return plain(self, pairs, *options)

    table = SimilarityTable(model())
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ClassPairs, "brackets", interrupted)
        learn(table=table)
    assert len(table.known()[0]) == sum(solved) == 8 * blocks < len(whole.known()[0])
    save_similarity(tmp_path / "table.npz", table)
    loaded = load_similarity(tmp_path / "table.npz", model())
    assert same(loaded, table) and loaded.num_solved == 0
    for again in (loaded, table):  # another process, and the same notebook
        found = learn(table=again)
        np.testing.assert_array_equal(found.policy, expected.policy)
        np.testing.assert_array_equal(found.radius, expected.radius)
    assert same(loaded, table) and loaded.num_solved + sum(solved) >= whole.num_solved


@pytest.mark.parametrize(
    ("dtype", "options", "asking"),
    [
        (np.float64, {}, {"method": "pdhg", "max_iterations": 8}),  # leaves pairs open
        (np.float32, {"labels": np.arange(24.0).reshape(12, 2), "label_weight": 0.1}, {}),
        (np.float64, {"distance": 2, "relation": "lax"}, {}),
        (np.float32, {"relation": "weisfeiler_lehman", "anchored": False}, {}),
    ],
    ids=["open", "labels", "lax", "kernel"],
)
def test_a_loaded_table_solves_nothing_that_the_saved_one_knew(tmp_path, dtype, options, asking):
    mdp, path = model(dtype), tmp_path / "table.npz"
    table = SimilarityTable(mdp, **options)
    asked = np.repeat([0, 3, 6], 4), np.tile([1, 2, 5, 9], 3)
    similar, bounds = table.decide(*asked, 0.3), table.brackets(*asked, tolerance=1e-2, **asking)
    renamings = table.renamings(*asked)
    save_similarity(path, table)
    loaded = load_similarity(path, mdp)
    assert repr(loaded) == repr(table) and same(loaded, table)
    np.testing.assert_array_equal(loaded.decide(*asked, 0.3), similar)
    again = loaded.brackets(*asked, tolerance=1e-2, **asking)
    for name, leaf in dict(bounds).items():
        np.testing.assert_array_equal(again[name], leaf)
    np.testing.assert_array_equal(loaded.renamings(*asked), renamings)
    assert loaded.num_solved == 0
    loaded.brackets([1], [0])  # and it grows like any other
    assert len(loaded.known()[0]) == len(table.known()[0]) + 1


def test_states_that_were_not_met_find_their_classes(tmp_path):
    grid = gridworld(6)
    table = SimilarityTable(grid)
    table.decide([0, 7], [7, 8])
    save_similarity(tmp_path / "table.npz", table)
    loaded = load_similarity(tmp_path / "table.npz", grid)
    assert loaded.num_classes == 2 and loaded.complete().num_classes == 9
    np.testing.assert_array_equal(loaded.relation().similar, table.complete().relation().similar)


def changed(contents, **changes):
    return {name: array for name, array in {**contents, **changes}.items() if array is not None}


MALFORMED = {
    "no pairs": ({"pairs": None}, "array 'pairs' is missing"),
    "another model": ({"transitions": np.zeros(32, np.uint8)}, "similarities of another model"),
    "no relation": ({"relation": np.array("likeness")}, "relation must be one of"),
    "a list of relations": ({"relation": np.array(["lax", "lax"])}, "relation must be one of"),
    "distance": ({"distance": np.array(0)}, "distance must be at least 1, got 0"),
    "half a distance": ({"distance": np.array(0.5)}, "distance must be a whole number, got 0.5"),
    "anchored": ({"anchored": np.array(2)}, "anchored must be true or false, got 2"),
    "labels of others": ({"labels": np.zeros((3, 2, 1))}, r"labels must have shape \(12, 2, L\)"),
    "states of others": ({"representative": np.array([0, 1, 12])}, r"representative\[2\] must be below 12, got 12"),
    "too few states": ({"class_of_state": np.zeros(3, int)}, r"class_of_state must have shape \(12,\), got \(3,\)"),
    "no class": ({"class_of_state": np.full(12, 3)}, r"class_of_state\[0\] must be below 3, got 3"),
    "keys": ({"class_key": np.zeros((3, 4), np.uint8)}, r"class_key must have shape \(3, 16\)"),
    "pairs of what": ({"pairs": np.array([[0, 1], [0, 3]])}, r"pairs\[1, 1\] must be below 3, got 3"),
    "triples": ({"pairs": np.zeros((2, 3), int)}, r"pairs must have shape \[Q, 2\]"),
    "twice": ({"pairs": np.array([[0, 1], [0, 1]])}, r"pairs\[1\] must come once each, in ascending order"),
    "below 0": ({"lower": np.array([-0.5, 0.0])}, r"lower\[0\] must be finite and not negative, got -0.5"),
    "no number": ({"upper": np.array([np.nan, 0.0])}, r"upper\[0\] must not be NaN"),
    "short": ({"upper": np.zeros(1)}, r"upper must have shape \(2,\), got \(1,\)"),
    "float32": ({"upper": np.zeros(2, np.float32)}, "upper must hold numbers of type float64, got dtype float32"),
    "status": ({"status": np.array([0, 9])}, r"status\[1\] must be below 3, got 9"),
    "iterations": ({"iterations": np.array([0, -9])}, r"iterations\[1\] must not be negative, got -9"),
    "tried": ({"tried": np.zeros((2, 1), int)}, r"tried must have shape \(2, 4\)"),
    "text": ({"tried": np.array("often")}, "tried must hold integers"),
}


@pytest.mark.parametrize(("changes", "message"), MALFORMED.values(), ids=MALFORMED)
def test_what_is_no_table_is_refused(tmp_path, changes, message):
    table, path = SimilarityTable(model()), tmp_path / "table.npz"
    table.decide([0, 0], [1, 2], 0.3)
    np.savez(path, **changed(table.contents(), **changes))
    with pytest.raises(FileError, match=rf"table\.npz: .*{message}"):
        load_similarity(path, model())


def test_renamings_that_are_none_are_refused(tmp_path):
    table, path = SimilarityTable(model(), relation="lax"), tmp_path / "table.npz"
    table.renamings([0, 0], [1, 2])
    for changes, message in (
        ({"renaming": None}, r"renaming must have shape \(2,\), got \(0,\)"),
        ({"renamed_pairs": None}, r"renamed_pairs must have shape \[Q, 2\]"),
        ({"renaming": np.array([0, 2])}, r"renaming\[1\] must be below 2, got 2"),
        ({"renamed_pairs": np.array([[0, 1], [0, 3]])}, r"renamed_pairs\[1, 1\] must be below 3, got 3"),
    ):
        np.savez(path, **changed(table.contents(), **changes))
        with pytest.raises(FileError, match=rf"table\.npz: {message}"):
            load_similarity(path, model())


def test_other_models_and_files_are_refused(tmp_path):
    path = tmp_path / "table.npz"
    with pytest.raises(FileError, match="no such file"):
        load_similarity(path, model())
    save_similarity(path, SimilarityTable(model()))
    for other in (gridworld(4), model(np.float32), model().replace(probability=model().probability[::-1])):
        with pytest.raises(FileError, match=r"table\.npz: these are similarities of another model"):
            load_similarity(path, other)
    load_similarity(path, model().replace(discount=model().discount / 2))
    with pytest.raises(ValueError, match="the relation is a function, which cannot be written down"):
        save_similarity(path, SimilarityTable(model(), relation=lambda one, other: True))
    load_similarity(path, model())  # what was there is there still
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FileError, match=r"not a readable \.npz archive"):
        load_similarity(path, model())
