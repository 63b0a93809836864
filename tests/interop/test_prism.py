"""PRISM's explicit files, small ones written here, against what they say."""

import gzip
import re

import numpy as np
import pytest
from small_models import dense_transition

from jaxhom.interop import FileError, from_prism

TRA = """4 5 7
0 0 1 0.5 go
0 0 2 0.5 go
0 1 0 1 stay
1 0 3 1 go
2 0 0 0.25 go
2 0 3 0.75 go
2 1 2 1 stay
"""
EXPECTED = np.zeros((4, 2, 4))
EXPECTED[0] = [[0, 0.5, 0.5, 0], [1, 0, 0, 0]]
EXPECTED[1, 0, 3] = EXPECTED[2, 1, 2] = EXPECTED[3, :, 3] = 1
EXPECTED[2, 0, [0, 3]] = 0.25, 0.75
STA = "(x,on)\n0:(0,true)\n1:(1,false)\n2:(1,true)\n3:(2,far)\n"
LAB = '0="init" 1="deadlock" 2="goal"\n0: 0\n2: 0\n3: 1 2\n'


def write(folder, **parts):
    for suffix, text in parts.items():
        (folder / f"m.{suffix}").write_text(text)
    return folder / "m"


def test_ragged_choices_deadlocks_names_and_labels(tmp_path):
    model = from_prism(write(tmp_path, tra=TRA, sta=STA, lab=LAB), discount=0.9)
    np.testing.assert_allclose(dense_transition(model.mdp), EXPECTED)
    assert model.mdp.allowed.tolist() == [[True, True], [True, False], [True, True], [True, True]]
    assert model.state_names == ((0, True), (1, False), (1, True), (2, "far")) and model.action_names == ("go", "stay")
    assert model.mdp.initial.tolist() == [0.5, 0, 0.5, 0] and model.terminal.tolist() == [False, False, False, True]
    assert {name: mask.nonzero()[0].tolist() for name, mask in model.labels.items()} == {
        "init": [0, 2],
        "deadlock": [3],
        "goal": [3],
    }
    assert model.reward is None
    assert model.remarks == ("names of states are the values of (x,on)", "1 state without actions: absorbing")


def test_files_by_suffix_compressed_and_alone(tmp_path):
    (tmp_path / "m.tra.gz").write_bytes(gzip.compress(TRA.encode()))
    for path in (tmp_path / "m", tmp_path / "m.tra", tmp_path / "m.tra.gz"):
        model = from_prism(path, discount=0.9)
        np.testing.assert_allclose(dense_transition(model.mdp), EXPECTED)
        assert model.state_names is None and model.mdp.initial.tolist() == [1, 0, 0, 0] and model.labels == {}
        assert model.remarks[0] == "no state is labelled init: episodes start in state 0"


def test_storms_files(tmp_path):
    tra = "MDP\n" + TRA.partition("\n")[2].replace(" go", "").replace(" stay", "")
    lab = "#DECLARATION\ninit goal\n#END\n\n2 init\n3 goal\n"
    model = from_prism(write(tmp_path, tra=tra, lab=lab), discount=0.9)
    np.testing.assert_allclose(dense_transition(model.mdp), EXPECTED)
    assert model.action_names is None and model.mdp.initial.tolist() == [0, 0, 1, 0]
    assert model.labels["goal"].tolist() == [False, False, False, True]


@pytest.mark.parametrize("header", ["3 4", "dtmc"])
def test_chains_have_one_action(tmp_path, header):
    model = from_prism(write(tmp_path, tra=f"{header}\n2 0 1\n0 1 0.5\n0 0 .5\n1 2 1e0 last\n"), discount=0.9)
    assert model.mdp.transition[:, 0].tolist() == [[0.5, 0.5, 0], [0, 0, 1], [1, 0, 0]]
    assert model.mdp.num_actions == 1


