"""Demonstrations from the objects of other libraries, from arrays and from CSV files."""

import dataclasses
import re
import time
import types
from typing import NamedTuple

import numpy as np
import pytest

from jaxhom.interop import (
    FileError,
    ImportReport,
    demonstrations_from_csv,
    demonstrations_from_episodes,
    demonstrations_from_steps,
    demonstrations_from_transitions,
)
from jaxhom.models.demonstrations import Demonstrations

# What is meant: two episodes, which ended in states 4 and 1.
EPISODES = [([0, 2, 2, 4], [1, 0, 1]), ([3, 1], [0])]


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """The fields of `imitation`'s trajectories."""

    obs: np.ndarray
    acts: np.ndarray
    infos: np.ndarray | None
    terminal: bool

    def __len__(self):
        return len(self.acts)


class EpisodeData(NamedTuple):
    """The fields of Minari's episodes."""

    id: int
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray


def imitation(obs, acts):
    return Trajectory(np.asarray(obs), np.asarray(acts), None, True)


def minari(obs, acts, terminated=False):
    ends = np.arange(len(acts)) == len(acts) - 1
    flags = ends & terminated, ends & (not terminated)
    return EpisodeData(7, np.asarray(obs), np.asarray(acts), np.zeros(len(acts)), *flags)


def trajectories(demonstrations):
    """What `Demonstrations` holds, as lists without padding."""
    arrays = (np.asarray(array) for array in (demonstrations.states, demonstrations.actions, demonstrations.mask))
    return [(states[mask].tolist(), actions[mask].tolist()) for states, actions, mask in zip(*arrays, strict=True)]


EXPECTED = [(states[:-1], actions) for states, actions in EPISODES]
FLAT = types.SimpleNamespace(  # the fields of `imitation`'s transitions
    obs=np.array([0, 2, 3, 3, 2]),
    acts=np.array([1, 0, 0, 1, 0]),
    infos=np.array([{}] * 5),
    next_obs=np.array([2, 4, 3, 1, 0]),
    dones=np.array([False, True, False, False, False]),
)
DATA_SETS = {
    "imitation": lambda: [imitation(*episode) for episode in EPISODES],
    "minari": lambda: (minari(*episode) for episode in EPISODES),
    "minari data set": lambda: types.SimpleNamespace(iterate_episodes=lambda: iter([minari(*e) for e in EPISODES])),
    "mappings": lambda: [{"obs": observations, "acts": actions, "rews": [0.0]} for observations, actions in EPISODES],
    "pairs": lambda: EPISODES,
    "columns": lambda: [(np.array(o)[:, None], np.array(a, float)[:, None]) for o, a in EPISODES],
    "lists of arrays": lambda: [([np.array(o) for o in observations], actions) for observations, actions in EPISODES],
}


@pytest.mark.parametrize("name", DATA_SETS)
def test_episodes_of_every_kind(name):
    demonstrations, report = demonstrations_from_episodes(DATA_SETS[name]())
    assert trajectories(demonstrations) == EXPECTED
    assert report == ImportReport(episodes=2, steps=4, final_observations=2, dropped=())


def test_episodes_without_their_final_observation():
    demonstrations, report = demonstrations_from_episodes([imitation(*episode) for episode in EXPECTED])
    assert trajectories(demonstrations) == EXPECTED
    assert report.final_observations == 0


def test_episodes_say_how_they_ended():
    timed_out = dataclasses.replace(imitation([0, 1], [0]), infos=np.array([{"TimeLimit.truncated": True}]))
    episodes = [
        imitation([0, 1], [0]),
        timed_out,
        minari([0, 1], [0], terminated=True),
        minari([0, 1], [0]),
        ([0, 2], [0]),
        ([0], [0]),
    ]
    demonstrations, _ = demonstrations_from_episodes(episodes)
    np.testing.assert_array_equal(demonstrations.terminated, [True, False, True, False, False, False])
    np.testing.assert_array_equal(demonstrations.final_states, [1, 1, 1, 1, 2, -1])


