"""The command line as a whole: the main job, help, and one clear line for whatever is wrong with any command."""

import dataclasses
import gzip
import pathlib
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from cli_cases import LAKE, STATES, TRACK, Files

import jaxhom
from jaxhom import interop
from jaxhom.apprenticeship.lpal import LPALSolution
from jaxhom.cli import main_job
from jaxhom.cli.methods import METHODS
from jaxhom.cli.parser import main, make_parser
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.status import Status

SMALL = ["--grid", "2", "--regions", "1", "--demonstrations", "1", "--sets", "1"]


@pytest.fixture
def files(tmp_path):
    return Files(tmp_path)


@pytest.fixture
def in_folder(files, monkeypatch):
    monkeypatch.chdir(files.folder)
    return files


def error_of(capsys, *arguments):
    """The one line of a command that has to fail."""
    try:
        code = main(arguments)
    except SystemExit as stopped:  # of the parser
        code = stopped.code
    error = capsys.readouterr().err
    assert code == 2, error
    assert error.startswith("jaxhom: error: ") and error.count("\n") == 1
    return error


# ----------------------------------------------------------------------------------------- the main job


def uniform(problem, demonstrations, *_, **__):
    return uniform_elsewhere(problem.mdp, demonstrations), {}


def replace_method(monkeypatch, name, function):
    monkeypatch.setitem(METHODS, name, dataclasses.replace(METHODS[name], function=function))


def quick_methods(monkeypatch):
    """The job's table and picture without its long computations."""

    def lpal(mdp, expectations, *, initial_policy=None):
        if initial_policy is None:
            initial_policy = np.full((1, *mdp.allowed.shape), 1.0 / mdp.num_actions)
        fields = dict.fromkeys(("occupancy", "weights", "iterations", "status"))
        return LPALSolution(policy=initial_policy, margin=np.ones(1), margin_bound=np.full(1, 1.5), **fields)

    monkeypatch.setattr(main_job, "lpal", lpal)
    monkeypatch.setattr(main_job, "feature_expectations", lambda mdp, policies: None)
    for name in ("soft-local-homomorphism", "nearest-neighbors"):
        replace_method(monkeypatch, name, uniform)


def test_main_job_prints_its_table(in_folder, monkeypatch, capsys):
    quick_methods(monkeypatch)
    assert main([*SMALL, "--track", "a.track", "--picture", "policies.png", "--seed", "1", "--progress"]) == 0
    written = capsys.readouterr()
    learned = ("soft local homomorphism", "soft local homomorphism + LPAL", "k-NN (hops)", "LPAL, fed with zeros")
    for name in ("expert", *learned):
        assert written.out.count(f"\n  {name}  ") == 2
    assert "gridworld 2x2, 1 regions" in written.out and "racetrack (a.track), 1 demonstrations" in written.out
    lines = written.out.splitlines()
    assert len({len(line) for line in lines if line.startswith("---")}) == 1 and lines[1].startswith("---")
    assert lines[5].endswith("5.0e-03")  # the LPAL gap of 0.5, per step
    assert in_folder["policies.png"].stat().st_size > 10_000
    assert "racetrack (a.track)" in written.err  # the progress bar


def test_main_job_has_printed_what_was_finished(in_folder, monkeypatch, capsys):
    quick_methods(monkeypatch)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    replace_method(monkeypatch, "nearest-neighbors", interrupt)
    assert main([*SMALL, "--grid", "0", "--track", "a.track"]) == 130
    written = capsys.readouterr()
    assert "gridworld" not in written.out
    assert "\n  soft local homomorphism  " in written.out and "k-NN" not in written.out
    assert written.err == "jaxhom: interrupted\n"


def test_main_job_says_what_did_not_end_as_asked(in_folder, monkeypatch, capsys):
    quick_methods(monkeypatch)
    quick = main_job.lpal
    late = np.array([Status.ITERATION_LIMIT])
    monkeypatch.setattr(main_job, "lpal", lambda *problem, **start: quick(*problem, **start).replace(status=late))
    assert main([*SMALL, "--track", "a.track", "--picture", ""]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        f"jaxhom: warning: {title}, {name}: {Status.ITERATION_LIMIT.message}"
        for title in ("gridworld 2x2, 1 regions, 10 demonstrations", "racetrack (a.track), 1 demonstrations")
        for name in ("soft local homomorphism + LPAL", "LPAL, fed with zeros")
    ]


