"""Gymnasium environments as models, against values computed from their tables by plain loops in NumPy."""

import collections
import re
import sys
import types

import gymnasium
import jax
import numpy as np
import pytest
from small_models import dense_transition

from jaxhom.interop import (
    GymnasiumModel,
    demonstrations_from_episodes,
    from_gymnasium,
    from_samples,
    make_environment,
)
from jaxhom.interop.environment_tables import require_steps_of_table
from jaxhom.planning.optimal import optimal_policy

DISCOUNT = 0.9


def newest(name):
    """The id of the newest version that is installed."""
    return max((id for id in gymnasium.registry if re.fullmatch(rf"{name}-v\d+", id)), key=lambda id: int(id[-1]))


CASES = {
    "lake 4x4": ("FrozenLake", {}),
    "lake 4x4, dry": ("FrozenLake", {"is_slippery": False}),
    "lake 8x8": ("FrozenLake", {"map_name": "8x8"}),
    "lake 8x8, dry": ("FrozenLake", {"map_name": "8x8", "is_slippery": False}),
    "taxi": ("Taxi", {}),
    "cliff": ("CliffWalking", {}),
}


@pytest.fixture(params=CASES)
def env(request):
    name, options = CASES[request.param]
    with gymnasium.make(newest(name), **options) as made:
        yield made


def toy(table, initial=(1.0, 0.0), **attributes):
    return types.SimpleNamespace(P=table, initial_state_distrib=np.array(initial), **attributes)


def table_values(table):
    """Optimal values by the rules of Gymnasium: nothing is earned after a terminated outcome."""
    rows = [(s, a, *outcome) for s in table for a in table[s] for outcome in table[s][a]]
    s, a, p, z, r, t = (np.array(column) for column in zip(*rows, strict=True))
    value = np.zeros(len(table))
    for _ in range(400):
        action_value = np.zeros((len(table), len(table[0])))
        np.add.at(action_value, (s, a), p * (r + DISCOUNT * np.where(t, 0.0, value[z])))
        value = action_value.max(axis=1)
    return value


def model_values(model):
    """Optimal values of a model that was built, whose episodes never end."""
    next_state, probability = np.asarray(model.mdp.next_state), np.asarray(model.mdp.probability)
    value = np.zeros(len(next_state))
    for _ in range(400):
        value = (np.asarray(model.reward) + DISCOUNT * np.sum(probability * value[next_state], axis=-1)).max(axis=1)
    return value


def states_of_episodes(table, initial):
    """The states from which an episode can go on."""
    found = set(np.flatnonzero(initial).tolist())
    queue = collections.deque(found)
    while queue:
        for outcomes in table[queue.popleft()].values():
            new = {int(z) for p, z, _, terminated in outcomes if p > 0 and not terminated} - found
            found |= new
            queue.extend(new)
    return sorted(found)


def test_values_are_those_of_the_table(env):
    model = from_gymnasium(env, discount=DISCOUNT)
    inner = env.unwrapped
    assert model.reward.shape == (len(inner.P), inner.action_space.n)
    np.testing.assert_array_equal(model.mdp.initial, inner.initial_state_distrib)
    alive = states_of_episodes(inner.P, inner.initial_state_distrib)
    np.testing.assert_allclose(model_values(model)[alive], table_values(inner.P)[alive], rtol=0, atol=1e-12)


def test_with_an_end_state_values_are_those_of_the_table_everywhere(env):
    model = from_gymnasium(env, discount=DISCOUNT, end_state=True)
    np.testing.assert_allclose(model_values(model)[:-1], table_values(env.unwrapped.P), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(model.terminal), [len(env.unwrapped.P)])
    assert model.mdp.initial[-1] == 0


def test_planning_from_an_id():
    model = from_gymnasium(newest("Taxi"), discount=DISCOUNT)
    assert isinstance(jax.tree.map(lambda leaf: leaf, model), GymnasiumModel)
    plan = optimal_policy(model.mdp, model.reward)
    with gymnasium.make(newest("Taxi")) as env:
        table, initial = env.unwrapped.P, env.unwrapped.initial_state_distrib
    np.testing.assert_allclose(model.mdp.initial @ plan.value, initial @ table_values(table), rtol=0, atol=1e-8)


