"""`learn` against the oracles: every method and option, every form of model and demonstrations, what it writes."""

import os
import signal
import sys
import time
import warnings

import interrupt_often
import numpy as np
import oracles
import pytest
from cli_cases import ACTIONS, LAKE, STATES, TRAJECTORIES, VISITED, Files, lake_transition, values

import jaxhom
from jaxhom.apprenticeship import lpal
from jaxhom.cli import learn, methods, results, sources
from jaxhom.cli.options import environment_options
from jaxhom.cli.parser import main
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.interop import load_demonstrations

INNER = np.setdiff1d(np.arange(STATES), [5, 7, 11, 12, 15])  # in the others episodes end


@pytest.fixture
def files(tmp_path):
    return Files(tmp_path)


def algorithm1(files, **options):
    return oracles.algorithm1(lake_transition(files), TRAJECTORIES, **options)


def everybody(files):
    """All demonstrated states that decide vote alike in every other."""
    policy = oracles.empirical_policy(STATES, ACTIONS, TRAJECTORIES)[1]
    visited = np.isin(np.arange(STATES), VISITED)
    voters = visited & ~oracles.absorbing(lake_transition(files))
    policy[~visited] = policy[voters].mean(axis=0)
    return policy, np.where(visited, 0, 1)


METHODS = {
    "": algorithm1,
    "--threshold 0.4 --mutual --tolerance 1e-3": lambda files: algorithm1(files, threshold=0.4, mutual=True),
    "--method nearest-neighbors": lambda files: oracles.hops_nearest_neighbors(lake_transition(files), TRAJECTORIES),
    "--method nearest-neighbors --metric euclidean": lambda files: oracles.euclidean_nearest_neighbors(
        files.arrays("model.npz")["coordinates"], ACTIONS, TRAJECTORIES
    ),
    "--voters all --relation isomorphic --threshold 1": lambda files: everybody(files),
    "--method maximum-entropy": lambda files: (
        oracles.empirical_policy(STATES, ACTIONS, TRAJECTORIES)[1],
        np.where(np.isin(np.arange(STATES), VISITED), 0, -1),
    ),
}


@pytest.mark.parametrize("options", METHODS)
def test_every_method_writes_its_policy(files, capsys, options):
    assert main(["learn", *files.options(), *options.split(), "--no-pictures"]) == 0
    policy, radius = METHODS[options](files)
    np.testing.assert_allclose(files.policy()[INNER], policy[INNER], atol=1e-12)
    arrays, report = files.arrays("out/policy.npz"), files.report()
    np.testing.assert_array_equal(np.flatnonzero(arrays["visited"]), VISITED)
    np.testing.assert_array_equal(arrays["radius"][INNER], np.ceil(radius[INNER]))
    counts = report["generalization"]["states_by_radius"]
    assert sum(counts.values()) == (radius[INNER] > 0).sum()
    assert all((arrays["radius"][INNER] == int(level)).sum() == count for level, count in counts.items())
    assert report["generalization"]["nothing_found"] == (radius[INNER] < 0).sum()
    assert report["finished"]
    nothing = next(line for line in capsys.readouterr().out.splitlines() if "without a vote" in line)
    assert nothing.split("(uniform policy)")[1].split()[0] == str((radius[INNER] < 0).sum())


REACHED = {
    "--distance 2 --printed": ("soft_local_homomorphism", {"distance": 2, "anchored": False, "mutual": False}),
    "--threshold 0.2 --tolerance 0.1": (
        "soft_local_homomorphism",
        {"threshold": 0.2, "tolerance": 0.1, "anchored": True, "mutual": False},
    ),
    "--relation lax --voters 3 --weights similarity --temperature 0.2": (
        "soft_local_homomorphism",
        {
            "relation": "lax",
            "voters": 3,
            "weights": "similarity",
            "temperature": 0.2,
            "anchored": True,
            "mutual": False,
        },
    ),
    "--method choose --distance 2": ("choose_generalization", {"distance": 2}),
    "--method soft-homomorphism": ("soft_homomorphism", {"anchored": True}),
    "--method soft-homomorphism --printed --tolerance 0.2 --max-iterations 64": (
        "soft_homomorphism",
        {"anchored": False, "tolerance": 0.2, "max_iterations": 64},
    ),
}


