"""Brackets of all pairs in a folder: the same as a table's, whoever makes which shard, and whatever kills them."""

import functools
import os
import signal
import subprocess
import sys
import time

import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, SimilarityTable, gridworld
from jaxhom.interop import FileError, load_all_brackets, save_all_brackets


@functools.cache
def model(dtype=np.float64):
    """Two copies of a model of five states, every one of which is of a class of its own."""
    rng, transition = np.random.default_rng(0), np.zeros((10, 2, 10), dtype)
    transition[:5, :, :5] = transition[5:, :, 5:] = rng.dirichlet(np.ones(5), (5, 2))
    return MDP.from_dense(transition, discount=0.9)


ALL = np.divmod(np.arange(100), 10)


def files(folder):
    return {name: os.stat(folder / name).st_mtime_ns for name in os.listdir(folder) if name.endswith(".npy")}


@pytest.mark.parametrize(
    ("dtype", "shard_size"), [(np.float64, 1), (np.float64, 7), (np.float32, 25), (np.float64, 99)]
)
def test_shards_hold_what_a_table_finds(tmp_path, dtype, shard_size):
    table = SimilarityTable(model(dtype))
    table.brackets([9, 3], [7, 2], tolerance=1e-2)  # whose numbers of classes are others
    before = len(table.known()[0])
    save_all_brackets(tmp_path, table, tolerance=1e-2, shard_size=shard_size)
    assert len(table.known()[0]) == before
    found = load_all_brackets(tmp_path, model(dtype))
    assert found.num_classes == 5 and found.num_shards == len(files(tmp_path)) == -(-25 // shard_size)
    np.testing.assert_array_equal(found.class_of_state, np.arange(10) % 5)
    np.testing.assert_array_equal(found.representative, np.arange(5))
    assert repr(found) == f"AllBrackets(5 classes; {found.num_shards} of {found.num_shards} shards)"
    bounds = found.brackets(*ALL)
    assert bounds.lower.dtype == dtype and (bounds.upper - bounds.lower).max() <= 1e-2 and not bounds.status.any()
    tensor = np.asarray(model().transition)
    around = [oracles.local_model(tensor, s, 1)[1] for s in range(5)]
    optima = np.array([[oracles.homomorphism_lp(one, other)[0] for other in around] for one in around])
    slack = 1e-9 if dtype == np.float64 else 1e-6
    exact = optima[ALL[0] % 5, ALL[1] % 5]
    assert (bounds.lower <= exact + slack).all() and (exact <= bounds.upper + slack).all()
    pairs, parts = zip(*found.shards(), strict=True)
    pairs = np.concatenate(pairs)
    assert pairs.tolist() == [[i, j] for i in range(5) for j in range(5)]
    again = found.brackets(*pairs.T)
    for name, leaf in dict(again).items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), leaf)


def test_parts_make_up_the_whole(tmp_path):
    """Each makes its shards alone, and the second run none."""
    for part, expected in (((1, 3), {1, 4}), ((0, 3), {0, 1, 3, 4}), ((2, 3), {0, 1, 2, 3, 4})):
        save_all_brackets(tmp_path, SimilarityTable(model()), tolerance=1e-2, shard_size=5, part=part)
        found = load_all_brackets(tmp_path, model())
        assert set(found.missing()) == set(range(5)) - expected
        if found.missing():
            with pytest.raises(FileError, match=r"brackets-000002\.npy: not made yet; save_all_brackets goes on"):
                found.brackets([2], [0])
            found.brackets([1], [4])
    made, table = files(tmp_path), SimilarityTable(model())
    save_all_brackets(tmp_path, table, tolerance=1e-2, shard_size=5, progress=True)
    assert files(tmp_path) == made and table.num_solved == 0


