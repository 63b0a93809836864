"""`evaluate`, `explain` and `plot` on saved files, against the oracles and the library's own answers."""

import numpy as np
import oracles
import pytest
from cli_cases import ACTIONS, LAKE, STATES, TRAJECTORIES, Files, lake_transition, values
from small_models import dense_transition

import jaxhom
from jaxhom import interop
from jaxhom.cli import methods
from jaxhom.cli.parser import main

DOWN = np.eye(ACTIONS)[np.ones(STATES, int)]
UNIFORM = np.full((STATES, ACTIONS), 1.0 / ACTIONS)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = Files(tmp_path)
    interop.save_policy("down.npz", DOWN)
    interop.save_policy("uniform.npz", UNIFORM)
    return files


@pytest.fixture(scope="module")
def track():
    return jaxhom.racetrack(["S..F"])


def test_evaluate_against_the_oracles(files, capsys):
    arguments = ["--against", "uniform.npz", "--steps", "7", "--trials", "400", "--seed", "3", "--output", "out.json"]
    assert main(["evaluate", "down.npz", "--mdp", "model.npz", *arguments]) == 0
    report = files.report("out.json")
    assert [row["policy"] for row in report["exact"]] == ["optimal", "uniform.npz", "down.npz"]
    known, best = values(files, [UNIFORM, DOWN])
    np.testing.assert_allclose([row["value"] for row in report["exact"]], [best, *known], rtol=1e-9)
    mdp, reward, terminal = files.lake.mdp, np.asarray(files.lake.reward), np.asarray(files.lake.terminal)
    for policy, exact, sampled in zip((UNIFORM, DOWN), report["exact"][1:], report["sampled"][1:], strict=True):
        model = lake_transition(files), np.asarray(mdp.initial), policy, reward, 7
        trial = oracles.finite_horizon_evaluation(*model, terminal=terminal)
        np.testing.assert_allclose(exact["steps"], trial["steps"], rtol=1e-9)
        np.testing.assert_allclose(exact["reward"], trial["steps"] * trial["reward_per_step"], atol=1e-12)
        assert abs(sampled["steps"] - exact["steps"]) <= 5 * sampled["steps standard error"]
        assert 0 < sampled["finished standard error"] < 0.1
    printed = capsys.readouterr().out
    assert f"{known[1]:.5g}" in printed and "±" in printed and "400 trials (seed 3)" in printed


def test_agreement_is_over_states_that_matter(files):
    arguments = ["--against", "uniform.npz", "--trials", "0", "--output", "out.json"]
    assert main(["evaluate", "down.npz", "--mdp", "model.npz", *arguments]) == 0
    optimal, uniform = files.report("out.json")["agreement"]
    assert (optimal["reference"], uniform["reference"]) == ("optimal", "uniform.npz")
    assert uniform["all states"] == uniform["where that goes"] == pytest.approx(1 / ACTIONS)
    transition, terminal = lake_transition(files), np.asarray(files.lake.terminal)
    _, action_value = oracles.optimal_value(transition, 0.99, np.asarray(files.lake.reward))
    actions = np.argmax(action_value >= action_value.max(axis=1, keepdims=True) - 1e-9, axis=1)
    same, weights = (
        actions == 1,
        oracles.occupancy(transition, 0.99, np.asarray(files.lake.mdp.initial), np.eye(4)[actions]),
    )
    weights = weights.sum(axis=1) * ~terminal
    assert optimal["all states"] == pytest.approx(same[~terminal].mean())
    assert optimal["where that goes"] == pytest.approx((same * weights).sum() / weights.sum(), abs=1e-6)


def test_without_a_reward_there_is_no_optimum(files, capsys):
    files.write_model(reward=None, terminal=None)
    assert main(["evaluate", "down.npz", "--mdp", "model.npz", "--against", "uniform.npz", "--trials", "0"]) == 0
    printed = capsys.readouterr().out
    assert "optimal" not in printed and "value" not in printed and "sampled" not in printed
    assert f"{1 / ACTIONS:.3f}" in printed