def test_terminated_successors_absorb_although_the_table_leads_on(env):
    table = env.unwrapped.P
    model = from_gymnasium(env, discount=DISCOUNT)
    ended = {int(z) for row in table.values() for outcomes in row.values() for p, z, _, t in outcomes if t and p > 0}
    np.testing.assert_array_equal(np.flatnonzero(model.terminal), sorted(ended))
    transition = dense_transition(model.mdp)
    for state in ended:
        np.testing.assert_array_equal(transition[state], np.tile(np.eye(len(table))[state], (transition.shape[1], 1)))
        assert not np.any(model.reward[state])
    if "Cliff" in env.spec.id or "Taxi" in env.spec.id:
        leads_on = [z != s for s in ended for outcomes in table[s].values() for _, z, _, _ in outcomes]
        assert any(leads_on)


def test_successors_that_are_listed_twice_add_up():
    outcomes = [(0.25, 0, 4.0, False), (0.5, 1, 1.0, True), (0.25, 0, 0.0, False)]
    model = from_gymnasium(toy({0: {0: outcomes}, 1: {0: [(1.0, 0, 7.0, False)]}}), discount=0.5)
    np.testing.assert_allclose(dense_transition(model.mdp)[:, 0], [[0.5, 0.5], [0.0, 1.0]])
    np.testing.assert_allclose(model.reward, [[1.5], [0.0]])


def test_tables_may_be_lists_and_features_may_be_given():
    lists = [[[(1.0, np.int64(1), 1, np.True_)]], [[(1.0, 0, 0, False)]]]
    features = np.array([[1.0, 2.0], [3.0, 4.0]])
    model = from_gymnasium(toy(lists), discount=0.5, features=features)
    np.testing.assert_array_equal(model.mdp.features[:, 0], features)
    extended = from_gymnasium(toy(lists), discount=0.5, features=features, end_state=True)
    np.testing.assert_array_equal(extended.mdp.features[:, 0], np.vstack([features, [0.0, 0.0]]))


MIXED = {0: {0: [(0.5, 1, 1.0, True), (0.5, 1, 1.0, False)]}, 1: {0: [(1.0, 0, 2.0, False)]}}


@pytest.mark.parametrize(
    ("table", "initial", "how"),
    [
        (MIXED, (1.0, 0.0), "state 0 enters it by action 0 without terminating"),
        ({0: {0: [(1.0, 1, 1.0, True)]}, 1: {0: [(1.0, 0, 0.0, False)]}}, (0.5, 0.5), "episodes start in it"),
    ],
)
def test_states_that_end_only_some_episodes_need_the_end_state(table, initial, how):
    with pytest.raises(ValueError, match=f"state 1 ends some episodes, but {how}.*end_state=True"):
        from_gymnasium(toy(table, initial), discount=DISCOUNT)
    model = from_gymnasium(toy(table, initial), discount=DISCOUNT, end_state=True)
    np.testing.assert_allclose(model_values(model)[:2], table_values(table), rtol=0, atol=1e-12)


ENDLESS = {0: {0: [(1.0, 1, 5.0, False)], 1: [(1.0, 0, 1.0, False)]}, 1: {0: [], 1: []}}


@pytest.mark.parametrize("last", [{0: [], 1: []}, {}, []])
def test_states_without_rows_absorb(last):
    """State 1 is entered without `terminated`, and nothing is said about what follows: nothing does."""
    for end_state in (False, True):
        model = from_gymnasium(toy({**ENDLESS, 1: last}), discount=DISCOUNT, end_state=end_state)
        np.testing.assert_array_equal(np.asarray(model.terminal)[:2], [False, True])
        assert not model.mdp.restricts_actions
        np.testing.assert_array_equal(dense_transition(model.mdp)[1, :, 1], 1.0)
        np.testing.assert_allclose(model_values(model)[:2], [10.0, 0.0], rtol=1e-12)


def test_actions_that_a_state_lacks_are_not_allowed():
    """In a dictionary or a list, at the end or in between; and with an end state as well."""
    table = {
        0: {0: [(1.0, 1, 1.0, False)], 2: [(0.5, 1, 4.0, False), (0.5, 2, 0.0, True)]},
        1: {1: [(1.0, 0, 2.0, False)]},
        2: [[(1.0, 2, 9.0, False)]],
    }
    expected = [[True, False, True], [False, True, False]]
    for end_state in (False, True):
        model = from_gymnasium(toy(table, (1.0, 0.0, 0.0)), discount=0.5, end_state=end_state)
        np.testing.assert_array_equal(model.mdp.allowed[:2], expected)
        # V0 = max(1 + V1 / 2, 2 + V1 / 4), V1 = 2 + V0 / 2
        plan = optimal_policy(model.mdp, model.reward)
        np.testing.assert_allclose(plan.value[:2], [20 / 7, 24 / 7], rtol=1e-9)
        np.testing.assert_array_equal(np.asarray(plan.policy).argmax(axis=1)[:2], [2, 1])


