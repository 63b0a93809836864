"""`ask`: questions to standard input, to files and to the optimal policy; what it tells, keeps and refuses."""

import gzip
import io
import itertools
import re

import numpy as np
import oracles
import pytest
from cli_cases import LAKE, TRAJECTORIES, VISITED, Files, values

import jaxhom
from jaxhom.cli import answers, ask, questions
from jaxhom.cli.parser import main
from jaxhom.cli.sources import racetrack_problem
from jaxhom.interop import FileError, answers_from_csv, load_demonstrations
from jaxhom.interop.csv_answers import append_answer

PLAIN = ["--method", "maximum-entropy", "--no-pictures"]  # uniform where nothing is known


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    return Files(tmp_path)


def says(monkeypatch, text, is_terminal=False):
    stdin = io.StringIO(text)
    stdin.isatty = lambda: is_terminal
    monkeypatch.setattr("sys.stdin", stdin)


def first_questions(files, count):
    """The states with the highest mu (H + 0.05) under the uniform policy, by the oracle."""
    mdp = files.lake.mdp
    transition = np.asarray(mdp.transition)
    _, policy = oracles.empirical_policy(16, 4, TRAJECTORIES)
    mu = oracles.occupancy(transition, 0.99, np.asarray(mdp.initial), policy).sum(axis=1)
    entropy = np.array([-sum(p * np.log(p) for p in row if p > 0) for row in policy])
    score = mu * (entropy + 0.05) * ~np.isin(np.arange(16), VISITED) * ~oracles.absorbing(transition)
    return np.argsort(-score, kind="stable")[:count].tolist()


def test_standard_input_answers(files, monkeypatch, capsys):
    """A number, a skipped state, the end: what was said is learned from and kept."""
    asked = first_questions(files, 3)
    says(monkeypatch, "2\n\n3\n")
    assert main(["ask", *files.options(), *PLAIN, "--count", "3"]) == 0
    assert files["out/answers.csv"].read_text() == f"state,action\n{asked[0]},2\n{asked[2]},3\n"
    np.testing.assert_array_equal(files.policy()[asked[0]], np.eye(4)[2])
    np.testing.assert_array_equal(files.policy()[asked[2]], np.eye(4)[3])
    shown = load_demonstrations("out/demonstrations.npz")
    assert shown.is_answer.tolist() == [False, False, True, True]
    report, printed = files.report(), capsys.readouterr().out
    assert [row["answers"] for row in report["rounds"]] == [0, 2] and report["finished"]
    for row, policy in zip(report["rounds"], [None, files.policy()], strict=True):
        if policy is not None:
            (value,), best = values(files, [policy])
            np.testing.assert_allclose([row["value"], row["optimal_value"]], [value, best], rtol=1e-9)
    assert f"1  state {asked[0]}" in printed and "round 1: 8 states known, 2 answers" in printed


def test_skipped_states_are_not_asked_again(files, monkeypatch, capsys):
    asked = first_questions(files, 4)
    says(monkeypatch, "\n\n1\nq\n")
    assert main(["ask", *files.options(), *PLAIN, "--count", "2"]) == 0
    said = files["out/answers.csv"].read_text().splitlines()
    assert said == ["state,action", f"{asked[2]},1"]
    assert "round 2" not in capsys.readouterr().out


def test_the_next_run_goes_on_from_the_file(files, monkeypatch):
    """In the columns that the file has, and on a line of its own."""
    files["said.csv"].write_text("who,action,state\nme,2,1\nme,,2")
    says(monkeypatch, "3\n")
    assert main(["ask", *files.options("p.npz"), *PLAIN, "--count", "1", "--answers", "said.csv", "--rounds", "1"]) == 0
    lines = files["said.csv"].read_text().splitlines()
    assert lines[:3] == ["who,action,state", "me,2,1", "me,,2"] and re.fullmatch(r",3,\d+", lines[3])
    policy = files.policy("p.npz")
    np.testing.assert_array_equal(policy[1], np.eye(4)[2])
    np.testing.assert_array_equal(policy[int(lines[3].split(",")[2])], np.eye(4)[3])


