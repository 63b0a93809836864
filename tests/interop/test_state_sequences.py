"""Trajectories of states alone, against every action tried in turn."""

import itertools
import re

import numpy as np
import pytest

import jaxhom
from jaxhom import MDP, empirical_policy
from jaxhom.interop import demonstrations_from_states, load_demonstrations, save_demonstrations


def random_model(seed, sparse):
    """Six states, three actions, of which few lead from one state to another; some are not allowed."""
    rng = np.random.default_rng(seed)
    transition = rng.random((6, 3, 6)) * (rng.random((6, 3, 6)) < 0.4)
    transition[..., 0] += 1e-3
    transition /= transition.sum(axis=-1, keepdims=True)
    allowed = rng.random((6, 3)) < 0.8
    allowed[:, 0] = True
    if sparse:
        next_state = np.broadcast_to(np.arange(6), (6, 3, 6))
        return MDP.from_successors(next_state, transition, discount=0.9, allowed=allowed), transition, allowed
    return MDP.from_dense(transition, discount=0.9, allowed=allowed), transition, allowed


def walks(transition, allowed, rng, count, horizon):
    """Sequences of states that can have happened."""
    for _ in range(count):
        states = [int(rng.integers(6))]
        for _ in range(horizon):
            action = rng.choice(np.flatnonzero(allowed[states[-1]]))
            states.append(int(rng.choice(6, p=transition[states[-1], action])))
        yield states


def tried(transition, allowed, state, successor):
    """The actions that can have led from one state to another, tried in turn."""
    return [a for a in range(3) if allowed[state, a] and transition[state, a, successor] > 0]


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("ambiguous", ["hide", "likeliest"])
def test_actions_are_those_that_lead_there(sparse, ambiguous):
    mdp, transition, allowed = random_model(3, sparse)
    sequences = list(walks(transition, allowed, np.random.default_rng(4), 30, 5))
    demonstrations, report = demonstrations_from_states(mdp, sequences, ambiguous=ambiguous)
    expected, told = [], []
    for i, states in enumerate(sequences):
        steps = []
        for t, (state, successor) in enumerate(itertools.pairwise(states)):
            candidates = tried(transition, allowed, state, successor)
            if len(candidates) > 1:
                told.append((i, t, tuple(candidates)))
                if ambiguous == "likeliest":  # no two are alike in this model
                    candidates = [max(candidates, key=lambda a: transition[state, a, successor])]
            steps.append((state, candidates[0] if len(candidates) == 1 else None))
        while steps and steps[-1][1] is None:
            steps.pop()
        if steps:
            expected.append(steps)
    assert report.ambiguous == tuple(told) and len(told) > 5
    assert len(demonstrations) == len(expected) == report.episodes
    for i, steps in enumerate(expected):
        length = len(steps)
        mask = [action is not None for _, action in steps]
        assert demonstrations.mask[i, :length].tolist() == mask and not demonstrations.mask[i, length:].any()
        assert demonstrations.states[i, :length].tolist() == [state for state, _ in steps]
        actions = demonstrations.actions[i, :length][np.array(mask)].tolist()
        assert actions == [action for _, action in steps if action is not None]
    demonstrations.validate(mdp, "refuse")
    assert report.steps == int(demonstrations.mask.sum())


STAY, ONWARD = np.eye(3), np.eye(3)[[1, 2, 2]]


def two_ways(onward=ONWARD, allowed=None):
    """Action 0 stays; 1 and 2 both lead on, 2 surely and 1 half the time."""
    transition = np.stack([STAY, (STAY + ONWARD) / 2, onward], axis=1)
    return MDP.from_dense(transition, discount=0.9, allowed=allowed)


