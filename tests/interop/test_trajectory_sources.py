"""One door to trajectories: archives, folders, tables and objects in the layouts that other libraries write."""

import json
import pathlib
import pickle
import re
import sys
import types

import numpy as np
import pandas
import pytest

from jaxhom import MDP, Demonstrations
from jaxhom.interop import FileError, demonstrations_from, save_demonstrations

EPISODES = [([0, 2, 2, 4], [1, 0, 1]), ([3, 1], [0])]  # with the states where they ended
STEPS = [(states[:-1], actions) for states, actions in EPISODES]
FLAT = {
    "obs": np.array([0, 2, 2, 3]),
    "acts": np.array([1, 0, 1, 0]),
    "next_obs": np.array([2, 2, 4, 1]),
    "dones": np.array([False, False, True, False]),
}
LIMIT = '{"py/object": "never read", "TimeLimit.truncated": true}'


def pairs(demonstrations):
    return [(states.tolist(), actions.tolist()) for states, actions in demonstrations]


def one_hot(states):
    return np.eye(5)[states]


D4RL = {
    "observations": one_hot(FLAT["obs"]),
    "actions": FLAT["acts"],
    "rewards": np.zeros(4),
    "terminals": FLAT["dones"],
    "timeouts": np.array([0, 0, 0, 1]),
}
ROWS = {  # a data set with a row per episode, as imitation saves it
    "obs": [states for states, _ in EPISODES],
    "acts": [actions for _, actions in EPISODES],
    "infos": [["{}", "{}", "{}"], [LIMIT]],
    "terminal": [True, True],
    "rews": [[0.0, 0.0, 1.0], [0.5]],
}


class DataSet:
    """What is used of `datasets.Dataset`: named columns, that are sequences of Python's values."""

    def __init__(self, columns):
        self._columns, self.column_names = columns, list(columns)

    def __getitem__(self, name):
        return iter(self._columns[name])


# ------------------------------------------------------------------------------------ objects