@pytest.mark.parametrize(
    ("row", "other"),
    [("0 1 0 1 stay", "0 1 0 1 go"), ("1 0 3 1 go", "1 0 3 1"), ("0 0 2 0.5 go", "0 0 2 0.5 by")],
)
def test_labels_that_are_not_one_for_each_choice_name_nothing(tmp_path, row, other):
    model = from_prism(write(tmp_path, tra=TRA.replace(row, other)), discount=0.9)
    np.testing.assert_allclose(dense_transition(model.mdp), EXPECTED)
    assert model.action_names is None
    assert "choices are numbered: their labels are not one for each choice of a state" in model.remarks


def test_labels_name_actions_whatever_their_places(tmp_path):
    """Choice 0 of state 1 is `stay`: the same action as choice 1 of state 0."""
    tra = "2 3 3\n0 0 1 1 go\n0 1 0 1 stay\n1 0 1 1 stay\n"
    model = from_prism(write(tmp_path, tra=tra), discount=0.9)
    assert model.mdp.allowed.tolist() == [[True, True], [False, True]]


def test_rewards_of_states_and_transitions(tmp_path):
    srew = '# Reward structure "time"\n4 2\n0 1.5\n2 -1\n'
    trew = "4 5 2\n0 0 2 10\n1 0 3 4\n"
    model = from_prism(write(tmp_path, tra=TRA, srew=srew, trew=trew), discount=0.9)
    np.testing.assert_allclose(model.reward, [[1.5 + 0.5 * 10, 1.5], [4, 0], [-1, -1], [0, 0]])
    for part in ("srew", "trew"):
        (tmp_path / f"m.{part}").rename(tmp_path / f"m1.{part}")
    (tmp_path / "m2.srew").write_text("4 0\n")
    again = from_prism(tmp_path / "m", discount=0.9)
    np.testing.assert_allclose(again.reward, model.reward)
    assert "the first of several reward structures is used" in again.remarks


def test_rewards_of_chains(tmp_path):
    model = from_prism(write(tmp_path, tra="2 3\n0 0 .5\n0 1 .5\n1 1 1\n", trew="2 1\n0 1 3\n"), discount=0.9)
    np.testing.assert_allclose(model.reward, [[1.5], [0]])


