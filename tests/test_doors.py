"""What people hand over and what used to be read wrongly without a word: one case of each kind."""

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
    from_gymnasium,
    load_demonstrations,
    load_mdp,
    save_demonstrations,
    save_mdp,
)

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