def test_main_job_says_how_to_get_its_picture(in_folder, monkeypatch, capsys):
    quick_methods(monkeypatch)

    def missing():
        raise ImportError("pip install it")

    monkeypatch.setattr(main_job, "load_plotting", missing)
    assert main([*SMALL, "--track", "a.track"]) == 0
    assert "No picture: pip install it" in capsys.readouterr().out


# ------------------------------------------------------------------------------------ options and help


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--help"], ["--demonstrations", "learn", "evaluate", "explain", "plot"]),
        (["learn", "--help"], ["next_state", "--env FrozenLake", "--mdp a ", ".track", "drives.csv", "report.json"]),
        (["evaluate", "--help"], ["--against", "--mdp MODEL.npz"]),
        (["explain", "--help"], ["row,column", "--mdp MODEL.npz"]),
        (["plot", "--help"], ["occupancy", "--speed"]),
    ],
)
def test_help_explains(capsys, arguments, expected):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 0
    written = capsys.readouterr().out
    assert all(text in written for text in expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sets", "0"], "--sets: must be at least 1, got 0"),
        (["--sets", "x"], "--sets: must be a whole number, got 'x'"),
        (["--seed", "-1"], "--seed: must not be negative, got -1"),
        (["learn", "--mdp", "x"], "arguments are required: --output"),
        (["learn", "--expert", "1", "--output", "x"], "one of the arguments --env --mdp is required"),
        (["learn", "--mdp", "a", "--output", "x"], "one of the arguments --demonstrations --expert is required"),
        (["learn", "--mdp", "a", "--env", LAKE, "--expert", "1", "--output", "x"], "not allowed with argument"),
        (["learn", "--mdp", "a", "--expert", "1", "--output", "x", "--method", "magic"], "invalid choice: 'magic'"),
        (["fly"], "invalid choice: 'fly'"),
        (["--grid", "3", "--regions", "4"], "whose root divides the size"),
        (["--grid", "0", "--track", "nowhere"], "neither shipped (a, b) nor a file"),
    ],
)
def test_wrong_options_are_one_line(capsys, arguments, message):
    assert message in error_of(capsys, *arguments)


ROOT = pathlib.Path(__file__).parent.parent.parent
TEXTS = [ROOT / "README.md", ROOT / ".ci" / "run", *sorted((ROOT / "jaxhom" / "cli").glob("*.py"))]
LINES = [line for text in TEXTS for line in re.findall(r"-m jaxhom ([a-z-][^`\n]* -[^`\n]*)", text.read_text())]
COMMANDS = sorted({line for line in LINES if "--help" not in line})


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_in_texts_are_understood(command):
    assert make_parser().parse_args(shlex.split(command)).run


def test_module_runs():
    done = subprocess.run([sys.executable, "-m", "jaxhom", "learn", "--mdp", "x"], capture_output=True, text=True)
    assert done.returncode == 2 and "required" in done.stderr and done.stderr.count("\n") == 1


# --------------------------------------------------------------------------------------- wrong sources


