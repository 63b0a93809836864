"""Models from tables of transitions and of next states, in every form that such tables have."""

import gzip
import re

import numpy as np
import pandas
import pytest
from small_models import dense_transition

from jaxhom.interop import FileError, from_table, text_tables

ROWS = [  # state, action, next state, probability, reward
    ("hall", "left", "hall", 0.25, 1.0),
    ("hall", "left", "room", 0.75, 5.0),
    ("hall", "right", "door", 1.0, -2.0),
    ("room", "left", "hall", 1.0, 0.5),
]
COLUMNS = ("state", "action", "next_state", "probability", "reward")
NAMES = ("door", "hall", "room")
TRANSITION = np.zeros((3, 2, 3))
TRANSITION[0, :, 0] = TRANSITION[1, 1, 0] = TRANSITION[2, 0, 1] = 1
TRANSITION[1, 0, 1:] = 0.25, 0.75
REWARD = [[0, 0], [4, -2], [0.5, 0]]


def frame(rows=ROWS, columns=COLUMNS):
    return pandas.DataFrame(rows, columns=columns)


def numbered():
    data = frame()
    for column in ("state", "next_state"):
        data[column] = data[column].map(NAMES.index)
    return data.assign(action=data["action"].map(["left", "right"].index))


def written(folder, text, name="table.csv"):
    path = folder / name
    path.write_text(text)
    return path


FORMS = {
    "frame": lambda folder: frame(),
    "mapping": lambda folder: frame().to_dict("list"),
    "shuffled": lambda folder: frame().iloc[[2, 0, 3, 1], [4, 2, 0, 1, 3]],
    "file": lambda folder: written(folder, frame().to_csv(index=False)),
    "semicolons": lambda folder: written(folder, frame().to_csv(index=False, sep=";")),
    "tabs and blank lines": lambda folder: written(folder, frame().to_csv(index=False, sep="\t") + "\n \n"),
    "Windows": lambda folder: written(folder, frame().to_csv(index=False, lineterminator="\r\n")),
    "quotes": lambda folder: written(folder, frame().to_csv(index=False, quoting=1)),
    "next": lambda folder: written(folder, frame().to_csv(index=False).replace("next_state", "Next")),
    "blanks": lambda folder: written(folder, frame().to_csv(index=False).replace(",", " , ")),
    "one row in two": lambda folder: frame([*ROWS[2:], ROWS[0], *[(*ROWS[1][:3], 0.375, r) for r in (4.0, 6.0)]]),
}


@pytest.mark.parametrize("form", FORMS)
def test_all_forms_give_the_same_model(tmp_path, form, monkeypatch):
    monkeypatch.setattr(text_tables, "_CHUNK", 2)
    model = from_table(FORMS[form](tmp_path), discount=0.9)
    np.testing.assert_allclose(dense_transition(model.mdp), TRANSITION)
    np.testing.assert_allclose(model.reward, REWARD)
    assert model.state_names == NAMES and model.action_names == ("left", "right")
    assert model.mdp.allowed.tolist() == [[True, True], [True, True], [True, False]]
    assert model.terminal.tolist() == [True, False, False] and model.mdp.initial.tolist() == [0, 0.5, 0.5]
    assert model.remarks == ("1 state without actions: absorbing",)


@pytest.mark.parametrize("kind", [int, float, np.int32])
def test_numbers_without_gaps_are_no_names(tmp_path, kind):
    data = numbered()
    data = data.astype({"state": kind, "action": kind, "next_state": kind})
    for table in (data, written(tmp_path, data.to_csv(index=False))):
        model = from_table(table, discount=0.9)
        np.testing.assert_allclose(dense_transition(model.mdp), TRANSITION)
        assert model.state_names is None and model.action_names is None


def test_numbers_with_gaps_are_names_in_ascending_order():
    model = from_table({"state": [30, 7], "action": [1, 1], "next": [7, 30]}, discount=0.9)
    assert model.state_names == (7, 30) and model.action_names == (1,)
    assert model.mdp.transition[:, 0].tolist() == [[0, 1], [1, 0]] and model.reward is None