def test_tracks_count_off_roads_and_features(files, track, capsys):
    interop.save_policy("drive.npz", np.full((100, 5), 0.2))
    assert main(["evaluate", "drive.npz", "--mdp", "a.track", "--trials", "0", "--output", "out.json"]) == 0
    report = files.report("out.json")
    mdp, policy = track.mdp, np.full((100, 5), 0.2)
    reward = np.asarray(mdp.features) @ np.asarray(track.weights)
    model = dense_transition(mdp), np.asarray(mdp.initial), policy, reward, 30
    events = {"off_road": np.asarray(track.off_road)}
    trial = oracles.finite_horizon_evaluation(*model, terminal=np.asarray(track.terminal), events=events)
    np.testing.assert_allclose(report["exact"][1]["off-roads/step"], trial["off_road"], rtol=1e-9)
    expected = oracles.feature_expectations(model[0], 0.99, model[1], np.asarray(mdp.features), policy)
    np.testing.assert_allclose(report["feature_expectations"]["drive.npz"], expected, rtol=1e-9)
    assert f"{expected[1]:.5g}" in capsys.readouterr().out


def test_explain_says_what_the_library_says(files, capsys):
    arguments = ["--env", LAKE, "--demonstrations", "demos.csv", "--method", "nearest-neighbors"]
    assert main(["explain", "1", "1,1", "0,2", "4", *arguments]) == 0
    parts = capsys.readouterr().out.split("\n\nState ")
    general = jaxhom.nearest_neighbors(files.lake.mdp, jaxhom.Demonstrations.from_trajectories(TRAJECTORIES))
    expected = ["State 5: episodes end here, and no action matters."] * 4
    for place, state in ((0, 1), (2, 2), (3, 4)):
        expected[place] = str(general.explain(state))
    assert [part.removeprefix("State ").strip() for part in parts] == [text.removeprefix("State ") for text in expected]


def test_explain_generalizes_to_the_states_it_is_asked_about(files, monkeypatch):
    asked = []

    def record(mdp, demonstrations, *, states, **_):
        asked.append(states)
        raise KeyboardInterrupt

    monkeypatch.setattr(methods, "soft_local_homomorphism", record)
    assert main(["explain", "1", "5", "2", "--mdp", "model.npz", "--demonstrations", "demos.npz"]) == 130
    np.testing.assert_array_equal(np.flatnonzero(asked[0]), [1, 2])  # in 5 an episode has ended


@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")  # any states will do
def test_states_of_racetracks_are_cells_and_speeds(files, track, capsys):
    cells = [((0, 1), (0, 0)), ((0, 1), (0, 2)), ((0, 2), (-1, 0))]
    arguments = ["0,1", "0,1,0,2", "0,2,-1,0", "--mdp", "a.track", "--demonstrations", "demos.csv"]
    assert main(["explain", *arguments, "--method", "maximum-entropy"]) == 0
    printed = capsys.readouterr().out
    assert all(f"State {track.state_of(*cell)}:" in printed for cell in cells)


LAKE_PLOTS = ("policy", "occupancy", "generalization")


@pytest.mark.parametrize("model", [["--env", LAKE], ["--mdp", "model.npz"]])
def test_plots_of_policies(files, model):
    visited = np.arange(STATES) < 4
    radius = np.where(visited, 0, 2)
    interop.save_policy("general.npz", UNIFORM, visited=visited, radius=radius, support=np.ones(STATES, int))
    for kind in LAKE_PLOTS:
        assert main(["plot", kind, "general.npz", *model, "--output", f"{kind}.png"]) == 0
        assert files[f"{kind}.png"].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("demonstrations", ["demos.csv", "demos.npz"])
def test_plots_of_trajectories(files, demonstrations):
    assert main(["plot", "trajectories", demonstrations, "--mdp", "model.npz", "--output", "t.svg"]) == 0
    assert b"<svg" in files["t.svg"].read_bytes()[:2000]


@pytest.mark.parametrize("speed", [[], ["--speed", "0", "-1"]])
def test_plots_of_racetracks_know_speeds(files, speed):
    policy, ones = np.full((100, 5), 0.2), np.ones(100, int)
    policy[:, :] = np.eye(5)[np.arange(100) % 5]
    interop.save_policy("drive.npz", policy, visited=ones == 0, radius=ones, support=ones)
    sizes = set()
    for kind in ("policy", "generalization"):
        assert main(["plot", kind, "drive.npz", "--mdp", "a.track", *speed, "--output", f"{kind}.svg"]) == 0
        sizes.add(files[f"{kind}.svg"].stat().st_size)
    text = files["policy.svg"].read_text()
    assert f"cars of speed ({'0, -1' if speed else '0, 0'})" in text and len(sizes) == 2