BAD = {
    "empty": ({"tra": ""}, "m.tra: it is empty"),
    "other kind": ({"tra": "ctmc\n0 0 1\n"}, "m.tra line 1: models of the kind 'ctmc' are not read"),
    "header": ({"tra": "states 3\n"}, "m.tra line 1: expected `states choices transitions`"),
    "no states": ({"tra": "0 0 0\n"}, "m.tra line 1: there must be one state at least, got 0"),
    "cut off": ({"tra": TRA[:-13]}, "m.tra: 6 transitions, but its first line says 7"),
    "short row": (
        {"tra": TRA.replace("1 0 3 1 go", "1 0 3")},
        "m.tra line 5: expected `state choice",
    ),
    "state": ({"tra": TRA.replace("1 0 3", "1 0 4")}, "m.tra line 5: next state must lie in [0, 4), got '4'"),
    "negative": ({"tra": TRA.replace("1 0 3", "1 -1 3")}, "m.tra line 5: choice must lie in [0, 2147483647), got '-1'"),
    "word": ({"tra": TRA.replace("1 0 3", "one 0 3")}, "m.tra line 5: state must be a whole number, got 'one'"),
    "huge": ({"tra": TRA.replace("1 0 3", f"{10**30} 0 3")}, "m.tra line 5: state must be a whole number, got '10000"),
    "number": ({"tra": TRA.replace("0.25", "x")}, "m.tra line 6: probability must be a number, got 'x'"),
    "underscore": ({"tra": TRA.replace("0.25", "0.2_5")}, "m.tra line 6: probability must be a number, got '0.2_5'"),
    "underscores of a state": ({"tra": TRA.replace("1 0 3", "1 0 0_3")}, "m.tra line 5: next state must be a whole"),
    "infinite": ({"tra": TRA.replace("0.25", "inf")}, "m.tra line 6: probability must be finite, got 'inf'"),
    "sum": (
        {"tra": TRA.replace("0.25", "0.5")},
        "m.tra: probabilities of action 'go' in state 2 must sum to 1",
    ),
    "rates": ({"tra": "2 2\n0 1 3\n1 0 2\n"}, "m.tra: probabilities of action 0 in state 0 must sum to 1, got 3"),
    "values": ({"tra": TRA, "sta": STA.replace("2:(", "5:(")}, "m.sta line 4: expected `2:(values)`, got '5:(1,true)'"),
    "few values": ({"tra": TRA, "sta": STA[:-10]}, "m.sta: 3 states, but the model has 4"),
    "twins": ({"tra": TRA, "sta": STA.replace("1,false", "0,true")}, "m.tra: state_names"),
    "label": ({"tra": TRA, "lab": LAB + "1: 7\n"}, "m.lab line 5: no label '7' among 0, 1, 2"),
    "labelled state": ({"tra": TRA, "lab": LAB + "9: 0\n"}, "m.lab line 5: must begin with a state below 4, got '9:'"),
    "no end": ({"tra": TRA, "lab": "#DECLARATION\ninit\n0 init\n"}, "m.lab: no #END of its #DECLARATION"),
    "rewards": ({"tra": TRA, "srew": "3 1\n0 1\n"}, "m.srew: the first line must begin with the number of states, 4"),
    "no rewards": ({"tra": TRA, "srew": ""}, "m.srew: the first line must begin with the number of states, 4"),
    "rewarded state": ({"tra": TRA, "srew": "4 1\n7 1\n"}, "m.srew line 2: state must lie in [0, 4), got '7'"),
    "reward": ({"tra": TRA, "trew": "4 5 1\n0 0 1 much\n"}, "m.trew line 2: reward must be a number, got 'much'"),
    "transition": ({"tra": TRA, "trew": "4 5 1\n0 1 1 3\n"}, "m.trew line 2: there is no transition 0 1 1"),
    "width": (
        {"tra": TRA, "trew": "4 5 1\n0 1 1\n"},
        "m.trew line 2: expected `state choice next reward`",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_by_line(tmp_path, case):
    parts, message = BAD[case]
    with pytest.raises(FileError, match=f"^{re.escape(str(tmp_path))}/{re.escape(message)}"):
        from_prism(write(tmp_path, **parts), discount=0.9)


def test_missing_files(tmp_path):
    with pytest.raises(FileError, match="none.tra: no such file"):
        from_prism(tmp_path / "none", discount=0.9)


@pytest.mark.parametrize("header", ["2 2 0", "2 0"])
def test_a_model_without_transitions_stays_where_it_is(tmp_path, header):
    (tmp_path / "none.tra").write_text(header + "\n")
    found = from_prism(tmp_path / "none.tra", discount=0.9)
    np.testing.assert_array_equal(found.mdp.transition[:, 0], np.eye(2))


def test_no_transitions_and_no_number_of_states(tmp_path):
    (tmp_path / "none.tra").write_text("mdp\n")
    with pytest.raises(FileError, match="no transitions, and does not say how many states"):
        from_prism(tmp_path / "none.tra", discount=0.9)


@pytest.mark.parametrize(("suffix", "lines"), [(".srew", ["0 5", "0 7"]), (".trew", ["0 1 5", "0 1 7"])])
def test_rewards_add_up_and_are_as_many_as_told(tmp_path, suffix, lines):
    (tmp_path / "pair.tra").write_text("2 2\n0 1 1\n1 0 1\n")
    rewards = tmp_path / f"pair{suffix}"
    rewards.write_text("\n".join(["2 2", *lines]))
    np.testing.assert_array_equal(from_prism(tmp_path / "pair", discount=0.9).reward, [[12.0], [0.0]])
    rewards.write_text("\n".join(["2 9", *lines]))
    with pytest.raises(FileError, match=rf"pair\{suffix}: 2 rewards, but its first line says 9"):
        from_prism(tmp_path / "pair", discount=0.9)