class Sticky(gymnasium.ActionWrapper):
    """Every action is the first."""

    def action(self, _):
        return 0


def test_steps_outside_the_table_are_found():
    for name, options in (CASES["lake 4x4"], CASES["taxi"], ("CliffWalking", {"is_slippery": True})):
        with gymnasium.make(newest(name), **options) as env:
            require_steps_of_table(env)
    with Sticky(gymnasium.make("FrozenLake-v1", is_slippery=False)) as env:
        message = "FrozenLakeEnv: action 2 led from state 0 to 0, which its table P gives probability 0"
        with pytest.raises(ValueError, match=message):
            require_steps_of_table(env)
    with gymnasium.make("CartPole-v1") as env:
        require_steps_of_table(env)


def test_ids_are_stepped_and_environments_are_left_alone():
    gymnasium.register("Sticky-v0", entry_point=lambda: Sticky(gymnasium.make("FrozenLake-v1", is_slippery=False)))
    try:
        with pytest.raises(ValueError, match="led from state 0 to 0"):
            from_gymnasium("Sticky-v0", discount=DISCOUNT)
    finally:
        gymnasium.registry.pop("Sticky-v0")
    with gymnasium.make("FrozenLake-v1", is_slippery=False) as env:
        env.reset(seed=0)
        env.step(2)
        from_gymnasium(env, discount=DISCOUNT)
        assert env.step(2)[0] == 2


def test_an_option_outside_the_table_is_refused():
    with gymnasium.make(newest("Taxi"), fickle_passenger=True) as env:
        for wrapped in (env, env.unwrapped):
            with pytest.raises(ValueError, match="fickle_passenger=True, which its table P does not contain"):
                from_gymnasium(wrapped, discount=DISCOUNT)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("FrozenLake-v1", {"is_slippery": "nope"}, "'FrozenLake-v1': is_slippery must be true or false, got 'nope'"),
        ("FrozenLake-v1", {"is_slippery": None}, "is_slippery must be true or false, got None"),
        ("FrozenLake-v1", {"wet": 1}, "has no option 'wet'; it has render_mode, desc, map_name, is_slippery"),
        ("FrozenLake-v1", {"map_name": "5x5"}, "cannot be made with map_name='5x5': KeyError '5x5'"),
        ("Nothing-v0", {"a": (1, 2)}, "'Nothing-v0' cannot be made with a=(1, 2): Environment `Nothing` doesn't exist"),
    ],
)
def test_options_that_environments_do_not_understand(name, options, message):
    with pytest.raises(ValueError, match=re.escape(message)) as raised:
        make_environment(name, **options)
    assert "\n" not in str(raised.value)


def test_options_that_environments_understand():
    options = {"desc": ("SF", "FG"), "is_slippery": 0, "max_episode_steps": 3}
    with make_environment("FrozenLake-v1", **options) as env:
        assert env.unwrapped.desc.shape == (2, 2) and env.spec.max_episode_steps == 3
        assert len(env.unwrapped.P[0][1]) == 1


def test_trajectories_recorded_in_an_environment_are_demonstrations():
    with gymnasium.make("FrozenLake-v1") as env:
        model, episodes, ends = from_gymnasium(env, discount=DISCOUNT), [], []
        env.action_space.seed(0)
        for seed in range(20):
            observations, actions, over = [env.reset(seed=seed)[0]], [], False
            while not over:
                actions.append(env.action_space.sample())
                observation, _, terminated, truncated, _ = env.step(actions[-1])
                observations.append(observation)
                over = terminated or truncated
            episodes.append((observations, actions))
            ends.append(observations[-1])
    demonstrations, report = demonstrations_from_episodes(episodes)
    assert (report.episodes, report.final_observations, report.dropped) == (20, 20, ())
    assert report.steps == sum(len(actions) for _, actions in episodes)
    demonstrations.validate(model.mdp)
    states, taken = np.asarray(demonstrations.states), np.asarray(demonstrations.actions)
    for i, (observations, actions) in enumerate(episodes):
        np.testing.assert_array_equal(states[i, : len(actions)], observations[:-1])
        np.testing.assert_array_equal(taken[i, : len(actions)], actions)
    assert np.all(np.asarray(model.terminal)[ends])