OBJECTS = {
    "episodes": (lambda: EPISODES, EPISODES, [False, False]),
    "transitions": (lambda: FLAT, EPISODES, [True, False]),
    "object": (lambda: types.SimpleNamespace(**FLAT), EPISODES, [True, False]),
    "frame": (lambda: pandas.DataFrame(FLAT), EPISODES, [True, False]),
    "data set": (lambda: DataSet(ROWS), EPISODES, [True, False]),
    "splits": (lambda: {"test": DataSet(FLAT), "train": DataSet(ROWS)}, EPISODES, [True, False]),
    "one split": (lambda: {"expert": DataSet(ROWS)}, EPISODES, [True, False]),
    "flat data set": (
        lambda: DataSet({name: column.tolist() for name, column in FLAT.items()}),
        EPISODES,
        [True, False],
    ),
    "one episode": (lambda: {"obs": [0, 2, 2, 4], "acts": [1, 0, 1], "dones": [0, 0, 1]}, EPISODES[:1], [True]),
    "infos": (
        lambda: {**FLAT, "dones": [0, 0, 1, 1], "infos": [{}, {}, {}, {"TimeLimit.truncated": True}]},
        EPISODES,
        [True, False],
    ),
    "rows as texts": (
        lambda: pandas.DataFrame({"states": ["[0, 2, 2, 4]", "(3, 1)"], "actions": ["[1 0 1]", "[0]"]}),
        EPISODES,
        [False, False],
    ),
    "cells as texts": (
        lambda: pandas.DataFrame(
            {"traj": ["a", "a", "a", "b"], "s": ["0", "2", "2", "3"], "a": ["1", "0.0", "1", "0"]}
        ),
        STEPS,
        [False, False],
    ),
    "rows of one length": (
        lambda: {"observations": [[0, 2, 2], [3, 1, 1]], "actions": [[1, 0], [0, 1]], "terminal": [1, 0]},
        [([0, 2, 2], [1, 0]), ([3, 1, 1], [0, 1])],
        [True, False],
    ),
    "missing actions": (
        lambda: pandas.DataFrame({"run": [7, 7, 3, 7, 3, 7], "s": [0, 2, 3, 2, 1, 4], "a": [1, 0, 0, 1, None, np.nan]}),
        EPISODES,
        [False, False],
    ),
    "steps in disorder": (
        lambda: {"run": [1, 1, 2, 1], "t": [9, 5, 0, 7], "s": [2, 0, 3, 2], "a": [1, 1, 0, 0]},
        STEPS,
        [False, False],
    ),
    "columns of one": (
        lambda: {**FLAT, "obs": FLAT["obs"][:, None], "next_obs": FLAT["next_obs"][:, None]},
        EPISODES,
        [True, False],
    ),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_of_every_kind(name):
    make, expected, terminated = OBJECTS[name]
    demonstrations, report = demonstrations_from(make())
    assert pairs(demonstrations) == expected
    np.testing.assert_array_equal(demonstrations.terminated, terminated)
    assert (report.episodes, report.dropped) == (len(expected), ())


def test_dictionaries_of_d4rl():
    demonstrations, report = demonstrations_from(D4RL, to_states=lambda obs: obs.argmax(axis=-1))
    assert pairs(demonstrations) == STEPS
    np.testing.assert_array_equal(demonstrations.terminated, [True, False])
    assert report.unread == ("rewards",) and report.final_observations == 0
    more = {**D4RL, "next_observations": one_hot(FLAT["next_obs"])}
    assert pairs(demonstrations_from(more, to_states=lambda obs: obs.argmax(axis=-1))[0]) == EPISODES


def test_episodes_that_cannot_be_used_are_dropped():
    demonstrations, report = demonstrations_from({**FLAT, "acts": [1, 0, 1, 0.5]})
    assert pairs(demonstrations) == EPISODES[:1]
    assert report.dropped == ((1, "actions[0] must be whole, got 0.5"),)


@pytest.mark.parametrize("is_full", [False, True])
def test_replay_buffers(is_full):
    """Of one environment, in Stable-Baselines3's layout [T, E, 1]: filled in part, or gone round."""
    columns = {name: FLAT[name] for name in ("obs", "acts", "next_obs", "dones")}
    names = dict(zip(columns, ("observations", "actions", "next_observations", "dones"), strict=True))
    shift = (lambda a: np.roll(a, 3)) if is_full else (lambda a: np.append(a, [9, 9]).astype(a.dtype))
    fields = {names[name]: shift(array).reshape(-1, 1, 1) for name, array in columns.items()}
    fields |= {"dones": fields["dones"][..., 0], "timeouts": np.zeros_like(fields["dones"][..., 0])}
    buffer = types.SimpleNamespace(**fields, pos=3 if is_full else 4, full=is_full, buffer_size=len(fields["dones"]))
    demonstrations, _ = demonstrations_from(buffer)
    assert pairs(demonstrations) == EPISODES
    np.testing.assert_array_equal(demonstrations.terminated, [True, False])


@pytest.mark.parametrize("is_flat", [False, True])
def test_buffers_of_several_environments(is_flat):
    """Two side by side, [T, E]: the first begins an episode in its third step, the second goes on."""
    states, starts = np.array([[0, 5], [1, 6], [2, 7]]), np.array([[1, 0], [0, 0], [1, 0]])
    columns = {"observations": states[..., None], "actions": np.ones((3, 2, 1), int)}
    if is_flat:
        columns = {name: array.swapaxes(0, 1).reshape(6, 1) for name, array in columns.items()}
    demonstrations, _ = demonstrations_from({**columns, "episode_starts": starts})
    assert [states for states, _ in pairs(demonstrations)] == [[0, 1], [2], [5, 6, 7]]


def test_names_of_the_model():
    mdp = MDP.from_dense(
        np.full((3, 2, 3), 1 / 3), discount=0.9, state_names=[(0, 0), (0, 1), "end"], action_names=["up", "down"]
    )
    for table in (
        {"run": [0, 0, 0], "obs": [(0, 1), (0, 0), "end"], "act": ["up", "down", None]},
        pandas.DataFrame({"run": [0, 0, 0], "obs": ["(0, 1)", "[0, 0]", "end"], "act": ["up", "1", ""]}),
    ):
        assert pairs(demonstrations_from(table, mdp=mdp)[0]) == [([1, 0, 2], [0, 1])]
    episodes = [(np.array([[0, 1], [0, 0]]), ["up"]), ([[0, 1], [0, 2]], [0])]
    demonstrations, report = demonstrations_from(episodes, mdp=mdp)
    assert pairs(demonstrations) == [([1, 0], [0])]
    for broken in (5, np.array(5), None):
        with pytest.raises(ValueError, match="episode 0: observations must have shape"):
            demonstrations_from([(broken, [0])], mdp=mdp)
    assert report.dropped == ((1, "observations[1]: there is no state (0, 2); did you mean (0, 1) or (0, 0)?"),)


@pytest.mark.parametrize("names", [[("hall", 0), ("hall", 1)], [((0, 1), "hall"), ((1, 0), "hall")], [("a", "b"), "c"]])
def test_names_with_parts_of_several_kinds(names):
    """An array of NumPy would hold texts in place of the numbers, or nothing at all."""
    mdp = MDP.from_dense(np.eye(2)[:, None], discount=0.9, state_names=names)
    table = {"run": [0, 0, 1], "obs": [names[1], names[1], names[0]], "act": [0, 0, 0]}
    for source in (table, pandas.DataFrame(table)):
        assert pairs(demonstrations_from(source, mdp=mdp)[0]) == [([1, 1], [0, 0]), ([0], [0])]


def test_tables_of_states_alone():
    ring = MDP.from_dense(np.eye(3)[[[0, 1], [1, 2], [2, 0]]], discount=0.9)
    table = {"run": [0, 1, 0, 0, 1], "obs": [0, 2, 1, 1, 0], "reward": [0] * 5}
    demonstrations, report = demonstrations_from(table, mdp=ring)
    assert pairs(demonstrations) == [([0, 1, 1], [1, 0]), ([2, 0], [1])]
    assert report.unread == ("reward",)
    hot = {"run": table["run"], "obs": np.eye(3)[table["obs"]]}
    by_map, _ = demonstrations_from(hot, mdp=ring, to_states=lambda obs: obs.argmax(axis=-1))
    assert pairs(by_map) == pairs(demonstrations)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            {"a": DataSet(ROWS), "b": DataSet(ROWS)},
            "several splits, 'a', 'b', and none is called 'train': pass one of them",
        ),
        ({"obs": [0, 1]}, "column 'action' is missing (there is 'state')"),
        (
            {"obs": [0, 1], "acts": [0, 1]},
            "column 'episode' is missing, and so is whatever else would tell episodes",
        ),
        ({"obs": [0, 1, 2, 3], "acts": [0, 1]}, "action must have shape (4, ...) like state, T >= 1, got (2,)"),
        ({"obs": 3, "acts": [0, 1]}, "column 'state' must have shape [T, ...], got ()"),
        ({**FLAT, "dones": [0, 0, 2, 0]}, "dones[2] must be True or False, got 2"),
        ({**FLAT, "ep": [1, 1, 2, 2], "dones": [0] * 4}, "rows 2 and 3: the next state is 4, but then the state is 3"),
        ({**FLAT, "ep": [1, 1, None, 1]}, "episode[2] is missing"),
        ({**FLAT, "t": [0, 1, "x", 2]}, "step[2]: must be a whole number, got 'x'"),
        (
            {**FLAT, "obs": FLAT["obs"] + 0.5},
            "none of 4 episodes can be used; episode 0: observations[0] ",
        ),
        ({**FLAT, "state": FLAT["obs"]}, "columns 'obs' and 'state' could both be the state: keep one"),
        (7, "episodes must be a sequence of episodes, got int"),
        ({}, "there are no episodes"),
    ],
)
def test_tables_that_cannot_be_used_are_refused(source, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations_from(source)


# -------------------------------------------------------------------------------------- files


def write_old_imitation(path, **changes):
    """The archive of before `datasets`: one array of all observations, which has a pickled column beside it."""
    arrays = {
        "obs": np.concatenate([states for states, _ in EPISODES]),
        "acts": np.concatenate([actions for _, actions in EPISODES]),
        "infos": np.array([{}] * 4),
        "terminal": np.array([True, True]),
        "indices": np.array([3]),
    }
    np.savez(path, **{**arrays, **changes})


ARCHIVES = {
    "flat": (lambda path: np.savez(path, **FLAT), EPISODES),
    "expert": (
        lambda path: np.savez(
            path,
            obs=FLAT["obs"][:, None],
            actions=FLAT["acts"][:, None],
            rewards=np.zeros(4),
            episode_returns=np.zeros(2),
            episode_starts=np.array([True, False, False, True]),
        ),
        STEPS,
    ),
    "imitation of old": (write_old_imitation, EPISODES),
    "our own": (lambda path: save_demonstrations(path, Demonstrations.from_trajectories(EPISODES)), EPISODES),
    "our own by hand": (lambda path: np.savez(path, states=[[0, 2], [3, 1]], actions=[[1, 0], [0, 1]]), None),
}


UNREAD = {"expert": ("rewards", "episode_returns"), "imitation of old": ("infos", "terminal")}


def test_our_own_archives_are_of_the_model(tmp_path):
    ring = MDP.from_dense(np.eye(3)[[[0, 1], [1, 2], [2, 0]]], discount=0.9)
    ARCHIVES["our own"][0](tmp_path / "steps.npz")
    with pytest.raises(FileError, match=r"steps.npz: states\[1, 0\] must lie in \[0, 3\)"):
        demonstrations_from(tmp_path / "steps.npz", mdp=ring)


@pytest.mark.parametrize("name", ARCHIVES)
@pytest.mark.parametrize("file", ["steps.npz", "steps"])
def test_archives(tmp_path, name, file):
    write, expected = ARCHIVES[name]
    write(tmp_path / "steps.npz")
    (tmp_path / "steps.npz").rename(tmp_path / file)
    demonstrations, report = demonstrations_from(tmp_path / file)
    assert report.unread == UNREAD.get(name, ())
    assert pairs(demonstrations) == (expected or [([0, 2], [1, 0]), ([3, 1], [0, 1])])


def test_text_files_and_archives_of_states_alone(tmp_path):
    ring = MDP.from_dense(np.eye(3)[[[0, 1], [1, 2], [2, 0]]], discount=0.9)
    (tmp_path / "steps.txt").write_text("run obs\n0 0\n0 1\n0 1\n")
    np.savez(tmp_path / "steps.npz", run=[0, 0, 0], obs=[0, 1, 1])
    for name in ("steps.txt", "steps.npz"):
        assert pairs(demonstrations_from(str(tmp_path / name), mdp=ring)[0]) == [([0, 1, 1], [1, 0])]


class Bomb:
    """A pickle that would tell if it was opened."""

    def __reduce__(self):
        return pathlib.Path.touch, (pathlib.Path("opened"),)


def test_nothing_is_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("steps.pkl").write_bytes(pickle.dumps([Bomb()]))
    with pytest.raises(FileError, match="steps.pkl: a pickle, which can run any code when it is read"):
        demonstrations_from("steps.pkl")
    bombs = np.array([Bomb()] * 4)
    write_old_imitation("old.npz", infos=bombs)
    assert pairs(demonstrations_from("old.npz")[0]) == EPISODES
    np.savez("steps.npz", obs=bombs, acts=FLAT["acts"], episode=[0, 0, 0, 0])
    with pytest.raises(FileError, match="steps.npz: 'obs' holds pickled Python objects; a pickle can run any code"):
        demonstrations_from("steps.npz")
    rows = {**ROWS, "infos": [[json.dumps({"py/object": "pathlib.Path", "py/reduce": []})] * 3, ["{"]]}
    assert len(demonstrations_from(DataSet(rows))[0]) == 2
    assert not pathlib.Path("opened").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"indices": np.array([2, 3])},
            "observations, actions and indices must be as many as 3 episodes need",
        ),
        ({"indices": np.array([5])}, "indices must ascend up to the number of actions, 4"),
        ({"indices": np.array([-1])}, "indices[0] must not be negative, got -1"),
        ({"indices": np.array(3)}, "observations, actions and indices must be as many as"),
        ({"obs": np.zeros(())}, "observations, actions and indices must be as many as 2 episodes need, got ()"),
    ],
)
def test_bad_archives_of_old_are_refused(tmp_path, changes, message):
    write_old_imitation(tmp_path / "old.npz", **changes)
    with pytest.raises(FileError, match=re.escape(f"old.npz: {message}")):
        demonstrations_from(tmp_path / "old.npz")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "data: a folder, but not one that imitation, datasets or Minari (in HDF5) saves a data set in"),
        ({"dataset_dict.json": "{"}, "dataset_dict.json: not a readable JSON file"),
        ({"dataset_dict.json": "[]"}, "dataset_dict.json: names no splits"),
        ({"dataset_dict.json": '{"splits": ["a", "b"]}'}, "data: several splits, 'a', 'b', and none is called 'train'"),
        ({"dataset_dict.json": '{"splits": ["gone"]}'}, "gone: no such folder"),
        ({"state.json": "{}"}, "state.json: names no data files"),
        ({"state.json": '{"_data_files": [{}]}'}, "state.json: names no data files"),
        ({"state.json": '{"_data_files": 5}'}, "state.json: names no data files"),
    ],
)
def test_bad_folders_are_named(tmp_path, files, message):
    (tmp_path / "data").mkdir()
    for name, content in files.items():
        (tmp_path / "data" / name).write_text(content)
    with pytest.raises(FileError, match=re.escape(message)):
        demonstrations_from(tmp_path / "data")