@pytest.mark.parametrize(
    ("model", "demonstrations", "message"),
    [
        ({"discount": 1.0}, {}, "model.npz: discount must lie strictly between 0 and 1"),
        ({"discount": None}, {}, "model.npz: array 'discount' is missing"),
        ({"next_state": None}, {}, "model.npz: array 'next_state' is missing"),
        ({"next_state": None, "probability": None}, {}, "model.npz: neither transition nor next_state and probability"),
        ({"transition": np.full((3, 2, 3), 0.5)}, {}, "model.npz: sum of transition[0, 0] must be 1, got 1.5"),
        ({"transition": np.zeros((3, 2))}, {}, "model.npz: transition must have shape [S, A, S]"),
        ({"initial": np.ones(3)}, {}, "model.npz: initial must have shape (16,)"),
        ({"reward": np.ones(3)}, {}, "model.npz: reward must have shape (16, 4) or (16,), got (3,)"),
        ({"reward": np.full(16, np.nan)}, {}, "model.npz: reward[0] must be finite"),
        ({"coordinates": np.ones(16)}, {}, "model.npz: coordinates must have shape (16, D)"),
        ({"terminal": np.ones(3, bool)}, {}, "model.npz: terminal must have shape (16,)"),
        ({"terminal": np.ones(16)}, {}, "model.npz: terminal must be bool, got dtype float64"),
        ({"terminal": np.ones(16, bool)}, {}, "model.npz: terminal[0] must be False where episodes start"),
        ({}, {"states": None}, "demos.npz: array 'states' is missing"),
        ({}, {"states": [[0, 4, 99]], "actions": [[0, 1, 1]], "length": None}, "demos.npz: states[0, 2] must lie in"),
        ({}, {"actions": [[0, 1], [0, 1]]}, "demos.npz: actions must have shape (2, 6)"),
        ({}, {"length": [3, 0]}, "demos.npz: trajectory 1 is empty"),
        ({}, {"length": [3, 7]}, "demos.npz: length[1] must be below 7"),
        ({}, {"format_version": 7}, "demos.npz: written in format 7"),
        ({}, {"states": np.array([[0, None], [1, "x"]], object)}, "demos.npz: 'states' holds pickled Python objects"),
    ],
)
def test_wrong_arrays_are_one_line(files, capsys, model, demonstrations, message):
    files.write_model(**model)
    files.write_demonstrations(**demonstrations)
    assert message in error_of(capsys, "learn", *files.options())
    assert not files["out"].exists()


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04truncated"])
def test_foreign_files_are_one_line(files, capsys, content):
    files["model.npz"].write_bytes(content)
    assert "model.npz: not a readable .npz archive" in error_of(capsys, "learn", *files.options())


@pytest.mark.parametrize("share", [0.3, 0.99])
def test_truncated_archives_are_one_line(files, capsys, share):
    whole = files["model.npz"].read_bytes()
    files["model.npz"].write_bytes(whole[: int(share * len(whole))])
    assert "model.npz: not a readable .npz archive" in error_of(capsys, "learn", *files.options())


def test_trajectories_of_every_kind(in_folder, capsys):
    """The same steps in text of other delimiters, packed, and in another library's archive."""
    with np.load("demos.npz") as archive:
        lengths = archive["length"]
        lines = [
            f"{row}\t{archive['states'][row, t]}\t{archive['actions'][row, t]}"
            for row, length in enumerate(lengths)
            for t in range(length)
        ]
        names = ("states", "actions")
        flat = {name: np.concatenate([archive[name][r, :n] for r, n in enumerate(lengths)]) for name in names}
    in_folder["steps.txt.gz"].write_bytes(gzip.compress("\n".join(["traj\tobs\tact", *lines]).encode()))
    starts = np.concatenate([np.arange(n) == 0 for n in lengths])
    np.savez("expert.npz", obs=flat["states"], actions=flat["actions"], episode_starts=starts, rewards=starts * 1.0)
    weights = []
    for name in ("demos.npz", "steps.txt.gz", "expert.npz"):
        assert main(["learn", "--mdp", "model.npz", "--demonstrations", name, "--output", "p.npz"]) == 0
        assert f"{name}; 2 episodes, 8 steps" in capsys.readouterr().out
        weights.append(interop.load_policy("p.npz"))
    np.testing.assert_array_equal(weights[1], weights[0])
    np.testing.assert_array_equal(weights[2], weights[0])