def test_whole_numbers_are_in_the_order_of_numbers(tmp_path):
    """Also as floats, which programs make of columns that once had gaps."""
    rows = "".join(f"{state}.0,0,{(state + 1) % 12}.0\n" for state in range(12))
    model = from_table(written(tmp_path, f"state,action,next\n{rows}"), discount=0.9)
    assert model.state_names is None and model.mdp.transition[:, 0].argmax(axis=-1).tolist() == [*range(1, 12), 0]
    for other in ("0.5", "1e300", "inf"):  # no numbers of states, but names
        names = from_table(written(tmp_path, f"state,action,next\n0,0,{other}\n"), discount=0.9).state_names
        assert names == ("0", other)


def test_names_with_underscores_are_no_numbers(tmp_path):
    table = written(tmp_path, "state,action,next\n1_12,0,11_2\n11_2,0,1_12\n")
    assert from_table(table, discount=0.9).state_names == ("11_2", "1_12")


def test_tables_of_the_robust_kind_and_columns_of_other_names(tmp_path):
    names = ("idstatefrom", "idaction", "idstateto", "probability", "reward")
    text = numbered().set_axis(names, axis=1).to_csv(index=False)
    np.testing.assert_allclose(from_table(written(tmp_path, text), discount=0.9).reward, REWARD)
    other = frame(columns=("from", "by", "to", "p", "gain")).assign(note="-")
    columns = {"state": "from", "action": "by", "next_state": "to", "probability": "p", "reward": "gain"}
    for table in (other, written(tmp_path, other.to_csv(index=False), "other.csv")):
        model = from_table(table, discount=0.9, columns=columns)
        np.testing.assert_allclose(model.reward, REWARD)
        assert model.remarks[0] == "ignored: 'note'"


def test_compressed_files(tmp_path):
    path = tmp_path / "table.csv.gz"
    path.write_bytes(gzip.compress(frame().to_csv(index=False).encode()))
    np.testing.assert_allclose(from_table(path, discount=0.9).reward, REWARD)


@pytest.mark.parametrize("form", ["list", "array", "file"])
def test_tables_of_next_states(tmp_path, form):
    rows = [[1, -1], [0, 2], [-1, -1]]
    text = "\n".join(",".join(map(str, row)) for row in rows)
    table = {"list": rows, "array": np.array(rows, np.int32), "file": written(tmp_path, text)}[form]
    model = from_table(table, discount=0.9)
    assert model.mdp.allowed.tolist() == [[True, False], [True, True], [True, True]]
    assert np.asarray(model.mdp.next_state).max(axis=-1, initial=0).shape == (3, 2)
    np.testing.assert_array_equal(
        dense_transition(model.mdp)[[0, 1, 1, 2, 2], [0, 0, 1, 0, 1]], np.eye(3)[[1, 0, 2, 2, 2]]
    )
    assert model.terminal.tolist() == [False, False, True]