def test_counting_transitions_gives_the_table_back():
    """Every outcome of the slippery lake is as likely as every other: recorded once each, they are the model."""
    with gymnasium.make("FrozenLake-v1") as env:
        model = from_gymnasium(env, discount=DISCOUNT)
        table = env.unwrapped.P
    steps = [(s, a, z) for s in table for a in table[s] for _, z, _, _ in table[s][a]]
    sampled = from_samples(*np.array(steps).T, num_states=16, num_actions=4, discount=DISCOUNT, prior=0.0)
    np.testing.assert_allclose(dense_transition(sampled.mdp), dense_transition(model.mdp), rtol=0, atol=1e-15)


GOOD = {0: {0: [(1.0, 1, 0.0, True)]}, 1: {0: [(1.0, 1, 0.0, True)]}}


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("CartPole-v1", "CartPoleEnv has no transition table P.*from_samples"),
        ("NoSuchWorld-v0", "'NoSuchWorld-v0' cannot be made"),
        (None, "environment NoneType has no transition table P"),
        (toy({}), "at least one state and one action"),
        (toy({0: {}, 1: {}}), "at least one state and one action"),
        (toy({1: GOOD[0], 2: GOOD[1]}), r"as P\[state\]\[action\], both numbered from 0: KeyError 0"),
        (toy(3), r"as P\[state\]\[action\]"),
        (toy({**GOOD, 0: {-1: [], **GOOD[0]}}), r"P\[0\] of .* has an action -1: actions are numbered from 0 on"),
        (
            toy({**GOOD, 1: {10**9: GOOD[1][0]}}, action_space=gymnasium.spaces.Discrete(2)),
            r"P\[1\] of .* has an action 1000000000: .* from 0 to 1",
        ),
        (toy({**GOOD, 0: {0: [0.5, 0.5]}}), r"P\[0\]\[0\]\[0\] must be \(probability, next state, .*got 0.5"),
        (toy({**GOOD, 0: {0: [np.eye(3)]}}), r"P\[0\]\[0\]\[0\] must be"),
        (toy({**GOOD, 0: {0: [(1.0, 1, 0.0)]}}), r"P\[0\]\[0\]\[0\] must be"),
        (toy({**GOOD, 0: {0: [(1.0, "left", 0.0, True)]}}), r"P\[0\]\[0\]\[0\] must be"),
        (toy({**GOOD, 0: {0: []}}), r"initial\[0\] is positive, but P has no outcome there.*got 1.0"),
        (toy({**GOOD, 1: {0: [(1.1, 0, 0.0, True)]}}), r"sum of P: probability\[1, 0\] must be 1, got 1.1"),
        (toy({**GOOD, 1: {0: [(np.nan, 0, 0.0, True)]}}), r"P: probability\[1, 0, 0\] must be finite"),
        (toy({**GOOD, 1: {0: [(1.0, 2, 0.0, True)]}}), r"P: next state\[1, 0, 0\] must be below 2, got 2"),
        (toy({**GOOD, 1: {0: [(1.0, 0.5, 0.0, True)]}}), r"P: next state\[1, 0, 0\] must be whole"),
        (toy({**GOOD, 1: {0: [(1.0, 0, np.inf, True)]}}), r"P: reward\[1, 0, 0\] must be finite"),
        (toy(GOOD, (0.5, 0.6)), "sum of initial must be 1, got 1.1"),
        (toy(GOOD, (1.0,)), r"initial must have shape \(2,\)"),
        (types.SimpleNamespace(P=GOOD), "no initial_state_distrib: pass initial"),
    ],
)
def test_environments_that_are_refused(env, message):
    with pytest.raises(ValueError, match=message) as raised:
        from_gymnasium(env, discount=DISCOUNT)
    assert "\n" not in str(raised.value)


def test_without_gymnasium_an_id_says_what_to_install_and_an_environment_needs_nothing(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ImportError, match=r"pip install '\.\[interop\]'"):
        from_gymnasium("FrozenLake-v1", discount=DISCOUNT)
    assert from_gymnasium(toy(GOOD), discount=DISCOUNT).mdp.num_states == 2


def test_features_of_the_wrong_shape_are_refused():
    for end_state in (False, True):
        with pytest.raises(ValueError, match=r"features must have shape \(2, .*got \(3, 1\)"):
            from_gymnasium(toy(GOOD), discount=DISCOUNT, features=np.ones((3, 1)), end_state=end_state)


def test_initial_may_be_given():
    model = from_gymnasium(types.SimpleNamespace(P=GOOD), discount=DISCOUNT, initial=[1.0, 0.0])
    np.testing.assert_array_equal(model.mdp.initial, [1.0, 0.0])
