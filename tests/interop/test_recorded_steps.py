"""Models of environments without a table, from recorded steps: observations of any kind, rewards, ends."""

import re

import gymnasium
import numpy as np
import pytest

import jaxhom
from jaxhom.interop import demonstrations_from, from_samples


class TreasureDive:
    """A sea of three columns: a diver goes down or right, and finds one treasure, of more worth the deeper it lies.

    It has a `step`, and no table; its observations are dictionaries.
    """

    depths, worths = (1, 2, 3), (1.0, 4.0, 9.0)

    def reset(self):
        self.row = self.column = 0
        return self._observation()

    def step(self, action):
        if action == "down":
            self.row += 1
        else:
            self.column = min(self.column + 1, 2)
        is_end = self.row == self.depths[self.column]
        return self._observation(), self.worths[self.column] if is_end else -0.5, is_end

    def _observation(self):
        return {"row": np.int64(self.row), "column": self.column}


def name(row, column):
    return (("column", column), ("row", row))


def recorded(env, actions, steps, seed=0):
    rng, rows, episode, before = np.random.default_rng(seed), [], 0, env.reset()
    for _ in range(steps):
        action = actions[rng.integers(len(actions))]
        after, reward, is_end = env.step(action)
        rows.append((episode, before, action, after, reward, is_end))
        before, episode = (env.reset(), episode + 1) if is_end else (after, episode)
    names = ("episode", "obs", "act", "next_obs", "reward", "terminated")
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))


def sampled(table, **options):
    return from_samples(
        table["obs"],
        table["act"],
        table["next_obs"],
        rewards=table["reward"],
        terminated=table["terminated"],
        **options,
    )


def test_a_sea_without_a_table():
    table = recorded(TreasureDive(), ("down", "right"), 400)
    model = sampled(table, discount=0.9, prior=0.0)
    mdp, ends = model.mdp, {name(1, 0), name(2, 1), name(3, 2)}
    transition, reward, terminal = (np.asarray(each) for each in (mdp.transition, model.reward, model.terminal))
    assert mdp.action_names in {("down", "right"), ("right", "down")} and mdp.num_states == 9
    assert {mdp.state_names[s] for s in np.flatnonzero(terminal)} == ends
    down, right = (mdp.action_names.index(action) for action in ("down", "right"))
    for state, (column, row) in enumerate((dict(each)["column"], dict(each)["row"]) for each in mdp.state_names):
        for action, target in ((down, name(row + 1, column)), (right, name(row, min(column + 1, 2)))):
            target = mdp.state_names[state] if terminal[state] else target
            assert transition[state, action, mdp.state_index(target)] == 1.0
            worth = TreasureDive.worths[dict(target)["column"]] if target in ends else -0.5
            assert reward[state, action] == (0.0 if terminal[state] else worth)
    assert np.asarray(mdp.initial)[terminal].sum() == 0.0
    np.testing.assert_array_equal(np.asarray(model.expected_l1_error)[terminal], 0.0)
    # down at once is worth 1; right first, 4 a step later for -0.5 twice, is worth more, and the deepest most
    plan = jaxhom.optimal_policy(mdp, model.reward)
    value = -0.5 * (1 + 0.9 + 0.9**2 + 0.9**3) + 0.9**4 * 9.0
    np.testing.assert_allclose(plan.value[mdp.state_index(name(0, 0))], value, rtol=1e-12)
    demonstrations, report = demonstrations_from(table, mdp=mdp)  # trajectories find the states by what was observed
    assert report.dropped == () and report.steps == 400
    demonstrations.validate(mdp, "refuse")


def test_blackjack_by_random_play():
    """Its episodes end where others go on, so they get a state of their own; hit 11, stick on 20."""

    class Table:
        env = gymnasium.make("Blackjack-v1")

        def reset(self, seed=None):
            return self.env.reset(seed=seed)[0]

        def step(self, action):
            observation, reward, is_end, _, _ = self.env.step(action)
            return observation, reward, is_end

    env = Table()
    env.reset(seed=3)
    table = recorded(env, (0, 1), 4000)
    with pytest.raises(ValueError, match=r"state \d+ \(.*\) ends some episodes, but step \d+ leaves it"):
        sampled(table, discount=0.9)
    model = sampled(table, discount=0.9, end_state=True, prior=0.1)
    mdp, reward, count = model.mdp, np.asarray(model.reward), np.asarray(model.count)
    assert mdp.state_names[-1] == "end" and np.flatnonzero(model.terminal).tolist() == [mdp.num_states - 1]
    assert count.sum() == 4000 and count[-1].sum() == 0
    stuck = np.asarray(mdp.transition)[:-1, 0, -1]  # to stick always ends the episode
    np.testing.assert_array_equal(stuck[count[:-1, 0] > 0], 1.0)
    plan = np.asarray(jaxhom.optimal_policy(mdp, model.reward).policy)
    for hand, best in (((11, 6, 0), 1), ((20, 10, 0), 0)):
        state = mdp.state_index(hand)
        rows = [row for row, seen in enumerate(table["obs"]) if tuple(map(int, seen)) == hand]
        for action in (0, 1):
            mine = [table["reward"][row] for row in rows if table["act"][row] == action]
            assert reward[state, action] == pytest.approx(np.mean(mine))
        assert plan[state].argmax() == best