@pytest.mark.parametrize(
    ("content", "library"), [(b"PAR1", "pyarrow"), (b"ARROW1\0\0", "pyarrow"), (b"\x89HDF\r\n\x1a\n", "h5py")]
)
def test_libraries_that_are_missing_are_named(tmp_path, monkeypatch, content, library):
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / "steps").write_bytes(content)
    with pytest.raises(ImportError, match=re.escape(f"{library} is needed to read it: pip install 'jaxhom[files]'")):
        demonstrations_from(tmp_path / "steps")


def test_saved_data_sets(tmp_path):
    """Folders as `datasets` lays them out, in two files; a dictionary of them; the same columns in other files."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table, folder = pyarrow.table(ROWS), tmp_path / "train"
    folder.mkdir()
    names = ["data-00000-of-00002.arrow", "data-00001-of-00002.arrow"]
    for row, name in enumerate(names):
        with pyarrow.ipc.new_stream(folder / name, table.schema) as writer:
            writer.write_table(table.slice(row, 1))
    (folder / "state.json").write_text(json.dumps({"_data_files": [{"filename": name} for name in names]}))
    (tmp_path / "dataset_dict.json").write_text(json.dumps({"splits": ["train", "test"]}))
    parquet.write_table(table, tmp_path / "rows.parquet")
    parquet.write_table(pyarrow.table(dict(FLAT)), tmp_path / "steps.parquet")
    with pyarrow.ipc.new_file(tmp_path / "rows.arrow", table.schema) as writer:
        writer.write_table(table)
    for path in (folder, tmp_path, tmp_path / "rows.parquet", tmp_path / "rows.arrow", tmp_path / "steps.parquet"):
        demonstrations, _ = demonstrations_from(path)
        assert pairs(demonstrations) == EPISODES
        np.testing.assert_array_equal(demonstrations.terminated, [True, False])
    assert demonstrations_from(folder)[1].unread == ("infos", "rews")
    for path in (folder / names[1], tmp_path / "rows.parquet", tmp_path / "rows.arrow"):
        path.write_bytes(path.read_bytes()[:-40])
        with pytest.raises(FileError, match=f"{path.name}: not a readable"):
            demonstrations_from(folder if path.parent == folder else path)
    (folder / names[0]).unlink()
    with pytest.raises(FileError, match=f"{names[0]}: no such file"):
        demonstrations_from(folder)


def test_hdf5_files(tmp_path):
    """D4RL's columns, and Minari's groups, whose numbers are no order of texts."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "d4rl.hdf5", "w") as file:
        for name, column in D4RL.items():
            file[name] = column
        file["metadata/algorithm"] = "SAC"
    demonstrations, report = demonstrations_from(tmp_path / "d4rl.hdf5", to_states=lambda obs: obs.argmax(axis=-1))
    assert pairs(demonstrations) == STEPS and report.unread == ("metadata", "rewards")
    (tmp_path / "lake" / "data").mkdir(parents=True)
    with h5py.File(tmp_path / "lake" / "data" / "main_data.hdf5", "w") as file:
        for number, (states, actions) in zip((10, 9), EPISODES, strict=True):
            episode = {
                "observations/cell": states,
                "actions": actions,
                "infos/p": [0.1],
                "rewards": np.zeros(len(actions)),
            }
            ends = np.arange(len(actions)) == len(actions) - 1
            for name, column in {**episode, "terminations": ends, "truncations": ends & (number == 9)}.items():
                file[f"episode_{number}/{name}"] = column
    demonstrations, _ = demonstrations_from(tmp_path / "lake", to_states=lambda obs: obs["cell"])
    assert pairs(demonstrations) == EPISODES[::-1]
    np.testing.assert_array_equal(demonstrations.terminated, [False, True])
    (tmp_path / "cut.h5").write_bytes((tmp_path / "d4rl.hdf5").read_bytes()[:100])
    with pytest.raises(FileError, match="cut.h5: not a readable HDF5 file"):
        demonstrations_from(tmp_path / "cut.h5")