def test_an_interrupted_writer_goes_on(tmp_path, monkeypatch):
    plain, solved = SimilarityTable.brackets, []

    def interrupted(self, sources, targets, **options):
        solved.append(len(sources))
        if len(solved) == 4:
            raise KeyboardInterrupt
        return plain(self, sources, targets, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(SimilarityTable, "brackets", interrupted)
        save_all_brackets(tmp_path, SimilarityTable(model()), tolerance=1e-2, shard_size=5)
    made = files(tmp_path)
    assert len(made) == 2 and solved == [0, 5, 5, 5]  # the first checks options
    table = SimilarityTable(model())
    save_all_brackets(tmp_path, table, tolerance=1e-2, shard_size=5)
    assert made.items() <= files(tmp_path).items() and table.num_solved == 12 and len(files(tmp_path)) == 5


KILLED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
from jaxhom import SimilarityTable
from jaxhom.interop import save_all_brackets
from test_all_brackets import model
save_all_brackets(sys.argv[1], SimilarityTable(model()), tolerance=1e-2, shard_size=1)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows kills otherwise")
def test_a_killed_writer_leaves_whole_shards(tmp_path):
    here = os.path.dirname(__file__)
    paths = [here, os.path.dirname(here), os.path.dirname(os.path.dirname(here)), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "all")], env=environment)
    try:
        while process.poll() is None and not (tmp_path / "all" / "brackets-000003.npy").exists():
            time.sleep(0.002)
    finally:
        process.kill()
    process.wait()
    made = files(tmp_path / "all")
    assert len(made) >= 4
    save_all_brackets(tmp_path / "all", SimilarityTable(model()), tolerance=1e-2, shard_size=1)
    found = load_all_brackets(tmp_path / "all", model())
    assert not found.missing() and made.items() <= files(tmp_path / "all").items()
    alone = SimilarityTable(model()).brackets(*ALL, tolerance=1e-2)
    bounds = found.brackets(*ALL)
    assert (np.maximum(bounds.lower, alone.lower) <= np.minimum(bounds.upper, alone.upper) + 1e-12).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shard_size": 0}, "shard_size must be at least 1, got 0"),
        ({"part": 3}, r"part must be \(k, n\), got 3"),
        ({"part": (2, 2)}, r"part must be \(k, n\) with k below n, got \(2, 2\)"),
        ({"part": (-1, 2)}, r"part\[0\] must be at least 0, got -1"),
        ({"part": (0, 0.5)}, r"part\[1\] must be a whole number, got 0.5"),
        ({"tolerance": 0.0}, "tolerance must be positive, got 0.0"),
        ({"method": "simplex"}, "method must be one of"),
        ({"max_iterations": 0}, "max_iterations must be at least 1, got 0"),
    ],
)
def test_options_are_checked_before_anything_is_written(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        save_all_brackets(tmp_path / "all", SimilarityTable(model()), **options)
    assert not (tmp_path / "all").exists()


def test_a_table_that_cannot_be_written_down_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="the relation is a function"):
        save_all_brackets(tmp_path, SimilarityTable(model(), relation=lambda one, other: True))
    monkeypatch.setattr(jaxhom.interop.all_brackets.jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match="give each a table of its own, and a part of the shards"):
        save_all_brackets(tmp_path, SimilarityTable(model(), across_processes=True))


@pytest.fixture
def folder(tmp_path):
    save_all_brackets(tmp_path, SimilarityTable(model()), tolerance=1e-2, shard_size=20)
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "options", "name"),
    [
        ({}, {"tolerance": 1e-3}, "tolerance"),
        ({}, {"shard_size": 5}, "shard_size"),
        ({}, {"method": "pdhg"}, "method"),
        ({"anchored": False}, {}, "anchored"),
        ({"labels": np.zeros((10, 1))}, {}, "labels"),
        ({"relation": "isomorphic"}, {}, "relation"),
    ],
)
def test_a_folder_is_of_one_kind(folder, kind, options, name):
    options = {"tolerance": 1e-2, "shard_size": 20, **options}
    with pytest.raises(FileError, match=rf"about\.npz: brackets of something else: another {name}"):
        save_all_brackets(folder, SimilarityTable(model(), **kind), **options)


def test_what_is_no_folder_of_brackets_is_refused(folder, tmp_path):
    with pytest.raises(FileError, match=r"about\.npz: no such file"):
        load_all_brackets(tmp_path / "nothing", model())
    with pytest.raises(FileError, match=r"about\.npz: brackets of another model"):
        load_all_brackets(folder, gridworld(4))
    with np.load(folder / "about.npz") as archive:
        about = dict(archive)
    for changes, message in (
        ({"representative": None}, "array 'representative' is missing"),
        ({"representative": np.array([0, 1, 2, 3, 10])}, r"representative\[4\] must be below 10, got 10"),
        ({"class_of_state": np.zeros(3, int)}, r"class_of_state must have shape \(10,\), got \(3,\)"),
        ({"class_of_state": np.full(10, 7)}, r"class_of_state\[0\] must be below 5, got 7"),
        ({"shard_size": np.array("many")}, "shard_size must be a whole number, got 'many'"),
    ):
        np.savez(folder / "about.npz", **{k: v for k, v in {**about, **changes}.items() if v is not None})
        with pytest.raises(FileError, match=rf"about\.npz: {message}"):
            load_all_brackets(folder, model())


def test_damaged_shards_are_refused(folder):
    found, path = load_all_brackets(folder, model()), folder / "brackets-000001.npy"
    whole = path.read_bytes()
    for content, message in ((b"", "not a readable"), (b"lower", "not a readable"), (whole[:-1], "not a readable")):
        path.write_bytes(content)
        with pytest.raises(FileError, match=rf"brackets-000001\.npy: {message}"):
            found.brackets([4], [4])
    for array in (np.zeros(5), np.zeros(3, found.row_type)):
        np.save(path, array)
        with pytest.raises(FileError, match=r"brackets-000001\.npy: not the brackets of 5 pairs"):
            list(found.shards())
    np.savez(path.with_suffix(".npz"), lower=np.zeros(5))
    os.replace(path.with_suffix(".npz"), path)
    with pytest.raises(FileError, match=r"brackets-000001\.npy: not the brackets of 5 pairs"):
        list(found.shards())


def test_states_are_checked(folder):
    found = load_all_brackets(folder, model())
    with pytest.raises(ValueError, match=r"targets\[1\] must be below 10, got 10"):
        found.brackets([0, 1], [2, 10])
    with pytest.raises(ValueError, match=r"targets must have shape \(2,\), got \(1,\)"):
        found.brackets([0, 1], [2])