def test_trajectories_by_name_and_without_actions(in_folder, capsys):
    """Four rooms in a row: to stay is what both actions do in the last, and only there."""
    transition = np.eye(4)[np.array([[0, 1], [0, 2], [1, 3], [3, 3]])]
    rooms = jaxhom.MDP.from_dense(transition, discount=0.9, state_names=["hall", "landing", "attic", "roof"])
    interop.save_mdp("rooms.npz", rooms)
    in_folder["walk.csv"].write_text("day;s\n1;hall\n1;landing\n1;attic\n1;roof\n1;roof\n")
    command = ["learn", "--mdp", "rooms.npz", "--demonstrations", "walk.csv", "--output", "out", "--no-pictures"]
    assert "walk.csv line 1: column 'episode' is missing" in error_of(capsys, *command)
    in_folder["walk.csv"].write_text("run;s\n1;hall\n1;hall\n1;landing\n1;attic\n1;roof\n1;roof\n")
    assert main(command) == 0
    told = "1 episodes, 4 steps; 1 final observations; 1 steps could have been several actions"
    assert told in capsys.readouterr().out
    np.testing.assert_array_equal(interop.load_demonstrations("out/demonstrations.npz").actions, [[0, 1, 1, 1]])
    assert "sequence 1, step 4: actions 0, 1 lead from" in error_of(capsys, *command, "--ambiguous", "refuse")
    in_folder["walk.csv"].write_text("run;s\n1;hall\n1;rof\n")
    assert "walk.csv line 3, column 's': there is no state 'rof'; did you mean 'roof'" in error_of(capsys, *command)


CSV = "episode,state,action\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CSV + "a,0,1\na,16,1\n", "bad.csv line 3, column 'state': must lie in [0, 16), got 16"),
        (CSV + "a,0,4\n", "bad.csv line 2, column 'action': must lie in [0, 4), got 4"),
        (CSV + "a,zero,1\n", "bad.csv line 2, column 'state': must be a whole number, got 'zero'"),
        ("episode,state\na,0\na,15\n", "bad.csv: sequence a, step 0: no action leads from state 0 to state 15"),
        ("episode,action\na,0\n", "bad.csv line 1: column 'state' is missing"),
        (CSV, "bad.csv: there are no episodes"),
    ],
)
def test_wrong_lines_are_one_line(files, capsys, text, message):
    files["bad.csv"].write_text(text)
    arguments = ["--mdp", files.path("model.npz"), "--demonstrations", files.path("bad.csv")]
    assert message in error_of(capsys, "learn", *arguments, "--output", files.path("out"))