def test_one_hot_observations_need_to_states():
    episodes = [minari(np.eye(5)[observations], actions) for observations, actions in EPISODES]
    with pytest.raises(ValueError, match=r"episode 0: observations must have shape \[H\].*got \(4, 5\); to_states"):
        demonstrations_from_episodes(episodes)
    demonstrations, _ = demonstrations_from_episodes(episodes, to_states=lambda obs: obs.argmax(axis=-1))
    assert trajectories(demonstrations) == EXPECTED


def test_to_states_sees_observations_as_they_are_stored():
    episodes = [([{"row": o // 3, "column": o % 3} for o in obs], acts) for obs, acts in EPISODES]
    demonstrations, _ = demonstrations_from_episodes(
        episodes, to_states=lambda observations: [3 * o["row"] + o["column"] for o in observations]
    )
    assert trajectories(demonstrations) == EXPECTED


@pytest.mark.parametrize(
    ("episode", "reason"),
    [
        (([], []), "it has no actions"),
        (([4], []), "it has no actions"),
        (([4], np.zeros(0, complex)), "it has no actions"),
        (([0, 1, 2], [0]), "1 actions need as many observations or one more, got 3"),
        (([0], [0, 1]), "2 actions need as many observations or one more, got 1"),
        (([0.5, 1], [0]), "observations[0] must be whole, got 0.5"),
        (([0, np.nan], [0]), "observations[1] must be whole, got nan"),
        (([0, -1], [0]), "observations[1] must not be negative, got -1"),
        (([0, 2**31], [0]), "observations[1] must be below 2147483647, got 2147483648"),
        (([0, 2**70], [0]), "observations must be whole numbers, got dtype object; to_states"),
        ((["a", "b"], [0]), "observations[0]: must be a whole number, got 'a'; to_states"),
        (([[0, 1], [2]], [0]), "observations is not a rectangular array"),
        ((np.zeros((2, 3)), [0]), "observations must have shape [H] or [H, 1], got (2, 3); to_states"),
        (([0, 1], [1.5]), "actions[0] must be whole, got 1.5"),
        (([0, 1], [[0.0, 1.0]]), "actions must have shape [H] or [H, 1], got (1, 2)"),
        (([0, 1], [True]), "actions must be whole numbers, got dtype bool"),
        ((5, [0]), "observations must have shape [H] or [H, 1], got ()"),
    ],
)
def test_unusable_episodes_are_dropped_and_reported(episode, reason):
    demonstrations, report = demonstrations_from_episodes([EPISODES[0], episode, EPISODES[1]])
    assert trajectories(demonstrations) == EXPECTED
    ((position, said),) = report.dropped
    assert position == 1 and said.startswith(reason)
    assert str(report).splitlines() == [
        "2 episodes, 4 steps; 2 final observations",
        f"episode 1 dropped: {said}",
    ]
    with pytest.raises(ValueError, match=re.escape(f"none of 1 episodes can be used; episode 0: {reason}")):
        demonstrations_from_episodes([episode])


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "there are no episodes"),
        (None, "episodes must be a sequence of episodes, got NoneType"),
        (
            [EPISODES[0], 3],
            "episode 1 must have obs and acts, or observations and actions, or be a pair of them; got int",
        ),
        ([([0], [0], [0.0])], "episode 0 must have obs and acts"),
        ([{"obs": [0, 1], "moves": [0]}], "episode 0 must have obs and acts"),
        ([[(3, 1), (4, 0)]], "episode 0 could be (states, actions) or two steps (state, action)"),
        ([[[3, 1], [4, 0]]] * 3, "episode 0 could be (states, actions) or two steps"),
        ([[(3, 1), (4, 0), (2, 2)]], "episode 0 must have obs and acts"),
        (imitation([0, 1], [0]), "pass a list of episodes, or, if these are flattened transitions, use"),
        (FLAT, "flattened transitions, use demonstrations_from_transitions"),
        ([FLAT], "episode 0 ends before its last step (dones): if these are flattened transitions"),
        ([vars(FLAT) | {"dones": None}], "episode 0 jumps: a next observation is not that of the next step: if"),
        ([vars(FLAT) | {"dones": None, "next_obs": None, "timeouts": [1, 0, 0, 0, 0]}], "its last step (timeouts)"),
    ],
)
def test_what_is_no_episode_is_an_error(episodes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations_from_episodes(episodes)


# ------------------------------------------------------------------------------------ flat arrays


def test_transitions_are_cut_where_an_episode_ended_or_was_cut_off():
    """Three episodes: one terminated in 4, one was cut off in 1, one goes on at the end of the recording."""
    demonstrations, report = demonstrations_from_transitions(FLAT.obs, FLAT.acts, FLAT.next_obs, FLAT.dones)
    assert trajectories(demonstrations) == [([0, 2], [1, 0]), ([3, 3], [0, 1]), ([2], [0])]
    np.testing.assert_array_equal(demonstrations.terminated, [True, False, False])
    np.testing.assert_array_equal(demonstrations.final_states, [4, 1, 0])
    assert report == ImportReport(episodes=3, steps=5, final_observations=3, dropped=())


def test_transitions_give_trajectories_back():
    """Random episodes, flattened as `imitation` does it: `dones` only where one terminated."""
    rng = np.random.default_rng(3)
    lengths = rng.integers(1, 6, size=40)
    states = [np.arange(n + 1) + 10 * i for i, n in enumerate(lengths)]  # no episode begins where another ended
    actions = [rng.integers(0, 4, size=n) for n in lengths]
    terminated = rng.random(40) < 0.5
    obs, next_obs = (np.concatenate([s[part] for s in states]) for part in (slice(-1), slice(1, None)))
    dones = np.concatenate([(np.arange(n) == n - 1) & end for n, end in zip(lengths, terminated, strict=True)])
    arguments = np.eye(410)[obs], np.concatenate(actions)[:, None], np.eye(410)[next_obs], dones
    demonstrations, _ = demonstrations_from_transitions(*arguments, to_states=lambda obs: obs.argmax(axis=-1))
    expected = Demonstrations.from_trajectories(list(zip(states, actions, strict=True)), terminated)
    for name in ("states", "actions", "mask", "terminated", "final_states"):
        np.testing.assert_array_equal(getattr(demonstrations, name), getattr(expected, name))


def test_a_cut_that_cannot_be_seen_can_be_told():
    flat = [0, 1, 1], [0, 0, 0], [1, 1, 0]
    demonstrations, _ = demonstrations_from_transitions(*flat, [0, 0, 1])
    assert trajectories(demonstrations) == [([0, 1, 1], [0, 0, 0])]
    demonstrations, _ = demonstrations_from_transitions(*flat, [0, 0, 1], truncated=[False, True, True])
    assert trajectories(demonstrations) == [([0, 1], [0, 0]), ([1], [0])]
    assert not np.any(demonstrations.terminated)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": []}, "observations must have shape (0, ...) like observations, T >= 1, got (0,)"),
        ({"actions": [0]}, "actions must have shape (2, ...) like observations"),
        ({"next_observations": [[1], [0]]}, "next_observations must have shape (2,) like observations, got (2, 1)"),
        ({"dones": [[0], [1]]}, "dones must have shape (2,) like observations, got (2, 1)"),
        ({"dones": [0, 2]}, "dones[1] must be True or False, got 2"),
        ({"truncated": ["no", "yes"]}, "truncated must be bool, got dtype <U3"),
    ],
)
def test_bad_transitions_are_refused(changes, message):
    good = {"observations": [0, 1], "actions": [0, 0], "next_observations": [1, 0], "dones": [0, 1]}
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations_from_transitions(**good | changes)