def test_the_optimal_policy_answers(files, capsys):
    arguments = ["--env", LAKE, "--expert", "1", "--steps", "3", "--answers", "expert", "--output", "out", *PLAIN]
    assert main(["ask", *arguments, "--count", "4"]) == 0
    rounds, printed = files.report()["rounds"], capsys.readouterr().out
    assert rounds[0]["value"] < 0.5 * rounds[0]["optimal_value"]
    np.testing.assert_allclose(rounds[-1]["value"], rounds[-1]["optimal_value"], rtol=1e-9)
    assert "nothing is left to ask" in printed and not files["out/answers.csv"].exists()
    assert "\n+" in printed.replace("S", "+") and "1 down" in printed  # the map, and names of actions


def test_features_bound_what_is_lost_and_stop(files, capsys):
    files.write_model(features=np.eye(16)[:, [14, 15]])
    arguments = [*files.options(), *PLAIN, "--answers", "expert", "--count", "2"]
    assert main(["ask", *arguments]) == 0
    losses = [row["loss_per_step"] for row in files.report()["rounds"]]
    shown = load_demonstrations("out/demonstrations.npz")
    mdp = files.lake.mdp.replace(features=np.repeat(np.eye(16)[:, None, [14, 15]], 4, axis=1))
    last = jaxhom.loss_bound(mdp, shown, files.policy())
    np.testing.assert_allclose(losses[-1], 0.01 * float(last.bound), rtol=1e-6)
    middle = next(loss for loss in losses if loss < losses[0])
    capsys.readouterr()
    assert main(["ask", *arguments, "--until-loss", str(middle), "--criterion", "visits"]) == 0
    stopped = [row["loss_per_step"] for row in files.report()["rounds"]]
    assert stopped[-1] <= middle < min(stopped[:-1])
    assert f"loss per step <= {stopped[0]:.4g}" in capsys.readouterr().out


@pytest.mark.parametrize("method", ["nearest-neighbors", "choose"])
def test_the_likelihood_is_that_of_the_choice(files, method):
    arguments = [*files.options(), "--method", method, "--no-pictures", "--answers", "expert", "--count", "2"]
    assert main(["ask", *arguments, "--rounds", "1"]) == 0
    shown, rows = load_demonstrations("out/demonstrations.npz"), files.report()["rounds"]
    inner = ~np.asarray(files.lake.terminal)
    for row, some in zip(rows, (shown[~shown.is_answer], shown), strict=True):
        candidates = {method: jaxhom.nearest_neighbors} if method != "choose" else None
        scores = jaxhom.choose_generalization(files.lake.mdp, some, candidates, states=inner).scores
        assert row["likelihood"] == pytest.approx(max(scores.values()), abs=1e-9)
    assert main(["ask", *arguments, "--until-likelihood", str(rows[0]["likelihood"])]) == 0
    assert len(files.report()["rounds"]) == 1


def test_learn_and_plot_take_demonstrations_with_answers(files, capsys):
    assert main(["ask", *files.options(), *PLAIN, "--answers", "expert", "--count", "2", "--rounds", "1"]) == 0
    capsys.readouterr()
    shown = ["--mdp", "model.npz", "--demonstrations", "out/demonstrations.npz", "--output", "again"]
    assert main(["learn", *shown, *PLAIN]) == 0
    np.testing.assert_array_equal(files.policy("again/policy.npz"), files.policy())
    counts = files.report("again/report.json")["demonstrations"]
    assert (counts["trajectories"], counts["steps"], counts["answers"], counts["states"]) == (2, 8, 2, 8)
    assert re.search(r"answers about single states +2\n", capsys.readouterr().out)
    for model in (["--mdp", "model.npz"], ["--env", LAKE]):
        assert main(["plot", "trajectories", "out/demonstrations.npz", *model, "--output", "walks.png"]) == 0