def test_ambiguous_steps_are_hidden_and_told():
    """In state 0 action 1 is not allowed, so that what was done there is sure; in the others nothing is."""
    mdp = two_ways(allowed=[[True, False, True], [True, True, True], [True, True, True]])
    demonstrations, report = demonstrations_from_states(mdp, [[0, 0, 1, 1, 2, 2, 2], [0, 1, 2], [1, 2], [2]])
    assert demonstrations.mask.tolist() == [[True, True], [True, False]]
    np.testing.assert_array_equal(demonstrations.final_states, [1, 1])
    assert report.dropped[0][0] == 2 and report.dropped[1] == (3, "it has no step")
    assert report.ambiguous[0] == (0, 2, (0, 1)) and len(report.ambiguous) == 6
    assert "6 steps could have been several actions; the first: episode 0, step 2, actions 0, 1" in str(report)
    visited, policy = empirical_policy(mdp, demonstrations)
    assert visited.tolist() == [True, False, False]
    np.testing.assert_allclose(policy[0], [1 / 3, 0, 2 / 3])
    demonstrations, _ = demonstrations_from_states(mdp, [[0, 1, 2], [1, 1]], ambiguous="likeliest")
    assert [actions.tolist() for _, actions in demonstrations] == [[2, 2], [0]]


def test_hidden_steps_keep_their_time_in_files(tmp_path):
    allowed = [[True, False, True], [True, True, True], [False, False, True]]
    mdp = two_ways(onward=np.eye(3)[[1, 2, 0]], allowed=allowed)
    demonstrations, _ = demonstrations_from_states(mdp, [[0, 1, 1, 2, 0]])
    assert demonstrations.mask.tolist() == [[True, False, False, True]]
    save_demonstrations(tmp_path / "walks.npz", demonstrations)
    loaded = load_demonstrations(tmp_path / "walks.npz")
    for name in ("states", "mask", "final_states"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(demonstrations, name))


def test_equal_actions_are_ambiguous_and_likeliest_takes_none_of_them():
    mdp = MDP.from_dense(np.eye(2)[[[0, 1, 1], [1, 1, 0]]], discount=0.9)
    for ambiguous in ("hide", "likeliest"):
        demonstrations, report = demonstrations_from_states(mdp, [[0, 0, 1, 0]], ambiguous=ambiguous)
        assert demonstrations.mask.tolist() == [[True, False, True]]
        assert report.ambiguous == ((0, 1, (1, 2)),)


def test_states_by_name():
    grid = jaxhom.gridworld(2, noise=0.0).mdp
    named = grid.replace(state_names=[(0, 0), (0, 1), (1, 0), (1, 1)])
    by_number, _ = demonstrations_from_states(grid, [[0, 1, 3]])
    for walk in ([(0, 0), (0, 1), (1, 1)], np.array([[0, 0], [0, 1], [1, 1]]), [[0, 0], [0, 1], [1, 1]]):
        by_name, _ = demonstrations_from_states(named, [walk])
        np.testing.assert_array_equal(by_name.states, by_number.states)
        np.testing.assert_array_equal(by_name.actions, by_number.actions)
    with pytest.raises(ValueError, match=re.escape("no action leads from state 0 (0, 0) to state 3 (1, 1)")):
        demonstrations_from_states(named, [[(0, 0), (1, 1)]])


@pytest.mark.parametrize(
    ("sequences", "options", "message"),
    [
        ([[0, 0], [0, 1, 0]], {}, "sequence 1, step 1: no action leads from state 1 to state 0"),
        ([[0, 0, 1]], {"ambiguous": "refuse"}, "sequence 0, step 0: actions 0, 1 lead from state 0 to state 0"),
        ([[0, 1]], {}, "none of 1 episodes can be used; episode 0: several actions could have been each of its steps"),
        ([[0]], {}, "none of 1 episodes can be used; episode 0: it has no step"),
        ([], {}, "there are no episodes"),
        (None, {}, "sequences must be sequences of states, got NoneType"),
        ([[0, 3]], {}, "sequence 0[1] must be below 3, got 3"),
        ([[0, 0.5]], {}, "sequence 0[1] must be whole, got 0.5"),
        ([0], {}, "sequence 0 must have shape [H] or [H, 1], got ()"),
        ([[0, 1]], {"ambiguous": "guess"}, "ambiguous must be one of hide, likeliest, refuse, got 'guess'"),
    ],
)
def test_what_cannot_have_happened_is_refused(sequences, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations_from_states(two_ways(), sequences, **options)
