"""Where to ask next: scores against plain NumPy, changes against policies that are changed, loops with an expert."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

import jaxhom
from jaxhom import Demonstrations, Queries, query_states
from jaxhom.guarantees.queries import CRITERIA
from jaxhom.models.mdp import MDP

CASES = ("dense", "sparse", "restart", "absorbing", "slow_ring", "restricted")
WALK = [([0, 1], [0, 0])]


@functools.cache
def problem(name):
    """A model, demonstrations, a policy; and the arrays that the oracles take."""
    if name == "restricted":
        rng = np.random.default_rng(11)
        transition, discount, initial, features = oracles.random_mdp(rng, 12, 3, N=3, K=2)
        allowed = rng.random((12, 3)) < 0.6
        allowed[:, 0] = True
        mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features, allowed=allowed)
        case = small_models.Case(name, mdp, transition, discount, initial, features)
    else:
        case = small_models.slow_ring() if name == "slow_ring" else small_models.case(name)
    policy = small_models.random_policy(np.random.default_rng(5), *case.shape) * np.asarray(case.mdp.allowed)
    policy[::3] = np.eye(case.shape[1])[0]
    return case, Demonstrations.from_trajectories(WALK), policy / policy.sum(axis=1, keepdims=True)


def plain_scores(name, criterion):
    """Scores by a dense solve, and 0 where nothing is to be asked."""
    case, _, policy = problem(name)
    mu = oracles.occupancy(case.transition, case.discount, case.initial, policy).sum(axis=1)
    entropy = np.array([-sum(p * np.log(p) for p in row if p > 0) for row in policy])
    score = mu if criterion == "visits" else mu * (entropy + 0.05)
    if criterion == "bound":
        score = np.maximum(jaxhom.loss_bound(case.mdp, problem(name)[1], policy).contributions, 0)
    free = ~np.isin(np.arange(len(mu)), WALK[0][0]) & ~oracles.absorbing(case.transition)
    return np.where(free & (np.asarray(case.mdp.allowed).sum(axis=1) > 1), score, 0.0)


def changed(name, state, action):
    """V [K] of the policy that does `action` in `state`, less V of the policy."""
    case, _, policy = problem(name)
    other = policy.copy()
    other[state] = np.eye(policy.shape[1])[action]
    return oracles.feature_expectations(*case.arrays, other) - oracles.feature_expectations(*case.arrays, policy)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("name", CASES)
def test_the_highest_scores_are_asked_about(name, criterion):
    case, shown, policy = problem(name)
    expected = plain_scores(name, criterion)
    most = expected > (1e-9 / (1 - case.discount) if criterion != "bound" else 0)
    queries = query_states(case.mdp, shown, policy, 4, criterion=criterion)
    assert len(queries.states) == min(4, most.sum())
    np.testing.assert_allclose(queries.scores, np.sort(expected)[::-1][: len(queries.scores)], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(expected[queries.states], queries.scores, rtol=1e-8, atol=1e-10)
    everything = query_states(case.mdp, shown, policy, 10**6, criterion=criterion)
    np.testing.assert_array_equal(np.sort(everything.states), np.flatnonzero(most))


@pytest.mark.parametrize("name", CASES)
def test_changes_are_those_of_policies_that_are_changed(name):
    """More states than are computed at once, where there are as many."""
    case, shown, policy = problem(name)
    queries = query_states(case.mdp, shown, policy, 20, criterion="visits")
    for state, change in zip(queries.states, queries.changes, strict=True):
        actions = np.flatnonzero(np.asarray(case.mdp.allowed)[state])
        brute = max(np.abs(changed(name, state, action)).max() for action in actions)
        np.testing.assert_allclose(change, brute, rtol=1e-7, atol=1e-10)


def test_no_change_is_larger_for_any_weights():
    """Over the simplex the largest change of w . V is that of one feature."""
    case, shown, policy = problem("sparse")
    queries = query_states(case.mdp, shown, policy, 1)
    weights = np.random.default_rng(0).dirichlet(np.ones(case.features.shape[-1]), 50)
    for action in range(case.shape[1]):
        assert np.abs(weights @ changed("sparse", queries.states[0], action)).max() <= queries.changes[0] + 1e-12


@pytest.mark.parametrize(
    ("name", "criterion"), [("sparse", "visits_entropy"), ("absorbing", "visits"), ("restricted", "visits_entropy")]
)
def test_programs_find_what_the_host_finds(name, criterion):
    case, shown, policy = problem(name)
    ask = functools.partial(query_states, count=5, criterion=criterion)
    plain = ask(case.mdp, shown, policy)
    number = len(plain.states)
    policies = jnp.stack([policy, policy])
    program = jax.jit(lambda policy: ask(case.mdp, shown, policy))(jnp.asarray(policy))
    lanes = jax.vmap(lambda policy: ask(case.mdp, shown, policy))(policies)
    for found in (program, jax.tree.map(lambda leaf: leaf[1], lanes)):
        assert found.states.shape == (5,)
        np.testing.assert_array_equal(found.states[:number], plain.states)
        np.testing.assert_allclose(found.scores[:number], plain.scores, rtol=1e-6)
        np.testing.assert_allclose(found.changes[:number], plain.changes, rtol=1e-5, atol=1e-8)
        assert (found.states[number:] == -1).all()
        assert not found.scores[number:].any() and not found.changes[number:].any()
    inside = jax.jit(lambda shown: ask(case.mdp, shown, policy))(shown)
    np.testing.assert_array_equal(inside.states[:number], plain.states)


def test_ties_go_to_the_lowest_state():
    ahead = np.zeros((6, 2, 6))
    ahead[0, :, 1:5] = 0.25  # four states that are met alike
    ahead[1:, :, 5] = 1.0
    mdp = MDP.from_dense(ahead, discount=0.9, initial=np.eye(6)[0])
    shown = Demonstrations.from_trajectories([([0], [0])])
    uniform = np.full((6, 2), 0.5)
    for states in (query_states(mdp, shown, uniform, 3).states, jax.jit(query_program(mdp, shown))(uniform)):
        assert states.tolist() == [1, 2, 3]
    assert query_states(mdp, shown, uniform, 9).changes is None


def query_program(mdp, shown):
    return lambda policy: query_states(mdp, shown, policy, 3).states


def test_what_may_not_be_asked():
    """Demonstrated, absorbing, terminal states, those of one action, and where the policy never comes."""
    step = np.eye(7)[[[1, 1], [2, 2], [3, 4], [0, 0], [4, 4], [5, 6], [6, 5]]]
    allowed = np.ones((7, 2), bool)
    allowed[3, 1] = False
    mdp = MDP.from_dense(step, discount=0.9, initial=np.eye(7)[0], allowed=allowed)
    shown = Demonstrations.from_trajectories([([0], [0])])
    policy = allowed / allowed.sum(axis=1, keepdims=True)
    assert query_states(mdp, shown, policy, 9).states.tolist() == [1, 2]
    terminal = np.arange(7) == 1
    assert query_states(mdp, shown, policy, 9, terminal=terminal).states.tolist() == [2]
    nothing = query_states(mdp, shown.with_answers([2], [0]), policy, 9, terminal=terminal)
    assert nothing.states.shape == (0,) and "nothing to ask" in str(nothing)


def test_one_action_is_no_question():
    mdp = small_models.case("one_action").mdp
    assert not query_states(mdp, Demonstrations.from_trajectories([([0], [0])]), np.zeros(5, int), 3).states.size


def test_it_prints_states_scores_and_changes():
    case, shown, policy = problem("dense")
    queries = query_states(case.mdp, shown, policy, 2)
    first, *lines = str(queries).splitlines()
    assert "visits_entropy" in first and len(lines) == 2
    assert f"state {queries.states[0]}: score {queries.scores[0]:.4g}" in lines[0]
    assert f"{queries.changes[0]:.4g}" in lines[0]
    assert repr(queries).startswith("Queries(states=int32[2]") and len(repr(queries)) < 200
    assert isinstance(jax.tree.map(lambda leaf: leaf, queries), Queries)
    assert int(query_states(case.mdp, shown, policy, 2, criterion="bound").status) == jaxhom.Status.SOLVED


def test_float32_and_what_has_a_policy():
    case, shown, policy = problem("sparse")
    rounded = small_models.in_float32(case)
    single, double = (query_states(m, shown, policy.astype(np.float32), 4) for m in (rounded.mdp, case.mdp))
    chex.assert_type([single.scores, single.changes], jnp.float32)
    np.testing.assert_array_equal(single.states, double.states)
    np.testing.assert_allclose(single.changes, double.changes, rtol=1e-4)
    general = jaxhom.uniform_elsewhere(case.mdp, shown)
    chex.assert_trees_all_equal(
        query_states(case.mdp, shown, general, 3), query_states(case.mdp, shown, general.policy, 3)
    )


REFUSED = {
    "count": ({"count": 0}, "count must be at least 1, got 0"),
    "count, a fraction": ({"count": 1.5}, "count must be a whole number"),
    "criterion": ({"criterion": "entropy"}, "criterion must be one of visits_entropy, visits, bound, got 'entropy'"),
    "criterion, a number": ({"criterion": 3}, "criterion must be one of"),
    "terminal, shape": ({"terminal": np.zeros(3, bool)}, r"terminal.*\(7,\)"),
    "terminal, numbers": ({"terminal": np.zeros(7, int)}, "terminal must be bool"),
    "policy, shape": ({"policy": np.ones((2, 3)) / 3}, "policy"),
    "policy, rows": ({"policy": np.ones((7, 3))}, r"sum of policy\[0\] must be 1"),
    "policy, a batch": ({"policy": np.ones((2, 7, 3)) / 3}, "policy"),
    "demonstrations": ({"demonstrations": Demonstrations.from_trajectories([([9], [0])])}, r"states\[0, 0\]"),
    "model": ({"mdp": 3}, "jaxhom.MDP is needed"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_malformed_questions_are_refused(name):
    case, shown, policy = problem("dense")
    changes, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        query_states(**{"mdp": case.mdp, "demonstrations": shown, "policy": policy, "count": 2, **changes})


def test_the_bound_needs_features_and_the_host():
    case, shown, policy = problem("dense")
    bare = case.mdp.replace(features=np.zeros((7, 3, 0)))
    with pytest.raises(ValueError, match="no features"):
        query_states(bare, shown, policy, 2, criterion="bound")
    with pytest.raises(ValueError, match="outside jit, vmap and grad"):
        jax.jit(lambda policy: query_states(case.mdp, shown, policy, 2, criterion="bound"))(policy)


def rounds(grid, reward, plan, shown, choose, number):
    """What the learned policy is worth as a share of the expert's, before any answer and after each round."""
    best, shares = float(plan.value @ grid.mdp.initial), []
    actions = np.argmax(plan.policy, axis=1)
    for _ in range(number + 1):
        general = jaxhom.soft_local_homomorphism(grid, shown)
        value = jaxhom.policy_value(grid, general, reward) @ grid.mdp.initial
        shares.append(float(value) / best)
        states = choose(shown, general)
        shown = shown.with_answers(states, actions[states])
    return shares


@pytest.mark.parametrize("criterion", ["visits", "visits_entropy"])
def test_few_answers_lead_to_the_expert_and_random_ones_do_not(criterion):
    grid = jaxhom.gridworld(8, num_regions=16, discount=0.95)
    reward = grid.mdp.features @ jaxhom.sample_weights(jax.random.key(1), 16)
    plan = jaxhom.optimal_policy(grid, reward)
    shown = jaxhom.sample_demonstrations(jax.random.key(0), grid, plan, 1, 10)
    rng = np.random.default_rng(0)

    def at_random(shown, general):
        return rng.choice(np.setdiff1d(np.arange(64), np.asarray(shown.states)[np.asarray(shown.mask)]), 5, False)

    def asked(shown, general):
        return np.asarray(query_states(grid, shown, general, 5, criterion=criterion).states)

    by_queries = rounds(grid, reward, plan, shown, asked, 6)
    by_chance = rounds(grid, reward, plan, shown, at_random, 6)
    assert by_queries[0] == by_chance[0] < 0.95
    assert by_queries[-1] > 0.9999
    assert by_chance[-1] < by_queries[-1] - 0.01