MODEL = "--mdp model.npz --demonstrations demos.npz --output out "
FEATURES = MODEL + "--features states "


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--mdp nowhere.npz --expert 1 --output out", "nowhere.npz: no such file"),
        ("--mdp a.foo --expert 1 --output out", "a.foo: models are .npz, .pomdp, .mdp, .tra, .csv, .tsv, .map"),
        ("--mdp bad.track --expert 1 --output out", "bad.track: track line 2, column 3: unknown letter '?'"),
        ("--mdp model.npz --demonstrations nowhere.csv --output out", "nowhere.csv: no such file"),
        ("--mdp model.npz --demonstrations nowhere.npz --output out", "nowhere.npz: no such file"),
        (MODEL + "--discount 0.9", "model.npz: it has a discount of its own, 0.99"),
        (MODEL + "--discount 1", "--discount must lie strictly between 0 and 1, got 1.0"),
        (MODEL + "--end-state", "--end-state belongs to --env"),
        (MODEL + "--steps 3", "--steps belongs to --expert"),
        ("--mdp plain.npz --expert 1 --output out", "--expert needs a reward, and plain.npz has none"),
        (MODEL + "--threshold -1", "--threshold must not be negative, got -1.0"),
        (MODEL + "--tolerance 0", "--tolerance must be positive, got 0.0"),
        (MODEL + "--metric hops", "--metric belongs to nearest-neighbors; the method is soft-local-homomorphism"),
        (MODEL + "--method maximum-entropy --printed", "--printed belongs to soft-local-homomorphism and soft-homo"),
        (MODEL + "--method maximum-entropy --threshold 0", "--threshold belongs to soft-local-homomorphism"),
        (MODEL + "--lpal", "model.npz: LPAL needs features, and the model has none; try --features states"),
        (
            MODEL + "--method choose --relation lax",
            "--relation belongs to soft-local-homomorphism; the method is",
        ),
        (MODEL + "--temperature 0.1", "--temperature belongs to --weights"),
        (MODEL + "--label-weight 2", "--label-weight belongs to --labels"),
        (MODEL + "--weights similarity --temperature 0", "--temperature must be positive and finite, got 0.0"),
        (MODEL + "--voters some", "argument --voters"),
        (MODEL + "--labels features", "--labels features: model.npz has none"),
        (MODEL + "--labels none.npy", "--labels none.npy: not features or reward, and no .npy file"),
        (MODEL + "--labels reward --label-weight -1", "--label-weight must not be negative, got -1.0"),
        (MODEL + "--method monte-carlo", "model.npz: LPAL needs features"),
        (FEATURES, "--features belongs to --lpal"),
        (MODEL + "--lpal-tolerance 1", "--lpal-tolerance belongs to --lpal"),
        (FEATURES + "--lpal --lpal-tolerance 0", "--lpal-tolerance must be positive, got 0.0"),
        (
            "--mdp a.track --features states --lpal --expert 1 --output out",
            "--features: racetrack a.track has features",
        ),
        (
            "--mdp plain.npz --demonstrations demos.npz --output out --method regression",
            "--method regression needs coo",
        ),
        (
            "--mdp plain.npz --demonstrations demos.npz --output out --method nearest-neighbors --metric euclidean",
            "--metric euclidean needs coordinates of the states, and plain.npz has none",
        ),
        (
            "--mdp model.npz --demonstrations demos.npz --output model.track",
            "--output model.track: policies are written",
        ),
        ("--mdp model.npz --demonstrations demos.npz --output p.csv", "--output p.csv: policies are written to .npz"),
        ("--mdp model.npz --demonstrations demos.npz --output notes", "notes: File exists"),
        ("--mdp model.npz --demonstrations demos.npz --output no/where.npz", "no: no such folder"),
        (f"--env {LAKE} dry --expert 1 --output out", "--env: expected NAME=VALUE after the id, got 'dry'"),
        ("--env Nothing-v0 --expert 1 --output out", "environment 'Nothing-v0' cannot be made: Environment `Nothing`"),
        (
            f"--env {LAKE} wet=1 --expert 1 --output out",
            f"environment '{LAKE}': it has no option 'wet'; it has render_",
        ),
        (f"--env {LAKE} is_slippery=nope --expert 1 --output out", "is_slippery must be true or false, got 'nope'"),
        (
            f"--env {LAKE} desc=[SF,FG] --expert 1 --output out",
            "--env: desc is neither JSON nor a Python value, got [SF",
        ),
        (f"--env {LAKE} desc=SF desc=FG --expert 1 --output out", "--env: desc is given twice"),
        (
            "--env Taxi-v4 fickle_passenger=yes --expert 1 --output out",
            "fickle_passenger=True, which its table P does n",
        ),
        (
            "--mdp model.npz --demonstrations from1.csv --impossible refuse --output out",
            "from1.csv: 1 of 2 steps have probability 0 in this model; the first is trajectory 0, step 0: "
            "state 1, action 1, then state 8",
        ),
        ("--env CartPole-v1 --expert 1 --output out", "CartPole-v1: environment CartPoleEnv has no transition table P"),
    ],
)
def test_what_does_not_fit_is_one_line(in_folder, capsys, arguments, message):
    in_folder["a.foo"].write_text("")
    in_folder["notes"].write_text("")
    in_folder["from1.csv"].write_text("episode,state,action\na,1,1\na,8,1\na,12,\n")
    in_folder["bad.track"].write_text(TRACK + "S.?F\n")
    interop.save_mdp(in_folder["plain.npz"], in_folder.lake.mdp)
    assert message in error_of(capsys, "learn", *arguments.split())
    assert not in_folder["out"].exists()


