"""Trajectories and answers in text files of every kind: delimiters, names of columns, names of states, ends."""

import enum
import gzip
import re
import time

import numpy as np
import pytest

from jaxhom import MDP
from jaxhom.interop import FileError, answers_from_csv, demonstrations_from_csv
from jaxhom.interop.csv_answers import append_answer

EXPECTED = [([0, 2, 2, 4], [1, 0, 1]), ([3, 1], [0])]  # with the states where the episodes ended
LINES = [["x", 0, 1], ["y", 3, 0], ["x", 2, 0], ["x", 2, 1], ["y", 1, ""], ["x", 4, ""]]


class Colour(enum.Enum):
    RED = 1


class Unclear:
    """All its objects read the same."""

    def __str__(self):
        return "it"


def named_machine():
    """Three states with names of three kinds that text can hold, two actions with names."""
    return MDP.from_dense(
        np.full((3, 2, 3), 1 / 3),
        discount=0.9,
        state_names=["new", (0, 1), "worn out"],
        action_names=["run", "repair"],
    )


def pairs(demonstrations):
    return [(states.tolist(), actions.tolist()) for states, actions in demonstrations]


@pytest.fixture
def read(tmp_path):
    def read(text, name="steps.csv", **options):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return demonstrations_from_csv(path, **options)

    return read


def text(delimiter, header=("episode", "state", "action"), end="\n"):
    return end.join(delimiter.join(map(str, line)) for line in [header, *LINES])


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|", ", ", " ; "])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_any_delimiter(read, delimiter, end):
    demonstrations, report = read(text(delimiter, end=end))
    assert pairs(demonstrations) == EXPECTED
    assert (report.episodes, report.steps, report.final_observations) == (2, 4, 2)


@pytest.mark.parametrize("header", ["episode state action", "# episode  state\taction", "#episode state action"])
def test_blanks_between_fields(read, header):
    """As `numpy.savetxt` writes them, whose header is a comment, and whose numbers are floats."""
    lines = ["0 0 1", "  0   2.000000000000000000e+00 0.0", "0\t2 1", "", "0 4 nan", "1 3 0", "1 1 None"]
    demonstrations, _ = read("\n".join([header, *lines]))
    assert pairs(demonstrations) == EXPECTED


@pytest.mark.parametrize(
    "header",
    [
        ("trajectory", "obs", "act"),
        ("Traj_ID", "Observation", "A"),
        ("traj", "s", "a"),
        ("run", "STATES", "acts"),
        ("id", "state", "action"),
        ("Episode ID", "observations", "actions"),
    ],
)
def test_the_usual_names_of_columns(read, header):
    assert pairs(read(text(",", header))[0]) == EXPECTED


def test_columns_by_other_names(read):
    columns = {"state": "Position", "action": "button"}
    demonstrations, report = read(text(";", ("traj", "position", "Button")), columns=columns)
    assert pairs(demonstrations) == EXPECTED and report.unread == ()
    # A usual name that is given to another role is no candidate any more.
    demonstrations, _ = read("t,s,a,x\n0,9,0,1\n0,9,2,0\n", columns={"episode": "t", "state": "a", "action": "x"})
    assert pairs(demonstrations) == [([0, 2], [1, 0])]


def test_compressed_files(read):
    assert pairs(read(gzip.compress(text("\t").encode()), "steps.tsv.gz")[0]) == EXPECTED


def test_what_is_not_read_is_said(read):
    _, report = read("episode,r,state,action,who\n0,1.5,0,1,me\n")
    assert report.unread == ("r", "who")
    assert str(report).splitlines()[-1] == "not read: r, who"


@pytest.mark.parametrize(
    ("lines", "expected", "terminated"),
    [
        # flags of last steps
        ("s,a,done\n0,1,0\n2,0,0\n2,1,1\n3,0,False\n", [([0, 2, 2], [1, 0, 1]), ([3], [0])], [True, False]),
        ("s,a,timeout\n0,1,no\n2,0,yes\n3,0,\n", [([0, 2], [1, 0]), ([3], [0])], [False, False]),
        ("s,a,terminated,truncated\n0,1,1,1\n3,0,True,False\n", [([0], [1]), ([3], [0])], [False, True]),
        # a final observation is still of the episode that ended
        ("s,a,done\n0,1,1\n4,,1\n3,0,0\n1,,0\n", [([0, 4], [1]), ([3, 1], [0])], [True, False]),
        # next states, of which one does not fit
        ("s,a,next_obs\n0,1,2\n2,0,4\n3,0,1\n", [([0, 2, 4], [1, 0]), ([3, 1], [0])], [False, False]),
        ("s,a,s',done\n0,1,0,0\n0,0,0,1\n0,1,2,0\n", [([0, 0, 0], [1, 0]), ([0, 2], [1])], [True, False]),
        # steps that begin again
        ("t,s,a\n0,0,1\n1,2,0\n0,3,0\n", [([0, 2], [1, 0]), ([3], [0])], [False, False]),
        ("s,a,is_first\n0,1,1\n2,0,0\n3,0,1\n", [([0, 2], [1, 0]), ([3], [0])], [False, False]),
    ],
)
def test_episodes_without_names_are_told_apart(read, lines, expected, terminated):
    demonstrations, _ = read(lines)
    assert pairs(demonstrations) == expected
    np.testing.assert_array_equal(demonstrations.terminated, terminated)


