"""Files: what is saved comes back bit by bit; what is damaged, foreign or newer is one clear line."""

import fractions
import re
import zipfile

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_models

import jaxhom
from jaxhom.interop import (
    FileError,
    load_arrays,
    load_demonstrations,
    load_mdp,
    load_policy,
    save_demonstrations,
    save_mdp,
    save_policy,
)
from jaxhom.models.demonstrations import Demonstrations

RAGGED = Demonstrations.from_trajectories([([0, 1, 2], [0, 2, 1]), ([4], [1]), ([1, 1, 6, 0], [2, 2, 0, 1])])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["one_state", "dense", "sparse", "restart"])
def test_models_come_back_bit_by_bit(tmp_path, name, dtype):
    case = small_models.case(name)
    mdp = case.mdp if dtype == np.float64 else small_models.in_float32(case).mdp
    save_mdp(tmp_path / "model.npz", mdp)
    loaded = load_mdp(tmp_path / "model.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(mdp)
    chex.assert_trees_all_equal_shapes_and_dtypes(loaded, mdp)
    chex.assert_trees_all_equal(loaded, mdp)


def test_demonstrations_and_policies_come_back(tmp_path):
    save_demonstrations(tmp_path / "demos.npz", RAGGED)
    chex.assert_trees_all_equal(load_demonstrations(str(tmp_path / "demos.npz")), RAGGED)
    policy = np.array([[0.25, 0.75], [1.0, 0.0]])
    save_policy(tmp_path / "policy", jnp.asarray(policy), radius=[1, 2], margin=0.5)
    np.testing.assert_array_equal(load_policy(tmp_path / "policy"), policy)
    with np.load(tmp_path / "policy", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["radius"], [1, 2])
        assert archive["margin"] == 0.5


def test_what_else_a_file_holds(tmp_path):
    save_policy(tmp_path / "policy.npz", [[0.5, 0.5]], radius=[3], margin=0.25)
    found = load_arrays(tmp_path / "policy.npz", "radius", "margin", "nothing")
    assert set(found) == {"radius", "margin"} and found["margin"] == 0.25
    np.testing.assert_array_equal(found["radius"], [3])


def test_a_discount_for_a_model_without_one(tmp_path):
    path = tmp_path / "model.npz"
    np.savez(path, transition=np.ones((1, 1, 1)))
    assert load_mdp(path, discount=0.5).discount == 0.5
    with pytest.raises(FileError, match="discount must lie strictly between 0 and 1"):
        load_mdp(path, discount=1.0)
    np.savez(path, transition=np.ones((1, 1, 1)), discount=0.9)
    with pytest.raises(FileError, match=r"it has a discount of its own, 0\.9"):
        load_mdp(path, discount=0.5)


def test_every_file_says_its_format_and_nothing_else_is_left_behind(tmp_path):
    save_mdp(tmp_path / "a", small_models.case("sparse").mdp)
    save_demonstrations(tmp_path / "b", RAGGED)
    save_policy(tmp_path / "c", np.ones((3, 1)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]
    for name in "abc":
        with np.load(tmp_path / name, allow_pickle=False) as archive:
            assert archive["format_version"] == 1
            assert not any(archive[member].dtype.hasobject for member in archive.files)


def test_one_trajectory_needs_no_second_axis_and_no_length(tmp_path):
    np.savez(tmp_path / "demos.npz", states=[3, 1], actions=[0.0, 1.0])
    chex.assert_trees_all_equal(
        load_demonstrations(tmp_path / "demos.npz"), Demonstrations.from_trajectories([([3, 1], [0, 1])])
    )


HALF = np.full((2, 1, 2), 0.5)
MODEL = {"transition": HALF, "discount": 0.9}
STEPS = {"states": [[0, 1]], "actions": [[0, 0]]}


def without(arrays, name):
    return {key: value for key, value in arrays.items() if key != name}


@pytest.mark.parametrize(
    ("load", "arrays", "message"),
    [
        (load_mdp, without(MODEL, "discount"), "array 'discount' is missing (it holds transition)"),
        (load_mdp, {"discount": 0.9}, "neither transition nor next_state and probability are in it"),
        (load_mdp, {"discount": 0.9, "next_state": [[[0]]]}, "array 'probability' is missing"),
        (load_mdp, {**MODEL, "transition": HALF * 1.1}, "sum of transition[0, 0] must be 1, got 1.1"),
        (load_mdp, {**MODEL, "transition": HALF * np.nan}, "transition[0, 0, 0] must be finite"),
        (load_mdp, {**MODEL, "transition": HALF.astype("S")}, "transition must hold real numbers, got dtype |S"),
        (load_mdp, {**MODEL, "discount": [0.9, 0.8]}, "discount must have shape (), got (2,)"),
        (load_mdp, {**MODEL, "discount": 1.0}, "discount must lie strictly between 0 and 1, got 1.0"),
        (load_mdp, {**MODEL, "initial": [1.0]}, "initial must have shape (2,), got (1,)"),
        (load_mdp, {**MODEL, "features": np.ones(2)}, "features must have shape (2, 1, K) or (2, K), got (2,)"),
        (
            load_mdp,
            {"discount": 0.9, "next_state": [[[2]], [[0]]], "probability": [[[1.0]], [[1.0]]]},
            "next_state[0, 0, 0] must be below 2, got 2",
        ),
        (load_demonstrations, without(STEPS, "states"), "array 'states' is missing (it holds actions)"),
        (load_demonstrations, MODEL, "array 'states' is missing (it holds discount, transition)"),
        (load_demonstrations, {**STEPS, "actions": [[0]]}, "actions must have shape (1, 2), got (1, 1)"),
        (load_demonstrations, {**STEPS, "states": [[0, -1]]}, "trajectory 0 states[1] must not be negative, got -1"),
        (load_demonstrations, {**STEPS, "states": [[0, 0.5]]}, "trajectory 0 states[1] must be whole, got 0.5"),
        (load_demonstrations, {**STEPS, "length": [3]}, "length[0] must be below 3, got 3"),
        (load_demonstrations, {**STEPS, "length": [0]}, "trajectory 0 is empty"),
        (load_demonstrations, {**STEPS, "length": 2}, "length must have shape (1,), got ()"),
        (
            load_demonstrations,
            {"states": np.zeros((0, 3)), "actions": np.zeros((0, 3))},
            "at least one trajectory is needed, got none",
        ),
        (load_policy, {"Policy": [[1.0]]}, "array 'policy' is missing (it holds Policy)"),
        (load_policy, {}, "array 'policy' is missing (it holds nothing)"),
        (load_policy, {"policy": [1.0]}, "policy must have shape [S, A] with S, A >= 1, got (1,)"),
        (load_policy, {"policy": np.ones((0, 2))}, "policy must have shape [S, A] with S, A >= 1, got (0, 2)"),
        (load_policy, {"policy": [[0.5, 0.6]]}, "sum of policy[0] must be 1, got 1.1"),
        (load_policy, {"policy": [[1.0]], "format_version": 2}, "written in format 2, this release reads up to 1"),
        (
            load_policy,
            {"policy": [[1.0]], "format_version": 0},
            "format_version must be a whole number from 1 on, got 0",
        ),
        (load_policy, {"policy": [[1.0]], "format_version": "new"}, "format_version must be a whole number from 1 on"),
        (load_policy, {"policy": [[1.0]], "format_version": [[1], [1]]}, "from 1 on, got [[1], [1]]"),
        (load_policy, {"policy": np.array([[None]])}, "'policy' holds pickled Python objects"),
    ],
)
def test_what_a_file_holds_is_checked_like_fresh_input(tmp_path, load, arrays, message):
    path = tmp_path / "some.npz"
    np.savez(path, **arrays)
    with pytest.raises(FileError, match=re.escape(message)) as raised:
        load(path)
    assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)


def foreign(kind, path):
    if kind == "missing":
        return "no such file"
    if kind == "folder":
        path.mkdir()
        return "not a readable .npz archive"
    if kind == "npy":
        with open(path, "wb") as file:
            np.save(file, np.ones(3))
        return "one array, not an .npz archive"
    if kind == "other zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("policy", "1 2 3")
        return "'policy' is not a NumPy array"
    if kind == "huge claim":
        with zipfile.ZipFile(path, "w") as archive:
            header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000, 1), }"
            header = header.ljust(118) + b"\n"
            archive.writestr("policy.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
        return "not a readable .npz archive"
    path.write_bytes({"empty": b"", "text": b"a,b\n1,2\n", "pickle": b"\x80\x04N."}[kind])
    return "not a readable .npz archive"


@pytest.mark.parametrize("load", [load_mdp, load_demonstrations, load_policy])
@pytest.mark.parametrize("kind", ["missing", "folder", "npy", "other zip", "huge claim", "empty", "text", "pickle"])
def test_foreign_files_are_one_line(tmp_path, kind, load):
    path = tmp_path / "file.npz"
    message = foreign(kind, path)
    with pytest.raises(FileError, match=re.escape(f"{path}: {message}")) as raised:
        load(path)
    assert "\n" not in str(raised.value)


def test_truncated_and_corrupted_files_are_one_line_or_undamaged(tmp_path):
    """Every cut is noticed; so is every flipped byte that matters, as archives carry checksums."""
    mdp = small_models.case("restart").mdp
    whole = tmp_path / "whole.npz"
    save_mdp(whole, mdp)
    content = whole.read_bytes()
    path = tmp_path / "broken.npz"
    for cut in np.linspace(0, len(content) - 1, 25, dtype=int):
        path.write_bytes(content[:cut])
        with pytest.raises(FileError, match="broken.npz: not a readable") as raised:
            load_mdp(path)
        assert "\n" not in str(raised.value)
    undamaged = 0
    for place in np.linspace(0, len(content) - 1, 60, dtype=int):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            loaded = load_mdp(path)
        except FileError as error:
            assert "\n" not in str(error)
        else:
            undamaged += 1
            np.testing.assert_array_equal(loaded.probability, mdp.probability)
    assert undamaged < 30


@pytest.mark.parametrize(
    ("policy", "extras", "message"),
    [
        ([0.5, 0.5], {}, "policy must have shape [S, A]"),
        ([[0.5, 0.4]], {}, "sum of policy[0] must be 1, got 0.9"),
        ([[1.0]], {"note": None}, "note must be a plain array, got dtype object"),
        ([[1.0]], {"format_version": 3}, "an array of a policy's file cannot be called 'format_version'"),
        ([[1.0]], {"rows": [[1], [1, 2]]}, "rows is not a rectangular array"),
    ],
)
def test_policies_that_could_not_be_loaded_are_not_saved(tmp_path, policy, extras, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        save_policy(tmp_path / "policy.npz", policy, **extras)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mask", [[True, False, True], [False, True, True], [True, True, False], [False, True, False]])
def test_hidden_steps_stay_hidden_in_files(tmp_path, mask):
    states, actions = np.array([[3, 1, 2], [0, 1, 0]]), np.array([[1, 0, 1], [0, 1, 1]])
    mask = np.array([mask, [True, True, True]])
    given = Demonstrations(states=states, actions=actions * mask, mask=mask, final_states=np.array([-1, 2]))
    save_demonstrations(tmp_path / "demos.npz", given)
    loaded = load_demonstrations(tmp_path / "demos.npz")
    np.testing.assert_array_equal(loaded.mask, mask)
    for name in ("states", "actions"):
        np.testing.assert_array_equal(np.asarray(getattr(loaded, name))[mask], np.asarray(getattr(given, name))[mask])
    np.testing.assert_array_equal(loaded.final_states, [-1, 2])
    with np.load(tmp_path / "demos.npz") as file:  # readers that do not know of hidden steps refuse such an action
        assert (file["actions"] == -1).sum() == (~mask[:, : mask[0].nonzero()[0].max() + 1]).sum()


def test_where_the_last_steps_are_hidden_the_state_after_those_shown_is_the_final_one(tmp_path):
    path = tmp_path / "demos.npz"
    np.savez(path, states=[[3, 1, 2], [0, 1, 0]], actions=[[1, -1, -1], [1, 0, 1]], final_states=[4, 2])
    loaded = load_demonstrations(path)
    assert loaded.mask.tolist() == [[True, False, False], [True, True, True]]
    assert loaded.final_states.tolist() == [1, 2]
    save_demonstrations(path, loaded)
    assert load_demonstrations(path).final_states.tolist() == [1, 2]


def test_an_episode_whose_last_step_is_hidden_cannot_have_terminated(tmp_path):
    path = tmp_path / "demos.npz"
    walks = {"states": [[0, 1, 0], [3, 1, 2]], "actions": [[1, 0, 1], [1, 0, -1]], "final_states": [2, 4]}
    np.savez(path, **walks, terminated=[True, False])
    assert load_demonstrations(path).terminated.tolist() == [True, False]
    np.savez(path, **walks, terminated=[True, True])
    with pytest.raises(FileError, match=r"terminated\[1\] must be False where the last step is hidden"):
        load_demonstrations(path)


def test_trajectories_without_a_step_are_not_saved(tmp_path):
    broken = Demonstrations(states=jnp.zeros((1, 3), int), actions=jnp.zeros((1, 3), int), mask=jnp.zeros((1, 3), bool))
    with pytest.raises(ValueError, match=r"mask\[0\] must be True on one step of each trajectory at least"):
        save_demonstrations(tmp_path / "demos.npz", broken)


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "policy.npz"
    save_policy(path, [[1.0, 0.0]])

    def fail(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        save_policy(path, [[0.0, 1.0]])
    assert [entry.name for entry in tmp_path.iterdir()] == ["policy.npz"]
    np.testing.assert_array_equal(load_policy(path), [[1.0, 0.0]])


@pytest.mark.parametrize(
    ("names", "back"),
    [
        (["door", "room"], ("door", "room")),
        (["a", "a\0"], ("a", "a\0")),
        ([3, -1], (3, -1)),
        ([(0, 1), (2, 3)], ((0, 1), (2, 3))),
        ([(0, 1), (2, 3, 4)], ((0, 1), (2, 3, 4))),
        ([("kitchen", True), None], (("kitchen", True), None)),
        ([2.5, "2.5"], (2.5, "2.5")),
        ([(), (0,)], ((), (0,))),
        ([frozenset("a"), object], ("frozenset({'a'})", "<class 'object'>")),
        ([frozenset("a"), 0.25], ("frozenset({'a'})", 0.25)),
        ([1, float("nan")], (1, "nan")),
    ],
)
def test_names_come_back(tmp_path, names, back):
    path = tmp_path / "model.npz"
    save_mdp(path, jaxhom.MDP.from_dense(np.full((2, 1, 2), 0.5), discount=0.9, state_names=names, action_names=["a"]))
    loaded = load_mdp(path)
    assert loaded.state_names == back and loaded.action_names == ("a",)
    assert [type(name) for name in loaded.state_names] == [type(name) for name in back]


def test_names_that_a_file_would_not_tell_apart_are_refused(tmp_path):
    names = ["1/2", fractions.Fraction(1, 2)]
    model = jaxhom.MDP.from_dense(np.full((2, 1, 2), 0.5), discount=0.9, state_names=names)
    with pytest.raises(ValueError, match=r"tell the names '1/2' and Fraction\(1, 2\) apart: both would be '1/2'"):
        save_mdp(tmp_path / "model.npz", model)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            np.zeros(2),
            r"model.npz: state_names must be texts .* or whole numbers .*, got dtype float64",
        ),
        (np.zeros((2, 1, 1), int), r"model.npz: state_names must have shape \[N\] or \[N, D\]"),
        (np.array(["a", "a"]), r"model.npz: state_names\[1\] must be new"),
        (np.array(["a"]), "model.npz: state_names must be 2 names, got 1"),
    ],
)
def test_bad_names_are_refused(tmp_path, names, message):
    np.savez(tmp_path / "model.npz", transition=np.full((2, 1, 2), 0.5), discount=0.9, state_names=names)
    with pytest.raises(FileError, match=message):
        load_mdp(tmp_path / "model.npz")
