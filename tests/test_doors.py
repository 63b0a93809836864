"""What people hand over and what used to be read wrongly without a word: one case of each kind."""

import re
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import jaxhom
from jaxhom import Demonstrations
from jaxhom.cli.options import environment_options
from jaxhom.cli.results import Results
from jaxhom.domains.track_maps import read_map
from jaxhom.interop import (
    demonstrations_from_csv,
    demonstrations_from_episodes,
    demonstrations_from_transitions,
    from_gymnasium,
    load_demonstrations,
    load_mdp,
    save_demonstrations,
    save_mdp,
)


def lengths(demonstrations):
    return np.asarray(demonstrations.mask).sum(axis=1).tolist()


# ------------------------------------------------------------------------------------------ episodes


def test_truncated_episodes_are_cut_where_observations_do_not_follow():
    """Two episodes of a library whose `dones` are False at a truncation, and one that terminated."""
    obs, next_obs = [0, 1, 5, 6, 2], [1, 2, 6, 7, 3]
    dones = [False, False, False, False, True]
    demonstrations, report = demonstrations_from_transitions(np.array(obs), np.zeros(5, int), next_obs, dones)
    assert lengths(demonstrations) == [2, 2, 1] and report.final_observations == 3
    assert np.asarray(demonstrations.terminated).tolist() == [False, False, True]
    assert np.asarray(demonstrations.final_states).tolist() == [2, 7, 3]


def test_transitions_with_other_observations():
    one_hot = np.eye(4)[[0, 1, 3]]
    found, _ = demonstrations_from_transitions(
        one_hot, [0, 0, 1], np.eye(4)[[1, 2, 3]], [False] * 3, to_states=lambda obs: obs.argmax(axis=-1)
    )
    assert lengths(found) == [2, 1]
    with pytest.raises(ValueError, match=r"dones must have shape \(3, \.\.\.\) like observations"):
        demonstrations_from_transitions(one_hot, [0, 0, 1], one_hot, [False])


@pytest.mark.parametrize("read", [Demonstrations.from_trajectories, demonstrations_from_episodes])
def test_two_steps_are_not_a_pair_of_sequences(read):
    with pytest.raises(ValueError, match=r"0 could be \(states, actions\) or two steps \(state, action\)"):
        read([[(3, 1), (4, 0)]])
    read([([3, 4], [1, 0])])


def test_episodes_say_how_they_ended():
    episodes = [SimpleNamespace(obs=[0, 1, 2], acts=[0, 0], terminal=end) for end in (True, False)]
    demonstrations, _ = demonstrations_from_episodes(episodes)
    assert np.asarray(demonstrations.terminated).tolist() == [True, False]


# ------------------------------------------------------------------------------------------ CSV files


def write(tmp_path, text):
    path = tmp_path / "steps.csv"
    path.write_text(text)
    return path


def test_a_step_column_is_the_order(tmp_path):
    path = write(tmp_path, "episode,step,state,action\na,2,12,1\na,0,10,0\nb,5,7,1\na,1,11,0\na,3,13,\n")
    demonstrations, _ = demonstrations_from_csv(path)
    assert np.asarray(demonstrations.states)[0, :3].tolist() == [10, 11, 12]
    assert np.asarray(demonstrations.final_states).tolist() == [13, -1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("episode,t,state,action\na,1,0,0\na,1,1,0\n", "lines 2 and 3: step 1 occurs twice in its episode"),
        ("episode,time,state,action\na,x,0,0\n", "line 2, column 'time': must be a whole number, got 'x'"),
        ("episode,state,action\na,0,0,7\n", "line 2: 4 fields, but the first line names 3 columns"),
        ("episode,t,step,state,action\na,0,0,0,0\n", "columns 't' and 'step' could both number the steps"),
    ],
)
def test_files_that_mean_nothing_clear_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations_from_csv(write(tmp_path, text))


# ------------------------------------------------------------------------------------------ environments


def environment(table, **options):
    return SimpleNamespace(P=table, initial_state_distrib=np.eye(len(table))[0], **options)


def test_a_state_without_rows_absorbs():
    model = from_gymnasium(environment({0: {0: [(1.0, 1, 5.0, True)]}, 1: {0: []}}), discount=0.9)
    assert np.asarray(model.terminal).tolist() == [False, True]
    np.testing.assert_allclose(jaxhom.optimal_policy(model, model.reward).value, [5, 0])


def test_actions_that_a_state_lacks_are_not_allowed():
    stay = {a: [(1.0, s, float(a), False)] for s, a in ((0, 0), (0, 1))}
    model = from_gymnasium(environment({0: stay, 1: {1: [(1.0, 0, 2.0, False)]}}), discount=0.5)
    assert np.asarray(model.mdp.allowed).tolist() == [[True, True], [False, True]]
    plan = jaxhom.optimal_policy(model, model.reward)
    np.testing.assert_allclose(plan.value, [2, 3])
    assert plan.policy[1, 1] == 1


def test_an_option_outside_the_table_is_refused():
    with pytest.raises(ValueError, match="fickle_passenger=True, which its table P does not contain"):
        from_gymnasium(gymnasium.make("Taxi-v4", fickle_passenger=True), discount=0.9)


def test_words_are_what_they_say():
    words = ["a=no", "b=Yes", "c=off", "d=(1, 2)", "e=[1, 2]", "f=8x8", "g=0.5", "h=None", "i=True"]
    expected = {"a": False, "b": True, "c": False, "d": (1, 2), "e": [1, 2], "f": "8x8", "g": 0.5, "h": None, "i": True}
    assert environment_options(words) == expected


# ------------------------------------------------------------------------------------------ files


def test_files_keep_missing_actions_and_ends(tmp_path):
    allowed = np.array([[True, False], [True, True]])
    transition = np.broadcast_to(np.eye(2)[:, None], (2, 2, 2))
    mdp = jaxhom.MDP.from_dense(transition, discount=0.9, allowed=allowed)
    save_mdp(tmp_path / "model.npz", mdp)
    np.testing.assert_array_equal(load_mdp(tmp_path / "model.npz").allowed, allowed)
    given = Demonstrations.from_trajectories([([0, 0, 1], [0, 0]), ([1], [1])], terminated=[True, False])
    save_demonstrations(tmp_path / "walks.npz", given)
    read = load_demonstrations(tmp_path / "walks.npz")
    for name in ("states", "actions", "mask", "terminated", "final_states"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))


def test_obstacles_potholes_and_what_is_out_of_bounds():
    assert read_map(["@@@@@", "S.oPF", "@@@@@"]) == ("#####", "S.#.F", "#####")


def test_an_output_of_another_kind_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"p\.csv: policies are written to \.npz files"):
        Results(str(tmp_path / "p.csv"))
    assert not (tmp_path / "p.csv").exists()