@pytest.mark.parametrize("support", ["observed", "all"])
def test_ends_are_absorbing(support):
    options = {"num_states": 3, "discount": 0.9, "support": support}
    options |= {"terminated": [False, True, True], "rewards": [1.0, 2.0, 6.0]}
    model = from_samples([0, 1, 1], [0, 0, 0], [1, 2, 2], num_actions=2, **options)
    assert model.mdp.state_names is None and model.terminal.tolist() == [False, False, True]
    np.testing.assert_array_equal(model.mdp.transition[2], [[0, 0, 1]] * 2)
    np.testing.assert_array_equal(model.reward, [[1, 0], [4, 0], [0, 0]])
    np.testing.assert_array_equal(model.mdp.initial, [0.5, 0.5, 0.0])
    np.testing.assert_array_equal(model.expected_l1_error[2], 0.0)
    features, initial = np.arange(6.0).reshape(3, 2), [0.0, 1.0, 0.0]
    given = {"features": features, "initial": initial, "end_state": True}
    model = from_samples([0, 1, 1], [0, 0, 0], [1, 2, 0], num_actions=1, **options, **given)
    np.testing.assert_array_equal(model.mdp.features[:, 0], [*features, [0, 0]])
    np.testing.assert_array_equal(model.mdp.initial, [*initial, 0])
    assert model.terminal.tolist() == [False] * 3 + [True]


@pytest.mark.parametrize(
    ("observations", "names"),
    [
        (["b", "a", "b"], ("b", "a")),
        ([7, 3, 7], (7, 3)),
        ([(1, 2), (0, 5), (1, 2)], ((1, 2), (0, 5))),
        (np.array([[1, 2], [0, 5], [1, 2]]), ((1, 2), (0, 5))),
        ([np.eye(2), np.ones((2, 2)), np.eye(2)], (((1, 0), (0, 1)), ((1, 1), (1, 1)))),
        ([True, None, True], (True, None)),
    ],
)
def test_observations_are_numbered_as_they_appear(observations, names):
    model = from_samples(observations[:-1], [2, 0], observations[1:], discount=0.9)
    assert model.mdp.state_names == names and model.mdp.action_names is None
    np.testing.assert_array_equal(model.count, [[0, 0, 1], [1, 0, 0]])
    assert model.reward is None and model.terminal is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"terminated": [True, False]}, "terminated must have shape (3,) like observations, got (2,)"),
        ({"terminated": [0, 2, 0]}, "terminated[1] must be True or False, got 2"),
        (
            {"terminated": [True, False, False]},
            "state 1 'b' ends some episodes, but step 1 leaves it",
        ),
        (
            {"terminated": [0, 0, 1], "next_states": ["b", "c", "c"]},
            "state 2 'c' ends some episodes, but step 1 enters",
        ),
        ({"rewards": [1.0]}, "rewards must have shape (3,) like states, got (1,)"),
        ({"rewards": [1.0, np.nan, 0.0]}, "rewards[1] must be finite, got nan"),
        ({"end_state": True}, "end_state needs terminated, the transitions that ended their episode"),
        ({"states": [{1}, {2}, {3}]}, "states: no name can be made of an observation of type set"),
        ({"states": 3}, "states must be a sequence, got int"),
        ({"states": np.array([0.5, np.nan, 1.5])}, "states[1] must not be NaN, which is equal to nothing, got nan"),
        ({"next_states": np.array([[0, 1], [1, np.nan], [1, 2]])}, "next_states[1] must not be NaN"),
        ({"states": ["a"]}, "actions must have shape (1,) like states, got (3,)"),
        ({"states": [], "next_states": [], "actions": []}, "num_states must be at least 1, got 0"),
        ({"actions": [0, -1, 0]}, "actions[1] must not be negative, got -1"),
        (
            {"terminated": [0, 0, 1], "end_state": True, "initial": [1.0, 0.0]},
            "initial must have shape (3, ...), got (2,)",
        ),
    ],
)
def test_bad_recordings_are_refused(changes, message):
    given = {
        "states": ["a", "b", "a"],
        "actions": [0, 1, 0],
        "next_states": ["b", "c", "b"],
        **changes,
    }
    columns = [given.pop(name) for name in ("states", "actions", "next_states")]
    with pytest.raises(ValueError, match=re.escape(message)):
        from_samples(*columns, discount=0.9, **given)