def test_pictures_of_questions(files):
    arguments = ["--env", LAKE, "--expert", "1", "--answers", "expert", "--rounds", "1", "--output", "out"]
    assert main(["ask", *arguments, "--method", "maximum-entropy"]) == 0
    assert files["out/questions.png"].stat().st_size > 1000


def test_an_interruption_keeps_the_answers_so_far(files, monkeypatch, capsys):
    says(monkeypatch, "1\n")
    real = answers.Answers._asked

    def interrupted(self, question, state):
        if len(self):
            raise KeyboardInterrupt
        return real(self, question, state)

    monkeypatch.setattr(answers.Answers, "_asked", interrupted)
    assert main(["ask", *files.options(), *PLAIN]) == 130
    assert "answers.csv" in capsys.readouterr().err
    assert len(files["out/answers.csv"].read_text().splitlines()) == 2


def test_a_terminal_is_asked_again(files, monkeypatch, capsys):
    says(monkeypatch, "9\nwest\n1\nq\n", is_terminal=True)
    assert main(["ask", *files.options(), *PLAIN, "--count", "1"]) == 0
    printed = capsys.readouterr().out
    assert "'9' is no action" in printed and "'west' is no action" in printed
    assert len(files["out/answers.csv"].read_text().splitlines()) == 2


def test_tracks_have_places_with_speeds_and_names_of_actions():
    problem = racetrack_problem("a")
    state = problem.state_of("7,3,1,-2")
    assert questions.name_of(problem, state) == f"{state} at 7,3,1,-2"
    assert questions.action_names(problem)[:2] == ["nothing", "up"]
    shown = jaxhom.Demonstrations.from_trajectories([([problem.state_of("8,34")], [0])])
    queries = jaxhom.query_states(problem.mdp, shown, np.full((5900, 5), 0.2), 40, terminal=problem.terminal)
    lines = questions.questions(problem, shown, queries).splitlines()
    assert lines[-4].endswith("+") and len(lines[-1]) == 35 and questions.mark(80) == "*"