@pytest.mark.parametrize("options", REACHED)
def test_options_reach_their_method(files, monkeypatch, options):
    name, expected = REACHED[options]
    given = {}

    def record(mdp, *_, **settings):
        given.update(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr(methods, name, record)
    assert main(["learn", *files.options(), *options.split()]) == 130
    for name in ("progress", "states", "table"):
        given.pop(name, None)
    assert given == expected


@pytest.mark.parametrize("method", ["soft-local-homomorphism", "soft-homomorphism", "choose"])
def test_labels_reach_their_method(files, monkeypatch, method):
    given = {}

    def record(mdp, *_, **settings):
        given.update(settings)
        raise KeyboardInterrupt

    for name in ("soft_local_homomorphism", "soft_homomorphism", "choose_generalization"):
        monkeypatch.setattr(methods, name, record)
    labels = np.random.default_rng(0).random((STATES, 2))
    np.save(files.path("labels.npy"), labels)
    arguments = ["--labels", files.path("labels.npy"), "--label-weight", "0.5"]
    assert main(["learn", *files.options(), "--method", method, *arguments]) == 130
    np.testing.assert_array_equal(given["labels"], labels)
    assert given["label_weight"] == 0.5
    if "table" in given:
        np.testing.assert_allclose(given["table"].labels[:, 0], 0.5 * labels)
    assert main(["learn", *files.options(), "--method", method, "--labels", "reward"]) == 130
    np.testing.assert_array_equal(given["labels"], files.arrays("model.npz")["reward"])


def test_the_choice_reports_its_scores(files, capsys):
    assert main(["learn", *files.options(), "--method", "choose", "--no-pictures"]) == 0
    report, printed = files.report()["generalization"], capsys.readouterr().out
    assert report["chosen"] in report["candidates"] and len(report["scores"]) == len(report["candidates"])
    assert f"log-likelihood of a step left out, {report['candidates'][0]}" in printed
    assert str(files.arrays("out/policy.npz")["chosen"]) == report["chosen"]


def test_a_choice_is_explained_as_it_was_made(files, capsys):
    """Scores are of all states, whichever is asked about."""
    arguments = [name for name in files.options() if name != "--output"][:-1]
    assert main(["explain", "0", *arguments, "--method", "choose"]) == 0
    assert "State 0:" in capsys.readouterr().out


def test_the_global_map_reports_its_bounds(files, monkeypatch, capsys):
    def bounded(mdp, demonstrations, **_):
        return uniform_elsewhere(mdp, demonstrations).replace(error_lower=0.25, error_upper=0.5)

    monkeypatch.setattr(methods, "soft_homomorphism", bounded)
    assert main(["learn", *files.options(), "--method", "soft-homomorphism", "--no-pictures"]) == 0
    assert "0.25 <= e <= 0.5" in capsys.readouterr().out
    found = files.report()["generalization"]
    assert (found["error_lower"], found["error_upper"]) == (0.25, 0.5)
    assert files.arrays("out/policy.npz")["error_upper"] == 0.5


def test_regression_keeps_what_was_demonstrated(files):
    assert main(["learn", *files.options(), "--method", "regression", "--no-pictures"]) == 0
    _, empirical = oracles.empirical_policy(STATES, ACTIONS, TRAJECTORIES)
    np.testing.assert_allclose(files.policy()[VISITED], empirical[VISITED], atol=1e-12)


@pytest.mark.parametrize(
    "options",
    [
        "--method maximum-entropy --lpal --lpal-tolerance 0.1",
        "--method monte-carlo --lpal interior_point",
    ],
)
def test_lpal_is_certified(files, options):
    assert main(["learn", *files.options(), *options.split(), "--features", "states", "--no-pictures"]) == 0
    transition, initial = lake_transition(files), np.asarray(files.lake.mdp.initial)
    features = np.repeat(np.eye(STATES)[:, None], ACTIONS, axis=1)
    if "monte-carlo" in options:
        expectations = oracles.monte_carlo_feature_expectations(features, 0.99, TRAJECTORIES)
    else:
        start = files.policy("out/generalization.npz")
        np.testing.assert_array_equal(start, oracles.empirical_policy(STATES, ACTIONS, TRAJECTORIES)[1])
        expectations = oracles.feature_expectations(transition, 0.99, initial, features, start)
    best = oracles.lpal(transition, 0.99, initial, features, expectations)[0]
    found = files.report()["lpal"]
    assert found["status"] == "SOLVED"
    assert found["margin"] - 1e-9 <= best <= found["margin_bound"] + 1e-9
    tolerance = float(options.split("lpal-tolerance")[1]) if "tolerance" in options else 1e-3
    assert found["margin_bound"] - found["margin"] <= tolerance
    margin = oracles.margin(transition, 0.99, initial, features, expectations, files.policy())
    assert margin - 1e-4 * tolerance <= found["margin"] <= margin + 1e-9  # rounded down by no more than that


@pytest.mark.parametrize(
    ("options", "solver"),
    [("", "auto"), ("--lpal", "auto"), ("--lpal columns", "columns"), ("--lpal flow", "flow")],
)
def test_the_solver_and_its_tolerance_reach_lpal(files, monkeypatch, options, solver):
    given = {}

    def record(mdp, expectations, **settings):
        given.update(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr(learn, "lpal", record)
    arguments = [*files.options(), "--method", "monte-carlo", "--features", "states", "--lpal-tolerance", "0.1"]
    assert main(["learn", *arguments, *options.split()]) == 130
    assert (given["method"], given["tolerance"], given["initial_policy"]) == (solver, 0.1, None)


def test_every_solver_of_lpal_can_be_chosen():
    assert set(learn._LPAL_METHODS) == set(lpal.METHODS)


def test_values_against_the_optimum(files, capsys):
    assert main(["learn", *files.options(), "--method", "nearest-neighbors"]) == 0
    (learned,), best = values(files, [files.policy()])
    optimal, own = files.report()["values"]
    np.testing.assert_allclose([optimal["value"], own["value"]], [best, learned], rtol=1e-9)
    assert best - learned <= own["loss <="] <= best - learned + 1e-6
    mdp = files.lake.mdp
    arguments = lake_transition(files), np.asarray(mdp.initial), files.policy(), np.asarray(files.lake.reward), 100
    trial = oracles.finite_horizon_evaluation(*arguments, terminal=np.asarray(files.lake.terminal))
    np.testing.assert_allclose(own["steps"], trial["steps"], rtol=1e-9)
    np.testing.assert_allclose(own["reward"], trial["reward_per_step"] * trial["steps"], rtol=1e-9)
    assert f"{best:.5g}" in capsys.readouterr().out
    pictures = ["generalization", "occupancy", "policy", "trajectories"]
    assert sorted(path.stem for path in files["out"].glob("*.png")) == pictures


MODELS = {
    "environment": ["--env", LAKE, "--method", "nearest-neighbors"],
    "environment, options": ["--env", LAKE, "is_slippery=True", "map_name=4x4", "--method", "maximum-entropy"],
    "environment, discount": ["--env", LAKE, "--discount", "0.9", "--method", "maximum-entropy"],
    "environment, features": ["--env", LAKE, "--method", "maximum-entropy", "--lpal", "--features", "states"],
    "racetrack": ["--mdp", "a.track", "--method", "nearest-neighbors", "--metric", "euclidean"],
    "arrays, no map": ["--mdp", "model.npz", "--method", "maximum-entropy", "--steps", "3"],
}


@pytest.mark.parametrize("name", MODELS)
def test_every_model_has_an_expert_to_sample(files, monkeypatch, name):
    monkeypatch.chdir(files.folder)
    assert main(["learn", *MODELS[name], "--expert", "2", "--seed", "5", "--output", "out"]) == 0
    report, demonstrations = files.report(), load_demonstrations(files["out/demonstrations.npz"])
    assert demonstrations.num_trajectories == report["demonstrations"]["trajectories"] == 2
    assert np.asarray(demonstrations.mask).sum() == report["demonstrations"]["steps"]
    assert demonstrations.horizon <= int(MODELS[name][-1] if "--steps" in MODELS[name] else 100)
    model = report["model"]
    assert model["terminal_states"] == (25 if name == "racetrack" else 5)
    assert model["discount"] == (0.9 if name == "environment, discount" else 0.99)
    assert model["states"] == (100 if name == "racetrack" else 16)
    assert len(list(files["out"].glob("*.png"))) == 4
    optimal, *own = report["values"]
    assert all(row["value"] <= optimal["value"] + 1e-6 for row in own)


def test_options_of_environments_reach_them(files, monkeypatch):
    given = {}

    def record(env, **settings):
        given.update(settings, probabilities=[outcome[0] for outcome in env.unwrapped.P[0][1]])
        raise KeyboardInterrupt

    monkeypatch.setattr(sources, "from_gymnasium", record)
    arguments = ["--env", LAKE, "is_slippery=false", "--end-state", "--expert", "1", "--output", files.path("out")]
    assert main(["learn", *arguments]) == 130
    assert given == {"discount": 0.99, "end_state": True, "probabilities": [1.0]}


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("a=false", False),
        ("a=True", True),
        ("a=no", False),
        ("a=Yes", True),
        ("a=off", False),
        ("a=ON", True),
        ("a=None", None),
        ("a=8x8", "8x8"),
        ("a=0.5", 0.5),
        ("a=1", 1),
        ('a=["SG"]', ["SG"]),
        ("a=(1, 0.5)", (1, 0.5)),
        ("a=('SG', 'FF')", ("SG", "FF")),
    ],
)
def test_values_of_options_are_json_or_text(word, value):
    assert environment_options([word]) == {"a": value}


