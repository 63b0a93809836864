"""Models from functions of successors, and names of states and actions."""

import itertools
import pickle
import re

import jax
import numpy as np
import pytest

import jaxhom
from jaxhom import MDP

SIZE = 4
MOVES = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}


def lake(place):
    """A slippery board of 4 x 4: a move succeeds with 0.8, else it goes on to one side; the last corner is the end."""
    if place == (SIZE - 1, SIZE - 1):
        return {}
    names = list(MOVES)

    def to(name):
        return tuple(min(max(p + m, 0), SIZE - 1) for p, m in zip(place, MOVES[name], strict=True))

    side = {name: names[(i + 2) % 4] for i, name in enumerate(names)}
    return {name: [(0.8, to(name)), (0.2, to(side[name]))] for name in MOVES}


def by_hand():
    """The same model as arrays, its states in rows."""
    places = list(itertools.product(range(SIZE), repeat=2))
    transition = np.zeros((16, 4, 16))
    for s, place in enumerate(places):
        for a, outcomes in enumerate((lake(place) or {name: [(1.0, place)] for name in MOVES}).values()):
            for probability, following in outcomes:
                transition[s, a, places.index(following)] += probability
    return places, transition


def test_a_function_gives_the_model_that_its_arrays_give():
    mdp = MDP.from_function(lake, (0, 0), discount=0.9, features=lambda place, move: [sum(place), move == "up"])
    places, transition = by_hand()
    assert mdp.state_names[0] == (0, 0) and mdp.action_names == tuple(MOVES)
    order = [mdp.state_index(place) for place in places]
    np.testing.assert_array_equal(np.asarray(mdp.transition)[np.ix_(order, range(4), order)], transition)
    features = np.asarray(mdp.features)
    for place, name in itertools.product(places, MOVES):
        expected = [0, 0] if place == (3, 3) else [sum(place), name == "up"]
        assert features[mdp.state_index(place), mdp.action_index(name)].tolist() == expected
    assert mdp.initial.tolist() == [1.0] + [0.0] * 15
    assert not mdp.restricts_actions
    distance = [sum(place) for place in mdp.state_names]
    assert distance == sorted(distance)  # breadth first


def test_states_may_lack_actions_and_actions_may_be_numbered_by_hand():
    def successors(state):
        return {"b": [(1.0, "end")], **({"a": [(0.5, "x"), (0.5, "y"), (0.0, "never")]} if state == "x" else {})}

    mdp = MDP.from_function(lambda s: None if s == "end" else successors(s), "x", discount=0.5, actions=["a", "b", "c"])
    assert mdp.state_names == ("x", "end", "y")  # as they are met: an outcome of probability 0 leads nowhere
    assert mdp.allowed.tolist() == [[True, True, False], [True, True, True], [False, True, False]]
    start = MDP.from_function(successors, {"x": 0.25, "end": 0.75}, discount=0.5)
    assert start.initial.tolist() == [0.25, 0.75, 0.0]


def test_dtypes_of_python_and_numpy_are_taken():
    mdp = MDP.from_function(lambda s: {0: [(np.float32(1), s), [0, s]]}, np.int64(3), discount=np.float32(0.5))
    assert (mdp.num_states, mdp.num_actions, mdp.num_features, mdp.state_names) == (1, 1, 0, (3,))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"successors": lambda s: {"a": [(0.5, s)]}}, r"state 'x', action 'a': probabilities must sum to 1, got 0.5"),
        ({"successors": lambda s: {"a": [(-0.5, s), (1.5, s)]}}, "a probability must be a number, not negative"),
        ({"successors": lambda s: {"a": [("1", s)]}}, "a probability must be a number, not negative, got '1'"),
        ({"successors": lambda s: {"a": [(float("nan"), s)]}}, "not negative, got nan"),
        ({"successors": lambda s: {"a": [(1.0, [1, 2])]}}, r"a next state must be hashable \(a tuple, say\)"),
        (
            {"successors": lambda s: {"a": []}},
            r"outcomes must be a list of pairs \(probability, next state\), got \[\]",
        ),
        ({"successors": lambda s: {"a": s}}, "outcomes must be a list of pairs"),
        ({"successors": lambda s: {"a": [(1.0, s, 0.0)]}}, "outcomes must be a list of pairs .* among them"),
        ({"successors": lambda s: ["a"]}, r"successors\('x'\) must be a mapping from actions to outcomes"),
        ({"successors": lambda s: None}, "there are no actions"),
        ({"successors": [1]}, r"successors must be a function, got \[1\]"),
        ({"features": np.ones((1, 1, 1))}, "features must be a function, got array"),
        (
            {"successors": lambda s: {"a": [(1.0, s + "x")]}, "max_states": 3},
            "more than 3 states can be reached, 'xxxx' the last of them: pass a larger max_states",
        ),
        ({"max_states": 0}, "max_states must be at least 1"),
        ({"actions": ["b"]}, r"action 'a': not one of the given actions \['b'\]"),
        ({"actions": ["a", "a"]}, r"actions\[1\] must be new, got 'a' again, as \[0\]"),
        ({"start": {}}, "start must be a state, or a mapping .* empty"),
        ({"start": {"x": 0.5}}, "start: probabilities must sum to 1, got 0.5"),
        ({"start": [1]}, r"start must be hashable \(a tuple, say\), got \[1\]"),
        ({"features": lambda s, a: [[1.0]]}, "features of state 'x', action 'a' must be 1 finite numbers"),
        ({"features": lambda s, a: [np.inf]}, "must be 1 finite numbers"),
        ({"features": lambda s, a: ["red"]}, "must be 1 finite numbers"),
        ({"discount": 1.0}, "discount must lie strictly between 0 and 1"),
    ],
)
def test_what_is_wrong_is_named(arguments, message):
    given = {"successors": lambda s: {"a": [(1.0, s)]}, "start": "x", "discount": 0.9} | arguments
    with pytest.raises(ValueError, match=message):
        MDP.from_function(given.pop("successors"), given.pop("start"), **given)