@pytest.mark.parametrize("ids", [[5, 5, 3, 5], ["b", "b", "a", "b"], [0.5, 0.5, 0.1, 0.5]])
def test_steps_are_grouped_in_the_order_in_which_episodes_begin(ids):
    demonstrations, report = demonstrations_from_steps(ids, [0, 2, 3, 2], [1, 0, 0, 1])
    assert trajectories(demonstrations) == EXPECTED
    assert report == ImportReport(episodes=2, steps=4, final_observations=0, dropped=())


def test_steps_with_flags_of_last_steps():
    done = np.array([False, False, True, True])
    demonstrations, _ = demonstrations_from_steps(np.cumsum(done) - done, [[0], [2], [2], [3]], [1, 0, 1, 0])
    assert trajectories(demonstrations) == EXPECTED


def test_steps_that_cannot_be_used_drop_their_episode():
    demonstrations, report = demonstrations_from_steps([0, 1, 2, 1], [0.0, 1.0, 2.0, 0.5], [0, 0, 0, 0])
    assert trajectories(demonstrations) == [([0], [0]), ([2], [0])]
    assert report.dropped == ((1, "observations[1] must be whole, got 0.5"),)


def test_two_million_steps_in_a_moment():
    rng = np.random.default_rng(0)
    states, actions = rng.integers(0, 1000, size=2_000_000), rng.integers(0, 4, size=2_000_000)
    start = time.process_time()
    demonstrations, report = demonstrations_from_steps(np.arange(2_000_000) // 1000, states, actions)
    assert time.process_time() - start < 5
    assert report.steps == 2_000_000
    np.testing.assert_array_equal(demonstrations.states, states.reshape(2000, 1000))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (([], [], []), "episode must have shape [T] with T >= 1, got (0,)"),
        (([[0]], [0], [0]), "episode must have shape [T] with T >= 1, got (1, 1)"),
        (([0, 0], [0], [0, 0]), "observations must have shape (2, ...) like episode, T >= 1, got (1,)"),
        (([0, 0], [0, 0], [0]), "actions must have shape (2, ...) like episode, T >= 1, got (1,)"),
        (([0, None], [0, 0], [0, 0]), "episode[1] is missing"),
        (([0, 0], 3, [0, 0]), "observations must have shape (2, ...) like episode, T >= 1, got ()"),
    ],
)
def test_bad_columns_are_refused(columns, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations_from_steps(*columns)


# ------------------------------------------------------------------------------------------- CSV


@pytest.fixture
def read(tmp_path):
    """Writes a text to a file and reads demonstrations from it."""

    def read(text):
        path = tmp_path / "steps.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return demonstrations_from_csv(path)

    return read


@pytest.mark.parametrize(
    "text",
    [
        "episode,state,action\n0,0,1\n0,2,0\n0,2,1\n1,3,0\n",
        "episode,state,action\r\nfirst,0,1\r\nfirst,2,0\r\nfirst,2,1\r\nsecond,3,0",
        '\ufeffState , reward,"action",EPISODE\n0,0.5,1,x\n3,,0,y\n2,0.5,0,x\n\n2,0.5,1,x\n',
        "episode,state,action\na,0.0,1.0\na,2e0,0\na, 2 ,1\nb,3,0\n",
    ],
)
def test_csv_files(read, text):
    demonstrations, report = read(text)
    assert trajectories(demonstrations) == EXPECTED
    unread = ("reward",) if "reward" in text else ()
    assert report == ImportReport(episodes=2, steps=4, final_observations=0, dropped=(), unread=unread)


def test_csv_lines_without_action_are_final_observations(read):
    demonstrations, report = read("episode,state,action\n0,0,1\n1,9,\n0,2,0\n0,2,1\n0,4,\n2,3,0\n2,1, \n")
    assert trajectories(demonstrations) == EXPECTED
    assert report == ImportReport(episodes=2, steps=4, final_observations=2, dropped=(("1", "it has no actions"),))
    np.testing.assert_array_equal(demonstrations.final_states, [4, 1])


@pytest.mark.parametrize("column", ["step", "T", " time", "timestep"])
def test_csv_lines_are_sorted_by_their_step(read, column):
    demonstrations, report = read(f"{column},episode,state,action\n7,a,2,1\n9,a,4,\n0,b,3,0\n5,a,2,0\n2.0,a,0,1\n")
    assert trajectories(demonstrations) == EXPECTED
    np.testing.assert_array_equal(demonstrations.final_states, [4, -1])
    assert report.final_observations == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: column 'state' is missing; the first line must name the columns, got nothing"),
        ("0,0,1\n", "line 1: column 'state' is missing; the first line must name the columns, got '0', '0', '1'"),
        (
            "state,action\n0,1\n",
            "line 1: column 'episode' is missing, and so is whatever else would tell episodes apart",
        ),
        ('"epi\nsode",state,action\n0,0,1\n', "column 'episode' is missing"),
        ("episode,state\n0,0\n", "line 1: column 'action' is missing"),
        ("episode,state,state,action\n", "line 1: columns 'state' and 'state' could both be the state: keep one"),
        ("episode,state,action\n", "there are no episodes"),
        ("episode,state,action\n0,1,\n", "none of 1 episodes can be used; episode 0: it has no actions"),
        ("episode,state,action\n0,0,1\n0,2\n", "line 3: 2 fields, but the first line names more columns"),
        ("episode,state,action\n,0,1\n", "line 2, column 'episode': is empty"),
        ("episode,state,action\n0,0,1\n0,2,1,7\n", "line 3: 4 fields, but the first line names 3 columns"),
        ("episode,state,action,t\n0,0,1,1\n0,2,1,0\n0,2,1,1\n", "lines 2 and 4: step 1 occurs twice in its episode"),
        ("episode,state,action,t\n0,0,1,noon\n", "line 2, column 't': must be a whole number, got 'noon': the column"),
        ("episode,state,action,t\n0,0,1,0.5\n", "line 2, column 't': must be a whole number, got '0.5'"),
        ("episode,state,action,Step\n0,0,1\n", "line 2: 3 fields, but the first line names more columns"),
        ("episode,state,action,Step\n0,0,1,\n", "line 2, column 'Step': must be a whole number, got ''"),
        ("episode,state,action,t,step\n", "line 1: columns 't' and 'step' could both be the step: keep one"),
        ("episode,state,action,t\n0,0,,0\n0,2,1,1\n", "line 3: a step after its episode's final observation"),
        ("episode,state,action\n0,,1\n", "line 2, column 'state': must be a whole number, got ''"),
        ("episode,state,action\n0,1.5,1\n", "line 2, column 'state': must be a whole number, got '1.5'"),
        ("episode,state,action\n\n0,1,up\n", "line 3, column 'action': must be a whole number, got 'up'"),
        ("episode,state,action\n0,nan,1\n", "line 2, column 'state': must be a whole number, got 'nan'"),
        ("episode,state,action\n0,inf,1\n", "line 2, column 'state': must be a whole number, got 'inf'"),
        ("episode,state,action\n0,1_0,1\n", "line 2, column 'state': must be a whole number, got '1_0'"),
        ("episode,state,action\n0,-1,1\n", "line 2, column 'state': must lie in [0, 2147483647), got -1"),
        ("episode,state,action\n0,1,2147483647\n", "line 2, column 'action': must lie in [0, 2147483647), got"),
        ("episode,state,action\n0,1e300,1\n", "line 2, column 'state': must lie in [0, 2147483647), got 1e300"),
        ("episode,state,action\n0,1,\n0,2,1\n", "line 3: a step after its episode's final observation"),
        ('episode,state,action\n0,1,"1\n', "line 2: unexpected end of data"),
        (b"episode,state,action\n0,\xff,1\n", "not a text file in UTF-8"),
        (b"episode,state,action\n0,0,1\x00\n", "not a text file in UTF-8 (it holds zero bytes)"),
    ],
)
def test_bad_csv_files_name_the_line_and_the_column(read, text, message):
    with pytest.raises(FileError, match=re.escape(message)) as raised:
        read(text)
    assert "steps.csv" in str(raised.value) and "\n" not in str(raised.value)


def test_missing_csv_files_are_one_line(tmp_path):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(FileError, match=re.escape(str(path))):
            demonstrations_from_csv(path)


def test_demonstrations_are_what_from_trajectories_builds():
    demonstrations, _ = demonstrations_from_episodes(EPISODES)
    expected = Demonstrations.from_trajectories(EPISODES)
    for name in ("states", "actions", "mask", "terminated", "final_states"):
        np.testing.assert_array_equal(getattr(demonstrations, name), getattr(expected, name))