def test_csv_and_npz_are_the_same_demonstrations(files):
    arguments = ["--mdp", files.path("model.npz"), "--method", "maximum-entropy", "--no-pictures"]
    for kind in ("csv", "npz"):
        arguments_of_kind = ["--demonstrations", files.path(f"demos.{kind}"), "--output", files.path(kind)]
        assert main(["learn", *arguments, *arguments_of_kind]) == 0
    one, other = (files.arrays(f"{kind}/demonstrations.npz") for kind in ("csv", "npz"))
    for name in ("states", "actions", "length"):
        np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.parametrize(("choice", "lines"), [("warn", 1), ("ignore", 0)])
def test_impossible_demonstrations_are_let_pass_where_that_was_asked_for(files, capsys, choice, lines):
    files["demos.csv"].write_text("episode,state,action\na,1,1\na,8,1\na,12,\n")
    arguments = ["--mdp", files.path("model.npz"), "--demonstrations", files.path("demos.csv"), "--impossible", choice]
    method = ["--method", "maximum-entropy", "--no-pictures"]
    with warnings.catch_warnings(record=True) as others:
        warnings.simplefilter("always")
        assert main(["learn", *arguments, *method, "--output", files.path("out")]) == 0
        assert main(["explain", "0", *arguments, *method[:2]]) == 0
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 2 * lines and not others
    assert all("demos.csv: 1 of 2 steps have probability 0" in line for line in error)
    assert files.report()["options"]["impossible"] == choice
    assert main(["plot", "trajectories", files.path("demos.csv"), *arguments[:2], "--output", files.path("t.png")]) == 0