def test_the_number_of_features_may_not_change():
    with pytest.raises(ValueError, match="features of state 1, action 'a' must be 1 finite numbers, as those of the"):
        MDP.from_function(lambda s: {"a": [(1.0, 1)]}, 0, discount=0.9, features=lambda s, a: [0.0] * (s + 1))


def test_where_every_state_ends_there_are_no_features():
    """Nobody can be asked how many there are."""
    mdp = MDP.from_function(lambda s: None, "x", discount=0.9, actions=["a", "b"], features=lambda s, a: [1.0])
    assert (mdp.num_states, mdp.num_actions, mdp.num_features) == (1, 2, 0)
    np.testing.assert_array_equal(mdp.transition, 1)


def test_errors_of_the_function_say_where():
    with pytest.raises(ZeroDivisionError) as caught:
        MDP.from_function(lambda s: {"a": [(1 / (2 - s), s + 1)]}, 1, discount=0.9)
    assert caught.value.__notes__ == ["in successors(2)"]
    with pytest.raises(ZeroDivisionError) as caught:
        MDP.from_function(lambda s: {"a": [(1.0, 2)]}, 1, discount=0.9, features=lambda s, a: [1 / (2 - s)])
    assert caught.value.__notes__ == ["in features(2, 'a')"]


def named(**names):
    return MDP.from_dense([[[0.5, 0.5]], [[0, 1]]], discount=0.9, **names)


def test_names_stay_with_the_model_on_the_host():
    mdp = named(state_names=["door", "room"], action_names=["go"])
    assert mdp.replace(discount=0.5).state_names == ("door", "room")
    assert pickle.loads(pickle.dumps(mdp)).action_names == ("go",)
    assert mdp.replace(state_names=[1, 2]).state_index(2) == 1
    assert mdp.replace(state_names=None).state_names is None
    assert named(state_names=np.array([[0, 1], [2, 3]])).state_names == ((0, 1), (2, 3))
    assert jax.jit(lambda model: model)(mdp).state_names is None  # what a program returns has none


def test_names_are_of_python_whatever_they_came_as():
    """What NumPy makes reads `np.int64(3)` in a text, and a file gives it back as one."""
    mdp = named(state_names=[(np.int64(0), (np.str_("door"),)), np.float64(0.5)], action_names=np.array(["go"]))
    assert repr((mdp.state_names, mdp.action_names)) == "(((0, ('door',)), 0.5), ('go',))"
    assert mdp.state_index(np.float64(0.5)) == 1 == mdp.state_index(0.5)
    assert repr(mdp.replace(state_names=np.arange(2, dtype=np.int32)[::-1].copy()).state_names) == "(1, 0)"


