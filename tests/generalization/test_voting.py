"""Relations, voters and weights of Algorithm 1, state by state against set arithmetic; inside programs; explained."""

import functools

import jax
import numpy as np
import oracles
import pytest
from small_models import dense_transition

from jaxhom import MDP, Demonstrations, SimilarityTable, disjoint_union, gridworld, soft_local_homomorphism

WEIGHTED = {"voters": 2, "weights": "similarity", "threshold": 0.2}
RELATIONS = ["homomorphism", "isomorphic", "weisfeiler_lehman", "random_walk", "lax"]


@functools.cache
def world(name):
    """A model, demonstrations and labels."""
    rng = np.random.default_rng(2)
    if name == "grid":
        mdp = gridworld(6).mdp
        walks = [([0, 1, 2, 8, 14], [2, 2, 1, 1, 1]), ([35, 34, 33], [3, 3, 0]), ([20, 21], [2, 0])]
        goal = np.zeros((36, 1))
        goal[21] = 1.0
        return mdp, Demonstrations.from_trajectories(walks), goal
    transition = oracles.random_mdp(rng, 12, 3, N=2)[0]
    transition[6:] = transition[:6]  # so that some are alike
    transition[5, :] = np.eye(12)[5]  # absorbs
    allowed = rng.random((12, 3)) < 0.75
    allowed[:, 0] = True
    allowed[5] = True
    mdp = MDP.from_dense(transition, discount=0.9, allowed=allowed)
    actions = [int(rng.choice(np.flatnonzero(allowed[s]))) for s in (0, 1, 2, 3, 5)]
    walks = [([0, 1, 2], actions[:3]), ([3, 5], actions[3:]), ([1], [0])]
    with pytest.warns(UserWarning):  # impossible steps: what the expert did counts, not where it led
        Demonstrations.from_trajectories(walks)
        demonstrations = Demonstrations.from_trajectories(walks)
        soft_local_homomorphism(mdp, demonstrations)
    return mdp, demonstrations, rng.integers(0, 2, (12, 3, 1)) * 0.25


@functools.cache
def table_of(name, relation, *, is_labelled=False, label_weight=1.0):
    """A table that the tests share: what one of them has solved the others need not."""
    mdp, _, labels = world(name)
    options = {"labels": labels, "label_weight": label_weight} if is_labelled else {}
    return SimilarityTable(mdp, relation=relation, **options)


def by_brute_force(mdp, demonstrations, table, *, threshold=0.0, mutual=False, voters="nearest", weight=None):
    """(policy, radius, support), voter by voter, from the errors and renamings of a table."""
    transition, allowed = dense_transition(mdp), np.asarray(mdp.allowed)
    num_states, num_actions = allowed.shape
    visited, empirical = oracles.empirical_policy(num_states, num_actions, list(demonstrations))
    decides = np.flatnonzero(visited & ~oracles.absorbing(transition))
    uniform = allowed / allowed.sum(axis=1, keepdims=True)
    policy = np.where(visited[:, None], empirical, uniform)
    radius, support = np.where(visited, 0, -1), visited.astype(int)

    pairs = np.array([(s, expert) for s in np.flatnonzero(~visited) for expert in decides]).T
    upper, renamings = np.asarray(table.brackets(*pairs).upper), table.renamings(*pairs)
    if mutual:
        upper = np.maximum(upper, table.brackets(*pairs[::-1]).upper)
    number = {(int(s), int(expert)): place for place, (s, expert) in enumerate(pairs.T)}

    def ballot(s, expert):
        place = number[int(s), int(expert)]
        if upper[place] > threshold + 1e-4:
            return np.zeros(num_actions)
        votes = empirical[expert] if renamings is None else empirical[expert][renamings[place]]
        return votes * allowed[s] * (1.0 if weight is None else weight(float(upper[place])))

    for s in np.flatnonzero(~visited):
        within, found = {int(s)}, {}
        for t in range(1, num_states + 1):
            within = oracles.grow(transition, within)
            ring = decides if voters == "all" else [e for e in decides if e in within and e not in found]
            ballots = {e: ballot(s, e) for e in ring}
            voting = {e: votes for e, votes in ballots.items() if votes.any()}
            found |= voting
            if voting:
                radius[s] = t
            if voters == "all" or len(found) >= (1 if voters == "nearest" else voters):
                break
        if found:
            total = sum(found.values())
            policy[s], support[s] = total / total.sum(), len(found)
    return policy, radius, support


@pytest.mark.parametrize("name", ["grid", "random"])
@pytest.mark.parametrize("relation", RELATIONS)
@pytest.mark.parametrize("options", [{}, {"voters": 2}, {"voters": "all"}, {"mutual": True, "threshold": 0.3}], ids=str)
@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")
def test_who_votes(name, relation, options):
    mdp, demonstrations, _ = world(name)
    table = table_of(name, relation)
    general = soft_local_homomorphism(mdp, demonstrations, relation=relation, table=table, **options)
    policy, radius, support = by_brute_force(mdp, demonstrations, table, **options)
    np.testing.assert_array_equal(general.radius, radius)
    np.testing.assert_array_equal(general.support, support)
    np.testing.assert_allclose(general.policy, policy, atol=1e-12)
    assert general.status == 0