def test_an_environment_that_needs_an_end_state(in_folder, monkeypatch, capsys):
    import gymnasium

    class Mixed(gymnasium.Env):
        """A step that ends the episode half of the time, and leads to the same state either way."""

        P: dict = {s: {0: [(0.5, 1, 0.0, True), (0.5, 1, 0.0, False)]} for s in range(2)}  # noqa: RUF012
        initial_state_distrib = np.array([1.0, 0.0])

    gymnasium.register("Mixed-v0", entry_point=Mixed, disable_env_checker=True)
    try:
        error = error_of(capsys, "learn", "--env", "Mixed-v0", "--expert", "1", "--output", "out")
    finally:
        gymnasium.registry.pop("Mixed-v0")
    assert "Mixed-v0: state 1 ends some episodes" in error and "pass --end-state" in error


def test_without_gymnasium_a_line_says_what_to_install(in_folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    error = error_of(capsys, "learn", "--env", LAKE, "--expert", "1", "--output", "out")
    assert "pip install '.[interop]'" in error


POLICY = "policy.npz --mdp model.npz "


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("evaluate nowhere.npz --mdp model.npz", "nowhere.npz: no such file"),
        ("evaluate demos.npz --mdp model.npz", "demos.npz: array 'policy' is missing"),
        ("evaluate policy.npz --mdp a.track", "policy.npz: its policy is (16, 4), but racetrack a.track has (100, 5)"),
        (f"evaluate {POLICY} --against wrong.npz", "wrong.npz: sum of policy[0] must be 1, got 2"),
        (f"evaluate {POLICY} --trials 1", "--trials must be 0 or at least 2"),
        (f"evaluate {POLICY} --output policy.npz", "--output policy.npz: the numbers are written to a .json file"),
        ("explain 16 --mdp model.npz --demonstrations demos.npz", "state 16 must lie in [0, 16)"),
        ("explain x --mdp model.npz --demonstrations demos.npz", "state 'x' must be a number, or numbers with commas"),
        ("explain 1,2 --mdp model.npz --demonstrations demos.npz", "model.npz numbers its states from 0 to 15"),
        (f"explain 4,0 --env {LAKE} --demonstrations demos.npz", "cell (4, 0) is outside the 4 x 4 map"),
        ("explain 0,0,3,0 --mdp a.track --expert 1", "speed must be two of -2, -1, 0, 1, 2"),
        ("explain 0 --mdp model.npz --demonstrations demos.npz --method monte-carlo", "invalid choice: 'monte-carlo'"),
        (f"plot policy {POLICY} --output policy.foo", "policy.foo: Format 'foo' is not supported"),
        (f"plot policy {POLICY} --output no/where.png", "no/where.png: No such file or directory"),
        (f"plot policy {POLICY} --speed 0 0 --output x.png", "--speed belongs to policies and generalizations on race"),
        (f"plot generalization {POLICY} --output x.png", "policy.npz: array 'visited' is missing"),
        ("plot policy odd.npz --mdp model.npz --output x.png", "odd.npz: visited must have shape (16,), got (3,)"),
        ("plot policy drive.npz --mdp a.track --speed 3 0 --output x.png", "drive.npz: speed must be two of -2"),
        ("plot trajectories policy.npz --mdp model.npz --output x.png", "policy.npz: array 'states' is missing"),
    ],
)
def test_the_other_commands_fail_in_one_line(in_folder, capsys, arguments, message):
    uniform = np.full((STATES, 4), 0.25)
    interop.save_policy("policy.npz", uniform)
    interop.save_policy("odd.npz", uniform, visited=np.ones(3, bool))
    interop.save_policy("drive.npz", np.full((100, 5), 0.2))
    np.savez("wrong.npz", policy=2 * uniform)
    assert message in error_of(capsys, *arguments.split())


def test_plot_without_matplotlib_says_what_to_install(in_folder, monkeypatch, capsys):
    import jaxhom

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delattr(jaxhom, "plotting", raising=False)
    for name in [name for name in sys.modules if name.startswith("jaxhom.plotting")]:
        monkeypatch.delitem(sys.modules, name)
    error = error_of(capsys, *["plot", "policy", "policy.npz", "--mdp", "model.npz", "--output", "x.png"])
    assert "pip install '.[plot]'" in error