def test_models_that_differ_in_names_share_programs():
    traces = []
    run = jax.jit(lambda model: traces.append(1) or model.discount)
    for names in (["a", "b"], ["c", "d"], None):
        run(named(state_names=names))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"state_names": ["a"]}, "state_names must be 2 names, got 1"),
        ({"state_names": "ab"}, "state_names must be a sequence of names, got 'ab'"),
        ({"state_names": 2}, "state_names must be a sequence of names, got 2"),
        ({"state_names": ["a", "a"]}, r"state_names\[1\] must be new, got 'a' again, as \[0\]"),
        ({"state_names": [[1], [2]]}, r"state_names\[0\] must be hashable, got \[1\]"),
        ({"action_names": ["a", "b"]}, "action_names must be 1 names, got 2"),
    ],
)
def test_names_are_checked(names, message):
    with pytest.raises(ValueError, match=message):
        named(**names)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dor", "there is no state 'dor'; did you mean 'door'?"),
        ([1], r"there is no state \[1\]$"),
    ],
)
def test_names_are_looked_up(name, message):
    with pytest.raises(ValueError, match=message):
        named(state_names=["door", "room"]).state_index(name)
    with pytest.raises(ValueError, match=r"this model's actions have no names: build it with action_names="):
        jaxhom.gridworld(2).mdp.action_index(name)


def test_unions_keep_names():
    union = jaxhom.disjoint_union([named(state_names=["a", "b"], action_names=["go"])] * 2)
    assert union.mdp.state_names == ((0, "a"), (0, "b"), (1, "a"), (1, "b")) and union.mdp.action_names == ("go",)
    assert jaxhom.disjoint_union([named(), named(state_names=["a", "b"])]).mdp.state_names is None


def test_texts_use_names():
    """Errors, explanations, bounds and questions say what states and actions are called."""
    mdp = MDP.from_function(lake, (0, 0), discount=0.9, features=lambda place, move: [sum(place)])
    walk = ["right", "down"], [(0, 0), (0, 1)]
    indices = [mdp.state_index(place) for place in walk[1]], [mdp.action_index(move) for move in walk[0]]
    demonstrations = jaxhom.Demonstrations.from_trajectories([indices])
    general = jaxhom.soft_local_homomorphism(mdp, demonstrations)
    asked, voter = mdp.state_index((0, 2)), mdp.state_index((0, 1))
    text = str(general.explain(asked))
    assert text.startswith(f"State {asked} (0, 2): ") and "Policy down 1, by Algorithm 1" in text
    assert f"Map f from the local model of {asked} (0, 2)" in text and f"voter {voter} (0, 1): " in text
    bound = jaxhom.loss_bound(mdp, demonstrations, general)
    assert f"states that contribute most: {int(np.argmax(bound.contributions))} (" in str(bound)
    queries = jaxhom.query_states(mdp, demonstrations, general, 1)
    state = int(queries.states[0])
    assert f"state {state} {mdp.state_names[state]}: score" in str(queries)
    jump = jaxhom.Demonstrations.from_trajectories([([0, 15], [0, 0])])
    with pytest.raises(ValueError, match=r"state 0 \(0, 0\), action 0 'up', then state 15 \(3, 3\)"):
        jump.validate(mdp)


@pytest.mark.parametrize(
    ("fail", "message"),
    [
        (lambda mdp: jaxhom.policy_value(mdp, [[1, 0], [0.5, 0.4]], [[0, 0], [0, 0]]), "policy[1 'room'] must be 1,"),
        (
            lambda mdp: jaxhom.policy_value(mdp, [[1, 0], [2, -1]], [[0, 0], [0, 0]]),
            "policy[1 'room', 1 'go'] must not",
        ),
        (
            lambda mdp: jaxhom.feature_expectations(mdp, np.full((3, 2, 2), 0.5)),
            "policy[0, 0 'door', 1 'go'] is an action",
        ),
        (lambda mdp: jaxhom.optimal_policy(mdp, [[0, 0], [0, np.nan]]), "reward[1 'room', 1 'go'] must be finite"),
        (lambda mdp: mdp.replace(probability=0.9 * mdp.probability), "probability[0 'door', 0 'stay'] must be 1"),
        (
            lambda mdp: jaxhom.Demonstrations.from_trajectories([([1, 0], [1, 1])]).validate(mdp),
            "actions[0, 1] is not allowed in its state (index: trajectory, step), got 1: action 1 'go' in state 0",
        ),
    ],
)
def test_errors_in_arrays_use_names(fail, message):
    allowed = [[True, False], [True, True]]
    names = {"state_names": ["door", "room"], "action_names": ["stay", "go"]}
    mdp = MDP.from_dense(np.full((2, 2, 2), 0.5), discount=0.9, features=np.ones((2, 1)), allowed=allowed, **names)
    with pytest.raises(ValueError, match=re.escape(message)):
        fail(mdp)


def test_progress_counts_the_states_that_are_met(capsys):
    MDP.from_function(lake, (0, 0), discount=0.9, progress=True)
    last = capsys.readouterr().err.split("\r")[-1]
    assert "16 states" in last and "/" not in last.partition("[")[0]