@pytest.mark.parametrize("name", ["grid", "random"])
@pytest.mark.parametrize("relation", ["homomorphism", "random_walk", "lax"])
@pytest.mark.parametrize("voters", ["nearest", 3, "all"])
@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")
def test_weights_and_labels(name, relation, voters):
    mdp, demonstrations, labels = world(name)
    options = {"labels": labels, "label_weight": 2.0, "relation": relation}
    table = table_of(name, relation, is_labelled=True, label_weight=2.0)
    rule = {"voters": voters, "threshold": 0.45, "weights": "similarity", "temperature": 0.2}
    general = soft_local_homomorphism(mdp, demonstrations, table=table, **options, **rule)
    weight = lambda error: np.exp(-error / 0.2)  # noqa: E731
    policy, radius, support = by_brute_force(mdp, demonstrations, table, threshold=0.45, voters=voters, weight=weight)
    np.testing.assert_array_equal(general.radius, radius)
    np.testing.assert_array_equal(general.support, support)
    np.testing.assert_allclose(general.policy, policy, atol=1e-3)  # errors are known to 1e-4


@pytest.mark.parametrize("name", ["grid", "random"])
@pytest.mark.parametrize(
    "options",
    [
        {"relation": "lax"},
        {"relation": "lax", "voters": 2, "mutual": True},
        {"relation": "lax", "voters": "all", "weights": "similarity", "threshold": 0.3},
        {"relation": "random_walk", "voters": 2, "threshold": 0.1, "weights": "similarity"},
        {"relation": "isomorphic", "voters": "all"},
        {"voters": "all", "threshold": 0.3, "weights": "similarity"},
        {"voters": 3},
    ],
    ids=str,
)
@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")
def test_the_same_inside_programs(name, options):
    mdp, demonstrations, labels = world(name)
    weighted = options.get("weights") == "similarity"
    table = table_of(name, options.get("relation", "homomorphism"), is_labelled=True)
    table.complete(options.get("threshold", 0.0), with_errors=weighted)
    learn = functools.partial(soft_local_homomorphism, mdp, labels=labels, table=table, **options)
    inside, outside = jax.jit(learn)(demonstrations), learn(demonstrations)
    np.testing.assert_array_equal(inside.radius, outside.radius)
    np.testing.assert_array_equal(inside.support, outside.support)
    np.testing.assert_allclose(inside.policy, outside.policy, atol=1e-12)
    batched = jax.vmap(learn)(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), demonstrations))
    np.testing.assert_allclose(batched.policy, np.stack([outside.policy] * 2), atol=1e-12)


@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")
def test_weights_inside_programs_need_errors():
    mdp, demonstrations, labels = world("random")
    table = SimilarityTable(mdp, labels=labels).complete(0.8)
    options = {"table": table, "threshold": 0.8, "weights": "similarity"}
    learn = functools.partial(soft_local_homomorphism, mdp, labels=labels, **options)
    with pytest.raises(ValueError, match=r"call table.complete\(threshold=0.8, with_errors=True\) first"):
        jax.jit(learn)(demonstrations)


@pytest.mark.parametrize("name", ["grid", "random"])
@pytest.mark.parametrize("relation", RELATIONS)
@pytest.mark.parametrize(
    "rule", [{}, {"voters": 2, "weights": "similarity", "threshold": 0.2}, {"voters": "all"}], ids=str
)
@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")
def test_explanations_add_up(name, relation, rule):
    mdp, demonstrations, labels = world(name)
    table = table_of(name, relation, is_labelled=True)
    general = soft_local_homomorphism(mdp, demonstrations, relation=relation, labels=labels, table=table, **rule)
    for state in range(mdp.num_states):
        why = general.explain(state)
        assert len(why.voters) == general.support[state]
        if not len(why.voters):
            continue
        np.testing.assert_allclose(why.weights @ why.voter_policies, general.policy[state], atol=1e-4)
        if general.visited[state]:
            continue
        assert (why.forward is None) == (relation not in ("homomorphism", "lax"))
        assert (why.renamings is None) == (relation != "lax")
        assert np.all(why.upper <= rule.get("threshold", 0.0) + 2e-4)
        text = str(why)
        assert "error e" in text and (relation == "homomorphism" or relation in text) and "1 label" in text
        if relation == "lax":
            assert "its actions renamed" in text