def test_a_discount_for_a_file_without_one(files):
    files.write_model(discount=None, reward=None, terminal=None)
    arguments = [*files.options("policy.npz"), "--method", "maximum-entropy", "--discount", "0.8"]
    assert main(["learn", *arguments]) == 0
    assert files.policy("policy.npz").shape == (STATES, ACTIONS)
    assert not files["out"].exists()  # a policy's file alone


@pytest.mark.parametrize("progress", [False, True])
def test_progress_is_for_terminals_and_those_who_ask(files, capsys, progress):
    arguments = [*files.options(), "--method", "maximum-entropy", "--lpal", "--features", "states", "--no-pictures"]
    assert main(["learn", *arguments, *["--progress"] * progress]) == 0
    assert ("LPAL" in capsys.readouterr().err) == progress


def test_no_pictures_without_matplotlib(files, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delattr(jaxhom, "plotting", raising=False)
    for name in [name for name in sys.modules if name.startswith("jaxhom.plotting")]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["learn", *files.options(), "--method", "maximum-entropy"]) == 0
    assert "pip install '.[plot]'" in capsys.readouterr().out
    assert not list(files["out"].glob("*.png")) and files.report()["finished"]


def test_numbers_that_json_has_no_word_for(files):
    results.write_json(files.path("x.json"), {"a": [float("nan"), 1.0], "b": (float("inf"),)})
    assert files.report("x.json") == {"a": [None, 1.0], "b": [None]}