HEAD = "state,action,next,probability,reward\n"
BAD = {
    "": "line 1: expected the names of the columns",
    "state,action\n0,0\n": "column 'next_state' or 'next' or 'idstateto' is missing; it has 'state', 'action'",
    "state,idstatefrom,action,next\n0,0,0,0\n": "columns 'state' and 'idstatefrom' could both be the state",
    HEAD: "it has no rows",
    HEAD + "0,0,0,1\n": "line 2: expected 5 fields, as many as the first line has, got '0 0 0 1'",
    HEAD + "0,0,0,1,2\n\n0,1,0,1,2,3\n": "line 4: expected 5 fields",
    HEAD + "0,0,0,0_1,2\n": "line 2: column 'probability' must be a number, got '0_1'",
    HEAD + "0,0,0,one,2\n": "line 2: column 'probability' must be a number, got 'one'",
    HEAD + "0,0,0,1,2\n0,1,0,1,nan\n": "line 3: column 'reward' must be finite, got 'nan'",
    HEAD + "0,0,0,1,2\n,1,0,1,2\n": "line 3: column 'state' is empty",
    HEAD + "a,go,a,0.5,0\na,go,b,0.4,0\nb,go,b,1,0\n": "probabilities of action 'go' in state 'a' must sum to 1",
    HEAD + "0,0,0,1.5,0\n0,0,1,-0.5,0\n": "probabilities of action 0 in state 0, column 1 must not be negative",
    HEAD + '0,0,"0,1,2\n': "line 2: unexpected end of data",
    "state,action,next\n0,0,0\n0,0,1\n": "probabilities of action 0 in state 0 must sum to 1, got 2.0",
    "0,1\n0,7\n": "line 2: column 2 must lie in [-1, 2), got '7'",
    "0,1\n0,-2\n": "line 2: column 2 must lie in [-1, 2), got '-2'",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_files_are_refused_by_line(tmp_path, text):
    path = written(tmp_path, text)
    with pytest.raises(FileError, match=f"^{re.escape(str(path))}.*{re.escape(BAD[text])}"):
        from_table(path, discount=0.9)


@pytest.mark.parametrize(
    ("table", "columns", "message"),
    [
        (frame(), {"source": "state"}, "columns: no 'source' among state, action, next_state, probability, reward"),
        (frame(), {"state": "from"}, "column 'from' is missing"),
        ({"state": [0], "action": [0]}, None, "column 'next_state' or 'next' or 'idstateto' is missing"),
        ({"state": [0, 0], "action": [0, 1], "next": [0]}, None, r"column 'next_state' must have shape \(2,\)"),
        ({"state": 0, "action": 0, "next": 0}, None, r"column 'state' must have shape \[N\], got \(\)"),
        ({"state": [0.5], "action": [0], "next": [0]}, None, r"column 'state'\[0\] must be a whole number, got 0.5"),
        ({"state": [1e300], "action": [0], "next": [0]}, None, r"column 'state'\[0\] must be a whole number"),
        (frame().assign(action=pandas.NA), None, r"column 'action'\[0\] is missing"),
        (frame(), ["state"], r"columns must be a mapping, got \['state'\]"),
        ({"state": ["a", None], "action": [0, 0], "next": ["a", "a"]}, None, r"column 'state'\[1\] is missing"),
        (frame().assign(reward="much"), None, "column 'reward' must hold real numbers"),
        (frame().assign(probability=np.nan), None, r"column 'probability'\[0\] must be finite"),
        ([1, 2], None, r"table must have shape \[S, A\] \(or it must have columns by name\)"),
        ([[0.5]], None, r"table\[0, 0\] must be whole"),
        ([[2], [0]], None, r"table\[0, 0\] must be below 2"),
        ([[-2]], None, r"table\[0, 0\] must not be negative, got -2"),
        ([["a"]], None, "table must hold real numbers"),
    ],
)
def test_bad_tables_are_refused(table, columns, message):
    with pytest.raises(ValueError, match=message):
        from_table(table, discount=0.9, columns=columns)


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        (["01,go,02", "02,go,goal"], ("1", "2", "goal")),
        (["1.0,go,2.0", "2.0,go,goal"], ("1", "2", "goal")),
        (["a,go,02", "02,go,a"], ("02", "a")),  # neither column is of numbers
    ],
)
def test_a_number_is_the_same_state_however_it_is_written(tmp_path, rows, names):
    path = tmp_path / "chain.csv"
    path.write_text("\n".join(["state,action,next", *rows]))
    found = from_table(path, discount=0.9)
    assert found.state_names == names
    reached = np.asarray(found.mdp.transition)[:, 0].argmax(axis=1)
    assert [names[n] for n in reached] == [*names[1:], names[-1] if len(names) == 3 else names[0]]


def test_a_number_is_the_same_state_in_a_frame():
    frame = {"state": [1.0, 2.0], "action": ["a", "a"], "next": ["2.0", "goal"]}
    assert from_table(frame, discount=0.9).state_names == ("1", "2", "goal")


def test_a_blank_first_field_beside_quotes_is_a_field(tmp_path):
    path = tmp_path / "noted.csv"
    path.write_text('note,state,action,next\n"x, y",0,a,1\n ,1,a,0\n')
    transition = from_table(path, discount=0.9).mdp.transition
    np.testing.assert_array_equal(transition, [[[0.0, 1.0]], [[1.0, 0.0]]])


def test_only_line_ends_end_lines(tmp_path):
    path = tmp_path / "odd.csv"
    path.write_text("state,action,next\r\n0,a\u2028b,1\r\n1,a\u2028b,0\r\n", encoding="utf-8")
    assert from_table(path, discount=0.9).action_names == ("a\u2028b",)


def test_a_next_state_out_of_range_is_named_by_line_and_column(tmp_path):
    path = tmp_path / "next.csv"
    path.write_text("1,2\n0,3\n2,2\n")
    with pytest.raises(FileError, match=r"line 2: column 2 must lie in \[-1, 3\), got '3'"):
        from_table(path, discount=0.9)