def test_ends_of_named_episodes(read):
    demonstrations, report = read("episode,t,s,a,next_state,done\nx,1,2,0,4,1\ny,0,3,0,1,0\nx,0,0,1,2,0\n")
    assert pairs(demonstrations) == [([0, 2, 4], [1, 0]), ([3, 1], [0])]
    np.testing.assert_array_equal(demonstrations.terminated, [True, False])
    assert report.final_observations == 2


def test_names_of_states_and_actions(read):
    lines = 'episode,state,action\n0,new,run\n0,"(0, 1)",repair\n0,"[0,1]",0\n0,2,1\n0,worn out,\n'
    demonstrations, _ = read(lines, mdp=named_machine())
    assert pairs(demonstrations) == [([0, 1, 1, 2, 2], [0, 1, 0, 1])]


def test_tuples_of_numpy_scalars(read):
    places = [(np.int64(0), np.float64(1.5)), (np.int64(-2), np.str_("x"))]
    mdp = MDP.from_dense(np.eye(2)[:, None], discount=0.9, state_names=places)
    lines = "".join(f'0,"{place}",0\n' for place in places)  # `(np.int64(0), np.float64(1.5))`
    assert pairs(read(f"episode,state,action\n{lines}", mdp=mdp)[0]) == [([0, 1], [0, 0])]


def test_names_that_are_objects_stand_as_python_writes_them(read):
    names = [Colour.RED, ("a", Colour.RED), None, True, frozenset("a")]
    mdp = MDP.from_dense(np.eye(5)[:, None], discount=0.9, state_names=names)
    lines = "".join(f'0,"{name}",0\n' for name in names)
    assert pairs(read(f"episode,state,action\n{lines}", mdp=mdp)[0]) == [([0, 1, 2, 3, 4], [0] * 5)]
    unclear = mdp.replace(state_names=[Unclear() for _ in names])
    with pytest.raises(FileError, match="line 2, column 'state': there is no state 'it'"):
        read("episode,state,action\n0,it,0\n", mdp=unclear)


@pytest.mark.parametrize("delimiter", [",", ", ", " "])
def test_tuples_without_quotes(read, delimiter):
    """As programs write them that do not think of it."""
    header = delimiter.join(["Episode", "Step", "State", "Action", "Reward", "NextState", "Done"])
    lines = ["1 1 (0,1) run -1.0 new False", "1 2 new 1 0.5 (0,1) True"]
    text = "\n".join([header, *(line.replace(" ", delimiter) for line in lines)])
    demonstrations, report = read(text, mdp=named_machine())
    assert pairs(demonstrations) == [([1, 0, 1], [0, 1])] and demonstrations.terminated.tolist() == [True]
    assert report.unread == ("Reward",)
    with pytest.raises(FileError, match="line 2: 4 fields, but the first line names 3 columns"):
        read("episode,state,action\n0,(0,(1,1\n")


def test_numbers_that_are_names_are_no_indices(read):
    mdp = named_machine().replace(state_names=[10, 20, 1])
    assert pairs(read("episode,state,action\n0,1,0\n0,20,1\n0,10.0,\n", mdp=mdp)[0]) == [([2, 1, 0], [0, 1])]
    with pytest.raises(FileError, match="line 2, column 'state': there is no state '0'"):
        read("episode,state,action\n0,0,0\n", mdp=mdp)


def test_fields_that_are_no_indices_need_to_states(read):
    lines = 'episode,obs,action\n0,"[1, 2]",0\n0,"(0, 3)",1\n0,[2 0],\n'
    with pytest.raises(FileError, match=r"line 2, column 'obs': must be a whole number, got '\[1, 2\]'"):
        read(lines)
    demonstrations, _ = read(lines, to_states=lambda cells: cells @ [4, 1])
    assert pairs(demonstrations) == [([6, 3, 8], [0, 1])]
    with pytest.raises(FileError, match=r"steps.csv: to_states: states must have shape \(3,\), got \(1,\)"):
        read(lines, to_states=lambda cells: [0])