REFUSED = {
    "--answers none": (["--output", "p.npz"], "--answers FILE.csv is needed"),
    "unknown state": (["--answers", "far.csv"], "far.csv line 3, column 'state': must lie in [0, 16), got 16"),
    "unknown action": (["--answers", "act.csv"], "act.csv line 2, column 'action': must lie in [0, 4), got 4"),
    "no column": (["--answers", "none.csv"], "none.csv line 1: column 'action' is missing"),
    "no folder": (["--answers", "missing/said.csv"], "missing: no such folder"),
    "no features, loss": (["--until-loss", "1"], "--until-loss needs features"),
    "no features, bound": (["--criterion", "bound"], "--criterion bound needs features"),
    "nan": (["--until-loss", "nan"], "--until-loss must be a number"),
    "count": (["--count", "0"], "must be at least 1"),
    "Monte Carlo": (["--method", "monte-carlo"], "invalid choice"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_input_is_one_line(files, capsys, case):
    options, message = REFUSED[case]
    files["far.csv"].write_text("state,action\n1,2\n16,0\n")
    files["act.csv"].write_text("state,action\n1,4\n")
    files["none.csv"].write_text("state\n1\n")
    files.write_model(features=None)
    try:
        code = main(["ask", *files.options(), *PLAIN, *options])
    except SystemExit as exit:
        code = exit.code
    error = capsys.readouterr().err
    assert code == 2 and message in error and error.count("\n") == 1


def test_what_standard_input_says_wrong_is_one_line(files, monkeypatch, capsys):
    says(monkeypatch, "2\n4\n")
    assert main(["ask", *files.options(), *PLAIN]) == 2
    assert "'4' is no action that is allowed there" in capsys.readouterr().err
    assert len(files["out/answers.csv"].read_text().splitlines()) == 2  # the first one is kept


def test_a_closed_standard_input_answers_nothing(files, monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    assert main(["ask", *files.options(), *PLAIN]) == 0
    assert [row["answers"] for row in files.report()["rounds"]] == [0]


def test_a_single_trajectory_has_no_likelihood(files, capsys):
    files["one.csv"].write_text("episode,state,action\na,0,1\na,4,1\n")
    arguments = ["--mdp", "model.npz", "--demonstrations", "one.csv", "--output", "out", *PLAIN]
    assert main(["ask", *arguments, "--until-likelihood", "-1"]) == 2
    assert "needs two trajectories" in capsys.readouterr().err
    assert main(["ask", *arguments]) == 0
    assert "likelihood" not in files.report()["rounds"][0]


def test_no_reward_has_no_simulated_expert(files, capsys):
    files.write_model(reward=None)
    assert main(["ask", *files.options(), *PLAIN, "--answers", "expert"]) == 2
    assert "has no reward" in capsys.readouterr().err


def test_answers_that_are_not_allowed_name_the_line(tmp_path):
    allowed = np.ones((2, 2), bool)
    allowed[1, 1] = False
    mdp = jaxhom.MDP.from_dense(np.full((2, 2, 2), 0.5), discount=0.9, allowed=allowed)
    path = tmp_path / "said.csv"
    path.write_text("state,action\n0,1\n1,1\n")
    with pytest.raises(FileError, match=r"line 3, column 'action': 1 is not allowed in state 1"):
        answers_from_csv(path, mdp=mdp)


def test_a_file_of_answers_grows_by_lines(tmp_path):
    mdp, path = jaxhom.gridworld(3).mdp, tmp_path / "said.csv"
    for state, action in ((1, 2), (8, 0)):
        append_answer(path, state, action, mdp=mdp)
    assert path.read_bytes() == b"state,action\n1,2\n8,0\n"
    states, actions = answers_from_csv(path, mdp=mdp)
    assert (states.tolist(), actions.tolist()) == ([1, 8], [2, 0])
    path.write_text("state,action\n")
    assert answers_from_csv(path, mdp=mdp)[0].shape == (0,)
    path.write_text("state\n")
    with pytest.raises(FileError, match="'action' is missing"):
        append_answer(path, 1, 1, mdp=mdp)


@pytest.mark.parametrize("names", [(1, 2, 3), ("2", "10", "a"), ("0, 1", "1", 'say "2"')], ids=str)
def test_answers_come_back_where_names_are_numbers(tmp_path, names):
    mdp = jaxhom.MDP.from_dense(np.full((3, 2, 3), 1 / 3), discount=0.9)
    mdp = mdp.replace(state_names=names, action_names=(2, 1))
    path = tmp_path / "said.csv"
    pairs = list(itertools.product(range(3), range(2)))
    for state, action in pairs:
        append_answer(path, state, action, mdp=mdp)
    assert list(zip(*answers_from_csv(path, mdp=mdp), strict=True)) == pairs


def test_a_file_that_cannot_be_added_to_stays_as_it_is(tmp_path):
    mdp = jaxhom.gridworld(3).mdp
    for name, content, message in (
        ("said.csv.gz", gzip.compress(b"state,action\n1,2\n"), "compressed"),
        ("said.txt", b"who state action\nme 1 2\n", "between blanks"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(FileError, match=message):
            append_answer(path, 1, 1, mdp=mdp)
        assert path.read_bytes() == content


def test_every_criterion_can_be_chosen(files):
    files.write_model(features=np.eye(16)[:, [14]])
    for criterion in ask.CRITERIA:
        options = ["--criterion", criterion, "--rounds", "1", "--answers", "expert"]
        assert main(["ask", *files.options(), *PLAIN, *options]) == 0