@pytest.mark.parametrize("kind", ["S", object])
def test_texts_in_hdf5_files(tmp_path, kind):
    """They are bytes there, of one length or of several."""
    h5py = pytest.importorskip("h5py")
    names = {"state_names": ["hall", "k\u00fcche"], "action_names": ["go"]}
    mdp = MDP.from_dense(np.eye(2)[:, None], discount=0.9, **names)
    columns = {"observations": ["k\u00fcche", "hall"], "actions": ["go", "go"]}
    with h5py.File(tmp_path / "walks.hdf5", "w") as file:
        for name, column in columns.items():
            file[name] = np.array([text.encode() for text in column], kind)
        file["timeouts"] = [False, True]
    assert pairs(demonstrations_from(tmp_path / "walks.hdf5", mdp=mdp)[0]) == [([1, 0], [0, 0])]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("steps.npz", b"", "not a readable .npz archive"),
        ("steps.npz", b"episode,state,action\n", "not a readable .npz archive"),
        ("steps.npy", b"\x93NUMPY", "not a readable .npz archive"),
        ("steps.pkl", b"(lp0\n.", "a pickle, which can run any code"),
        ("steps", b"\x80\x04\x95", "a pickle, which can run any code"),
        ("steps", b"", "column 'state' is missing"),
        ("steps.csv", b"\0\0", "not a text file in UTF-8"),
    ],
)
def test_files_of_another_kind_are_named(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=re.escape(message)) as raised:
        demonstrations_from(tmp_path / name)
    assert str(tmp_path / name) in str(raised.value) and "\n" not in str(raised.value)


def test_one_array_is_no_archive(tmp_path):
    np.save(tmp_path / "steps.npy", [0, 1])
    with pytest.raises(FileError, match=r"steps.npy: one array, not an .npz archive of named arrays"):
        demonstrations_from(tmp_path / "steps.npy")


@pytest.mark.parametrize("name", ["gone.csv", "gone.npz", "gone"])
def test_missing_files_are_named(tmp_path, name):
    with pytest.raises(FileError, match=f"{name}: no such file"):
        demonstrations_from(tmp_path / name)