def interrupt(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("output", ["out", "policy.npz"])
def test_an_interruption_keeps_what_is_finished(files, monkeypatch, capsys, output):
    monkeypatch.setattr(learn, "lpal", interrupt)
    arguments = [*files.options(output), "--method", "maximum-entropy", "--lpal", "--features", "states"]
    assert main(["learn", *arguments]) == 130
    written = "out/generalization.npz" if output == "out" else output
    error = capsys.readouterr().err
    assert error.startswith("jaxhom: interrupted; written so far: ") and files.path(written) in error
    np.testing.assert_array_equal(files.policy(written), oracles.empirical_policy(STATES, ACTIONS, TRAJECTORIES)[1])
    if output == "out":
        report = files.report()
        assert not report["finished"] and "generalization" in report and "lpal" not in report


def test_a_signal_interrupts(files):
    """The real thing, in a process of its own: LPAL is asked for more than there is and would take its 500 columns."""
    hard = ["--method", "maximum-entropy", "--features", "states", "--lpal", "--lpal-tolerance", "1e-300"]
    with interrupt_often.start(["learn", *files.options(), *hard]) as process:
        deadline = time.monotonic() + 120
        while not files["out/generalization.npz"].exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGINT)
        _, error = process.communicate(timeout=120)
    assert process.returncode == 130
    assert error.splitlines()[-1].startswith("jaxhom: interrupted; written so far: ")
    assert not files["out/policy.npz"].exists()
    assert files.policy("out/generalization.npz").shape == (STATES, ACTIONS)
    assert not list(files["out"].glob("*.partial"))


def test_a_table_goes_on_where_it_was_interrupted(files, monkeypatch, capsys):
    """The second run knows what the first one solved; a third, with another option, is refused."""
    arguments = ["learn", *files.options(), "--threshold", "0.3", "--no-pictures", "--table", files.path("table.npz")]
    plain = jaxhom.SimilarityTable.decisions

    def interrupted(*arguments, **options):
        plain(*arguments, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(jaxhom.SimilarityTable, "decisions", interrupted)
        assert main(arguments) == 130
    begun = len(files.arrays("table.npz")["pairs"])
    assert begun
    for _ in range(2):
        assert main(arguments) == 0
    assert begun < len(files.arrays("table.npz")["pairs"])
    assert files.arrays("out/policy.npz")["pairs_of_classes_solved"] == 0
    capsys.readouterr()
    assert main([*arguments, "--distance", "2"]) == 2
    assert "table was made with distance=1" in capsys.readouterr().err
    assert main([*arguments[:-1], files.path("missing/table.npz")]) == 2