def test_rows_of_states_alone(read):
    ring = MDP.from_dense(np.eye(3)[[[0, 1], [1, 2], [2, 0]]], discount=0.9)
    lines = "episode,state\nx,0\ny,2\nx,1\nx,1\ny,0\n"
    demonstrations, report = read(lines, mdp=ring)
    assert pairs(demonstrations) == [([0, 1, 1], [1, 0]), ([2, 0], [1])]
    assert report.ambiguous == ()
    with pytest.raises(FileError, match="steps.csv: sequence x, step 1: no action leads from state 2 to state 1"):
        read(lines.replace("x,1\nx,1", "x,2\nx,1").replace("x,0", "x,1"), mdp=ring)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("s,a,done\n0,1,maybe\n", "line 2, column 'done': must be true or false, got 'maybe'"),
        ("episode,s,a,done\nx,0,1,1\nx,2,0,0\n", "line 3: a step after the one that terminated its episode"),
        ("episode,s,a,timeout\nx,0,1,1\nx,2,0,0\n", "line 3: a step after the one that truncated its episode"),
        ("episode,s,a,s'\nx,0,1,3\n\nx,2,0,0\n", "lines 2 and 4: the next state is 3, but then the state is 2"),
        ("episode,s,a,s'\nx,0,1,3\nx,3,0,oops\n", "line 3, column \"s'\": must be a whole number, got 'oops'"),
        (
            "episode,s,obs,a\n",
            "line 1: columns 's' and 'obs' could both be the state: keep one, or say which by",
        ),
        ("episode state action\n0 0 1\n0 1\n", "line 3: 2 fields, but the first line names more columns"),
        ("episode state action\n0 0 1 7\n", "line 2: 4 fields, but the first line names 3 columns"),
        (
            gzip.compress(b"episode,state,action\n0,0,1\n" * 99, mtime=0)[:-9],
            "its compressed contents are damaged or cut off",
        ),
        (b"\x89PNG\r\n\x1a\n\x00", "not a text file in UTF-8"),
    ],
)
def test_bad_lines_are_named(read, lines, message):
    with pytest.raises(FileError, match=re.escape(message)) as raised:
        read(lines)
    assert "steps.csv" in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("0,nwe,run", "line 2, column 'state': there is no state 'nwe'; did you mean 'new'"),
        ("0,new,jump", "line 2, column 'action': there is no action 'jump'"),
        ("0,3,run", "line 2, column 'state': must lie in [0, 3), got 3"),
        ('0,"(0, 2)",run', "line 2, column 'state': there is no state '(0, 2)'; did you mean (0, 1)?"),
        (f'0,"{"[" * 5000}",run', "line 2, column 'state': there is no state"),
    ],
)
def test_unknown_names_are_said_with_the_nearest(read, lines, message):
    with pytest.raises(FileError, match=re.escape(message)):
        read("episode,state,action\n" + lines + "\n", mdp=named_machine())


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"mood": "x"}, "columns: there is no role 'mood', but episode, step, state"),
        ({"state": "where"}, "columns['state']: there is no column 'where', but 'episode', 'state', 'action'"),
    ],
)
def test_bad_names_of_columns_are_refused(read, columns, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        read(text(","), columns=columns)


def test_many_lines_take_a_moment(read):
    """A hundred thousand lines in episodes of ten; a million take ten times as long."""
    rng = np.random.default_rng(0)
    states, actions = rng.integers(0, 100, (10_000, 10)), rng.integers(0, 4, (10_000, 10))
    steps = np.ndenumerate(states)
    lines = "episode,step,state,action\n" + "".join(f"{i},{t},{s},{actions[i, t]}\n" for (i, t), s in steps)
    start = time.process_time()
    demonstrations, _ = read(lines)
    assert time.process_time() - start < 3
    np.testing.assert_array_equal(demonstrations.states, states)
    np.testing.assert_array_equal(demonstrations.actions, actions)


def test_answers_in_any_delimiter_and_by_name(tmp_path):
    path = tmp_path / "said.csv"
    path.write_text("who; act; obs\nme; repair; worn out\nme; ; new\nme; 0; (0, 1)\n")
    states, actions = answers_from_csv(path, mdp=named_machine())
    assert (states.tolist(), actions.tolist()) == ([2, 1], [1, 0])
    append_answer(path, 0, 1, mdp=named_machine())
    assert path.read_text().splitlines()[-1] == ";1;0"
    states, actions = answers_from_csv(path, mdp=named_machine())
    assert (states.tolist(), actions.tolist()) == ([2, 1, 0], [1, 0, 1])


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_blank_lines_before_the_header_are_skipped(tmp_path, separator):
    path = tmp_path / "steps.csv"
    rows = [["episode", "state", "action"], ["0", "0", "1"]]
    path.write_text("\n  \n" + "\n".join(map(separator.join, rows)))
    demonstrations, _ = demonstrations_from_csv(path)
    assert demonstrations.states.tolist() == [[0]] and demonstrations.actions.tolist() == [[1]]
