"""The command line, as a user calls it: tables, files, and one clear line for bad input."""

import subprocess
import sys

import numpy as np
import pytest

from jaxhom import interop
from jaxhom.cli import main
from jaxhom.domains import gridworld


@pytest.fixture
def arrays(tmp_path):
    """A 4x4 grid and two demonstrations, in files as a user would write them."""
    mdp = gridworld(4, num_regions=4).mdp
    model = {"transition": np.asarray(mdp.transition), "discount": 0.9, "features": np.asarray(mdp.features)}
    demos = {"states": [[0, 4, 8], [0, 1, 0]], "actions": [[1, 1, 3], [3, 2, 0]], "length": [3, 2]}
    paths = {name: str(tmp_path / f"{name}.npz") for name in ("model", "demos", "policy")}

    def write(**changes):
        for name, content in (("model", model), ("demos", demos)):
            content = {**content, **changes.get(name, {})}
            np.savez(paths[name], **{key: value for key, value in content.items() if value is not None})
        return ["learn", "--mdp", paths["model"], "--demonstrations", paths["demos"], "--output", paths["policy"]]

    return write, paths


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--lpal"],
        ["--mutual", "--threshold", "0.2", "--distance", "2"],
        ["--printed"],
        ["--method", "nearest-neighbors"],
        ["--method", "maximum-entropy", "--lpal"],
        ["--method", "monte-carlo"],
    ],
    ids=" ".join,
)
def test_learn_writes_a_policy(arrays, capsys, options):
    write, paths = arrays
    assert main([*write(), *options]) == 0
    policy = interop.load_policy(paths["policy"])
    assert policy.shape == (16, 4)
    written = capsys.readouterr().out
    assert "states demonstrated" in written
    assert ("LPAL margin" in written) == ("--lpal" in options or "monte-carlo" in options)
    with np.load(paths["policy"]) as archive:
        np.testing.assert_array_equal(np.flatnonzero(archive["visited"]), [0, 1, 4, 8])
        if "monte-carlo" not in options:
            np.testing.assert_allclose(archive["policy"][8] if "--lpal" not in options else [0, 0, 0, 1], [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": {"discount": 1.0}}, "model.npz: discount must lie strictly between 0 and 1"),
        ({"model": {"discount": None}}, "model.npz: array 'discount' is missing"),
        ({"model": {"transition": None}}, "model.npz: neither transition nor next_state and probability"),
        ({"model": {"transition": np.full((3, 2, 3), 0.5)}}, "model.npz: sum of transition[0, 0] must be 1, got 1.5"),
        ({"model": {"transition": np.zeros((3, 2))}}, "model.npz: transition must have shape [S, A, S]"),
        ({"model": {"initial": np.ones(3)}}, "model.npz: initial must have shape (16,)"),
        ({"demos": {"states": None}}, "demos.npz: array 'states' is missing"),
        ({"demos": {"states": [[0, 4, 99], [0, 1, 0]]}}, "demos.npz: states[0, 2] must lie in [0, 16)"),
        ({"demos": {"actions": [[0, 1], [0, 1]]}}, "demos.npz: actions must have shape (2, 3)"),
        ({"demos": {"length": [3, 0]}}, "demos.npz: trajectory 1 is empty"),
        ({"demos": {"length": [3, 4]}}, "demos.npz: length[1] must be below 4"),
        ({"demos": {"format_version": 7}}, "demos.npz: written in format 7"),
    ],
)
def test_wrong_arrays_are_one_line(arrays, capsys, changes, message):
    write, _ = arrays
    assert main(write(**changes)) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxhom: error: ") and error.count("\n") == 1
    assert message in error


@pytest.mark.parametrize("content", [None, b"", b"not an archive", b"PK\x03\x04truncated"])
def test_foreign_files_are_one_line(arrays, capsys, content):
    write, paths = arrays
    command = write()
    if content is None:
        command[2] = paths["model"] + ".missing"
    else:
        with open(paths["model"], "wb") as file:
            file.write(content)
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "model.npz" in error


def test_truncated_archive(arrays, capsys):
    write, paths = arrays
    command = write()
    with open(paths["model"], "rb") as file:
        whole = file.read()
    for part in (len(whole) // 3, len(whole) - 10):
        with open(paths["model"], "wb") as file:
            file.write(whole[:part])
        assert main(command) == 2
        assert "not a readable .npz archive" in capsys.readouterr().err


def test_lpal_needs_features(arrays, capsys):
    write, _ = arrays
    assert main([*write(model={"features": None}), "--lpal"]) == 2
    assert "LPAL needs features" in capsys.readouterr().err


def test_pickles_are_refused(arrays, capsys):
    write, _ = arrays
    assert main(write(demos={"states": np.array([[0, None], [1, "x"]], object)})) == 2
    assert "demos.npz" in capsys.readouterr().err


def test_main_job_prints_its_table(tmp_path, capsys):
    picture = tmp_path / "policies.png"
    arguments = ["--grid", "8", "--regions", "16", "--demonstrations", "2", "--sets", "2"]
    assert main([*arguments, "--picture", str(picture)]) == 0
    written = capsys.readouterr().out
    for name in ("expert", "soft local homomorphism + LPAL", "k-NN (hops)", "maximum entropy"):
        assert written.count(f"  {name}  ") >= 1
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize("arguments", [["--help"], ["learn", "--help"]])
def test_help_explains(capsys, arguments):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 0
    written = capsys.readouterr().out
    assert "--demonstrations" in written
    assert "learn" not in arguments or "next_state" in written


def test_unknown_options_exit_with_2(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--sets", "0"])
    assert stopped.value.code == 2
    assert "at least 1" in capsys.readouterr().err


def test_module_runs():
    done = subprocess.run([sys.executable, "-m", "jaxhom", "learn", "--mdp", "x"], capture_output=True, text=True)
    assert done.returncode == 2 and "required" in done.stderr