def test_renamed_votes_turn_a_walk_around_the_board():
    """Along the upper border the expert goes right; with actions renamed, the other borders go round too."""
    grid = gridworld(6)
    shown = Demonstrations.from_trajectories([([1, 2, 3, 4], [2, 2, 2, 2])])
    strict = soft_local_homomorphism(grid, shown)
    lax = soft_local_homomorphism(grid, shown, relation="lax", voters="all")
    border = np.array([6, 12, 11, 17, 31, 32])
    assert np.all(strict.radius[border] == -1)
    assert np.all(lax.radius[border] == 1)
    assert np.allclose(np.asarray(lax.policy)[border].max(axis=1), 1.0)  # one action, along the border
    along = {0: [2, 3], 6: [0, 1], 11: [0, 1], 31: [2, 3]}
    for state in border:
        column, row = state % 6, state // 6
        wall = along[6] if column in (0, 5) else along[31]
        assert int(np.asarray(lax.policy)[state].argmax()) in wall, (row, column)


def test_demonstrations_in_one_model_vote_in_another():
    union = disjoint_union([gridworld(5), gridworld(7)])
    shown = union.place(0, Demonstrations.from_trajectories([([0, 1, 2], [2, 2, 2]), ([12, 7], [0, 0])]))
    near = soft_local_homomorphism(union, shown)
    everywhere = soft_local_homomorphism(union, shown, voters="all")
    other = union.states(1)
    assert np.all(near.radius[other] == -1)
    corner, border = np.asarray(everywhere.policy[other])[[0, 1]]
    np.testing.assert_allclose(corner, np.eye(4)[2], atol=1e-12)
    np.testing.assert_allclose(border, np.eye(4)[2], atol=1e-12)
    assert "wherever they are" in str(everywhere.explain(union.offsets[1] + 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voters": "some"}, 'voters must be "nearest", "all" or a number, got \'some\''),
        ({"voters": 0}, "voters must be"),
        ({"voters": 1.5}, "voters must be"),
        ({"weights": "error"}, "weights must be one of .*, got 'error'"),
        ({"temperature": 0.0}, "temperature must be positive and finite, got 0.0"),
        ({"temperature": np.inf}, "temperature must be positive"),
        ({"relation": "none"}, "relation must be one of"),
        ({"threshold": -1.0}, "threshold must not be negative"),
    ],
)
def test_options_out_of_range(options, message):
    mdp, demonstrations, _ = world("grid")
    with pytest.raises(ValueError, match=message):
        soft_local_homomorphism(mdp, demonstrations, **options)


def test_everybody_at_an_infinite_threshold():
    mdp, demonstrations, _ = world("grid")
    general = soft_local_homomorphism(mdp, demonstrations, threshold=np.inf, voters="all", weights="similarity")
    assert np.all(general.support[~np.asarray(general.visited)] == np.asarray(general.visited).sum())
    weighed = [mdp.num_states - np.asarray(general.visited).sum()]
    assert weighed[0] > 0 and np.allclose(np.asarray(general.policy).sum(axis=1), 1.0)


@functools.cache
def completed(dtype):
    """A model whose states all differ, and a table of all its errors."""
    transition = oracles.random_mdp(np.random.default_rng(0), 12, 2, N=2)[0].astype(dtype)
    mdp = MDP.from_dense(transition, discount=0.9)
    return mdp, SimilarityTable(mdp).complete(1.0, with_errors=True, tolerance=1e-3)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("voters", ["nearest", 2, "all"])
@pytest.mark.parametrize("temperature", [1e-5, 1e-3, 1e3])
def test_weights_never_vanish(dtype, voters, temperature):
    """However low the temperature: the most similar voter decides, on the host and inside programs."""
    mdp, table = completed(dtype)
    shown = Demonstrations.from_trajectories([([0, 1, 2], [0, 1, 0])])
    rule = {"threshold": 1.0, "voters": voters, "weights": "similarity", "temperature": temperature, "tolerance": 1e-3}
    learn = functools.partial(soft_local_homomorphism, mdp, table=table, **rule)
    with pytest.warns(UserWarning):
        inside, outside = jax.jit(learn)(shown), learn(shown)
    np.testing.assert_array_equal(inside.support, outside.support)
    np.testing.assert_array_equal(inside.radius, outside.radius)
    np.testing.assert_allclose(inside.policy, outside.policy, atol=1e-5)
    plain = soft_local_homomorphism(mdp, shown, table=table, **{**rule, "weights": "equal"})
    np.testing.assert_array_equal(outside.support, plain.support)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temperature": "0.5"}, "temperature must be a number, got '0.5'"),
        ({"threshold": None}, "threshold must be a number, got None"),
        ({"tolerance": [0.1]}, r"tolerance must be a number, got \[0.1\]"),
        ({"voters": True}, "voters must be a whole number, got True"),
        ({"states": np.arange(36)}, "states must be a mask of booleans"),
        ({"states": [True]}, r"states must have shape \(36,\)"),
    ],
)
def test_options_of_other_kinds(options, message):
    mdp, demonstrations, _ = world("grid")
    with pytest.raises(ValueError, match=message):
        soft_local_homomorphism(mdp, demonstrations, **options)


def test_numbers_of_any_kind():
    mdp, demonstrations, _ = world("grid")
    options = {"voters": np.array(2), "threshold": np.float32(0.25), "temperature": np.array(0.5)}
    assert soft_local_homomorphism(mdp, demonstrations, weights="similarity", **options).status == 0
