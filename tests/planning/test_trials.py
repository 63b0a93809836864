"""Evaluation, held to the oracle's scan, to answers known by hand, and to itself by sampling."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxhom.domains.racetrack import racetrack
from jaxhom.models.dense_tensor import DenseTensor
from jaxhom.models.mdp import MDP
from jaxhom.planning import trials as evaluation
from jaxhom.planning.occupancy import policy_value
from jaxhom.planning.optimal import optimal_policy
from jaxhom.planning.trials import agreement, evaluate_by_sampling, evaluate_exactly

S, A, B, H = 12, 3, 4, 6  # one horizon and one number of trials for most tests: compiled once
TRIALS = 2000
SCALARS = ("reward_per_step", "total_reward", "steps", "finished")


@pytest.fixture(scope="module")
def case():
    """A sparse model in NumPy and as an `MDP`, a batch of policies and of rewards, two events."""
    rng = np.random.default_rng(3)
    transition, discount, initial, _ = oracles.random_mdp(rng, S, A, N=2)
    terminal = np.zeros(S, bool)
    terminal[[2, 7]] = True
    return {
        "numpy": (transition, initial),
        "mdp": MDP.from_dense(transition, discount=discount, initial=initial),
        "policies": rng.dirichlet(np.ones(A), size=(B, S)),
        "rewards": rng.normal(size=(B, S, A)),
        "options": {
            "terminal": terminal,
            "events": {"bump": rng.uniform(size=(S, A)), "turn": rng.uniform(size=(S, A))},
        },
    }


@pytest.fixture(scope="module")
def track():
    """What to evaluate on track (a): the expert, trials of 30 steps, the restart step counted."""
    track = racetrack("a")
    reward = track.mdp.features @ track.weights
    options = {
        "terminal": track.terminal,
        "events": {"off_road": track.off_road},
        "count_terminal_step": True,
    }
    return (track.mdp, optimal_policy(track.mdp, reward).policy, reward, 30), options


def chain(num_states):
    """State s goes to s + 1 from state 0 on; the last state stays."""
    transition = np.eye(num_states)[np.minimum(np.arange(num_states) + 1, num_states - 1)]
    return MDP.from_dense(transition[:, None], discount=0.9, initial=np.eye(num_states)[0])


def slow_evaluation(case, policy, reward, horizon, terminal, count_terminal_step=False):
    """The measures by the oracle, whose trials never take a step in a terminal state.

    Where that step counts, terminal states are open to the oracle, and lead to a closed one.
    """
    transition, initial = case["numpy"]
    events = case["options"]["events"]
    absorbing = np.where(terminal[:, None, None], np.eye(S)[:, None], transition)
    chain = np.linalg.matrix_power(np.einsum("sa,sat->st", policy, absorbing), horizon)
    finished = (initial @ chain)[terminal].sum()
    if count_terminal_step:
        closed = np.eye(S + 1)[S]
        transition = np.pad(transition, ((0, 1), (0, 0), (0, 1)))
        transition[S], transition[:S][terminal] = closed, closed
        initial, terminal = np.append(initial, 0.0), closed > 0
        policy = np.vstack([policy, np.full(A, 1 / A)])
        reward, *padded = (np.pad(x, ((0, 1), (0, 0))) for x in (reward, *events.values()))
        events = dict(zip(events, padded, strict=True))
    measures = oracles.finite_horizon_evaluation(transition, initial, policy, reward, horizon, terminal, events)
    total_reward = measures["reward_per_step"] * measures["steps"]
    return measures | {"total_reward": total_reward, "finished": finished}


def assert_agrees(ours, expected):
    assert ours.standard_error is None
    for name in SCALARS:
        np.testing.assert_allclose(ours[name], expected[name], rtol=1e-9, err_msg=name)
    for name, value in ours.events.items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-9, err_msg=name)


def lane(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


# -------------------------------------------------------------------------------------- exactly


@pytest.mark.parametrize("horizon", [1, H])
@pytest.mark.parametrize("count_terminal_step", [False, True])
def test_exact_evaluation_agrees_with_the_oracle(case, horizon, count_terminal_step):
    arguments = (case["policies"][0], case["rewards"][0], horizon)
    options = case["options"] | {"count_terminal_step": count_terminal_step}
    ours = evaluate_exactly(case["mdp"], *arguments, **options)
    assert set(ours.events) == {"bump", "turn"}
    terminal = case["options"]["terminal"]
    assert_agrees(ours, slow_evaluation(case, *arguments, terminal, count_terminal_step))


def test_without_terminal_states_every_trial_takes_all_steps(case):
    arguments = (case["policies"][0], case["rewards"][0], H)
    ours = evaluate_exactly(case["mdp"], *arguments, events=case["options"]["events"])
    assert_agrees(ours, slow_evaluation(case, *arguments, np.zeros(S, bool)))
    np.testing.assert_allclose([ours.steps, ours.finished], [H, 0.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("goal", "count", "steps", "finished"),
    [(4, True, 3, 0), (3, False, 3, 1), (3, True, 3, 1), (2, False, 2, 1), (2, True, 3, 1)],
)
def test_a_chain_by_hand(goal, count, steps, finished):
    rewards = np.array([[1.0], [2.0], [10.0], [20.0], [30.0]])
    arguments = (chain(5), np.ones((5, 1)), rewards, 3)
    options = {"terminal": np.arange(5) == goal, "count_terminal_step": count}
    exact = evaluate_exactly(*arguments, **options)
    sampled = evaluate_by_sampling(jax.random.key(0), *arguments, num_trials=2, **options)
    for ours in (exact, sampled):
        assert (float(ours.steps), float(ours.finished)) == (steps, finished)
        assert float(ours.total_reward) == rewards[:steps].sum()
    assert not any(jax.tree.leaves(sampled.standard_error))


def test_trials_that_start_in_a_terminal_state_take_no_step():
    ours = evaluate_exactly(chain(2), np.ones((2, 1)), np.ones((2, 1)), 5, terminal=np.ones(2, bool))
    assert (float(ours.steps), float(ours.total_reward), float(ours.finished)) == (0, 0, 1)
    assert np.isnan(ours.reward_per_step)


def test_the_experts_lap_of_track_a_is_the_papers(track):
    arguments, options = track
    ours = evaluate_exactly(*arguments, **options)
    np.testing.assert_allclose([ours.steps, ours.reward_per_step], [20.86, 13.99], atol=0.01)
    np.testing.assert_allclose([ours.finished, ours.events["off_road"]], [1.0, 0.0233], atol=1e-4)


# ------------------------------------------------------------------------------------- sampling


def within_errors(sampled, exact, number=4.0):
    """Whether every measure lies within `number` standard errors of the exact one."""
    error = sampled.standard_error
    sampled = sampled.replace(standard_error=None)
    exceeds = jax.tree.map(
        lambda mean, truth, error: np.abs(mean - truth) > number * error + 1e-9,
        sampled,
        exact,
        error,
    )
    return not any(np.any(leaf) for leaf in jax.tree.leaves(exceeds))


@pytest.mark.parametrize("count_terminal_step", [False, True])
def test_sampling_is_within_four_standard_errors(case, count_terminal_step):
    arguments = (case["mdp"], case["policies"][0], case["rewards"][0], H)
    options = case["options"] | {"count_terminal_step": count_terminal_step}
    sampled = evaluate_by_sampling(jax.random.key(1), *arguments, num_trials=TRIALS, **options)
    exact = evaluate_exactly(*arguments, **options)
    assert within_errors(sampled, exact)
    assert not within_errors(sampled, exact, number=0.01)
    options["count_terminal_step"] = not count_terminal_step
    assert not within_errors(sampled, evaluate_exactly(*arguments, **options))


def test_standard_errors_are_the_spread_of_repeated_estimates(case):
    arguments = (case["mdp"], case["policies"][0], case["rewards"][0], H)

    keys = jax.random.split(jax.random.key(2), 80)
    options = {"num_trials": TRIALS, **case["options"]}
    estimates = [evaluate_by_sampling(key, *arguments, **options) for key in keys]
    estimates = jax.tree.map(lambda *leaves: np.stack(leaves), *estimates)
    spread = jax.tree.map(np.std, estimates.replace(standard_error=None))
    claimed = jax.tree.map(np.mean, estimates.standard_error)
    chex.assert_trees_all_close(spread, claimed, rtol=0.25)


def test_sampling_on_the_racetrack(track):
    arguments, options = track
    sampled = evaluate_by_sampling(jax.random.key(0), *arguments, **options)
    assert within_errors(sampled, evaluate_exactly(*arguments, **options))


# ------------------------------------------------------------------------- batches, jit, gradients


def test_a_batch_is_its_lanes(case):
    key, options = jax.random.key(5), case["options"] | {"count_terminal_step": True}
    batch = (case["mdp"], case["policies"], case["rewards"], H)
    exact = evaluate_exactly(*batch, **options)
    sampled = evaluate_by_sampling(key, *batch, num_trials=TRIALS, **options)
    chex.assert_tree_shape_prefix((exact, sampled), (B,))
    for b in range(B):
        single = (case["mdp"], case["policies"][b], case["rewards"][b], H)
        ours = evaluate_exactly(*single, **options)
        chex.assert_trees_all_close(lane(exact, b), ours, rtol=1e-9)
        ours = evaluate_by_sampling(key, *single, num_trials=TRIALS, **options)
        chex.assert_trees_all_close(lane(sampled, b), ours, rtol=1e-9)


def test_one_reward_serves_a_batch_of_policies(case):
    one, key = case["rewards"][0], jax.random.key(5)
    for evaluate in (
        evaluate_exactly,
        lambda *batch: evaluate_by_sampling(key, *batch, num_trials=TRIALS),
    ):
        shared = evaluate(case["mdp"], case["policies"], one, H)
        repeated = evaluate(case["mdp"], case["policies"], np.stack([one] * B), H)
        chex.assert_trees_all_close(shared, repeated, rtol=1e-9)


def test_the_dense_layout_is_the_sparse_one(case):
    transition, _ = case["numpy"]
    states = jnp.broadcast_to(jnp.arange(S), transition.shape)
    dynamics = DenseTensor(next_state=states, probability=jnp.asarray(transition))
    dense = dataclasses.replace(case["mdp"], dynamics=dynamics)
    assert dense.is_dense
    assert not case["mdp"].is_dense
    for policy in (case["policies"], case["policies"][0]):
        arguments = (policy, case["rewards"][0], H)
        ours = evaluate_exactly(dense, *arguments, **case["options"])
        sparse = evaluate_exactly(case["mdp"], *arguments, **case["options"])
        chex.assert_trees_all_close(ours, sparse, rtol=1e-9)


def test_under_jit_and_vmap(case):
    def evaluate(policy, reward):
        arguments = (case["mdp"], policy, reward, H)
        sampled = evaluate_by_sampling(jax.random.key(0), *arguments, num_trials=TRIALS, **case["options"])
        weighted = agreement(case["mdp"], policy, case["policies"][0], weights=reward[:, 0] ** 2)
        return evaluate_exactly(*arguments, **case["options"]), sampled, weighted

    eager = evaluate(case["policies"][1], case["rewards"][1])
    lanes = jax.jit(jax.vmap(evaluate))(case["policies"], case["rewards"])
    chex.assert_trees_all_close(lane(lanes, 1), eager, rtol=1e-9)


def test_policies_of_one_shape_are_compiled_once(case):
    def evaluate(index):
        arguments = (case["mdp"], case["policies"][index], case["rewards"][index], H)
        evaluate_exactly(*arguments, **case["options"])
        evaluate_by_sampling(jax.random.key(index), *arguments, num_trials=TRIALS, **case["options"])

    jitted = (evaluation._evaluate_visits, evaluation._evaluate_trials)
    evaluate(0)
    compiled = [function._cache_size() for function in jitted]
    for index in range(B):
        evaluate(index)
    assert [function._cache_size() for function in jitted] == compiled


def test_gradient_against_finite_differences(case):
    def reward_per_step(policy):
        arguments = (case["mdp"], policy, case["rewards"][0], H)
        return evaluate_exactly(*arguments, **case["options"]).reward_per_step

    policy = jnp.asarray(case["policies"][0])
    direction = np.random.default_rng(0).normal(size=(S, A))
    direction -= direction.mean(axis=1, keepdims=True)
    slope = jnp.vdot(jax.grad(reward_per_step)(policy), direction)
    h = 1e-5
    ends = [reward_per_step(policy + sign * h * direction) for sign in (1, -1)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-6)


def test_the_same_key_gives_the_same_trials(case):
    arguments = (case["mdp"], case["policies"][0], case["rewards"][0], H)
    first, again, other = (
        evaluate_by_sampling(jax.random.key(seed), *arguments, num_trials=TRIALS, **case["options"]).total_reward
        for seed in (1, 1, 2)
    )
    assert float(first) == float(again) != float(other)


def test_float32_stays_float32(case):
    transition, initial = case["numpy"]
    mdp = MDP.from_dense(transition.astype(np.float32), discount=0.9, initial=initial)
    arguments = (case["policies"][0], case["rewards"][0], H)
    exact = evaluate_exactly(mdp, *arguments, **case["options"])
    assert {leaf.dtype for leaf in jax.tree.leaves(exact)} == {np.dtype(np.float32)}
    sampled = jax.eval_shape(
        lambda key: evaluate_by_sampling(key, mdp, *arguments, **case["options"]),
        jax.random.key(0),
    )
    assert {leaf.dtype for leaf in jax.tree.leaves(sampled)} == {np.dtype(np.float32)}
    expected = evaluate_exactly(case["mdp"], *arguments, **case["options"])
    chex.assert_trees_all_close(exact, jax.tree.map(np.float32, expected), rtol=1e-5)


# ------------------------------------------------------------------------------------ agreement


def test_agreement_of_deterministic_policies_is_the_share_of_equal_actions(case):
    mdp = case["mdp"]
    differs = np.arange(S) % 4 == 1
    expert, other = np.eye(A)[np.zeros(S, int)], np.eye(A)[differs.astype(int)]
    weights = np.arange(S, dtype=float)
    np.testing.assert_allclose(agreement(mdp, other, expert), 0.75, rtol=1e-12)
    expected = weights[~differs].sum() / weights.sum()
    np.testing.assert_allclose(agreement(mdp, other, expert, weights), expected, rtol=1e-12)


def test_agreement_is_one_minus_total_variation(case):
    mdp, policies = case["mdp"], case["policies"]
    expected = 1 - 0.5 * np.abs(policies - policies[0]).sum(axis=-1).mean(axis=-1)
    ours = agreement(mdp, policies, policies[0])
    assert ours.shape == (B,)
    np.testing.assert_allclose(ours, expected, rtol=1e-12)
    np.testing.assert_allclose(agreement(mdp, policies[0], policies), expected, rtol=1e-12)
    weights = np.random.default_rng(0).uniform(size=(B, S))
    singles = [agreement(mdp, policies[b], policies[0], weights[b] / weights[b].sum()) for b in range(B)]
    np.testing.assert_allclose(agreement(mdp, policies, policies[0], weights), singles, rtol=1e-12)


# -------------------------------------------------------------------------------- malformed input

MALFORMED = {
    "policy of another size": ({"policy": np.ones((S, A + 1))}, "policy must have shape"),
    "policy of one state": ({"policy": np.ones(A)}, "policy must have shape"),
    "reward of states": ({"reward": np.ones(S)}, "reward must have shape"),
    "reward batch of its own": ({"reward": np.ones((B, S, A))}, "reward must have shape"),
    "reward batch of another size": (
        {"policy": np.ones((B, S, A)), "reward": np.ones((B + 1, S, A))},
        "reward must have shape",
    ),
    "terminal of another size": ({"terminal": np.ones(S + 1, bool)}, "terminal must have shape"),
    "terminal as indices": ({"terminal": np.arange(S)}, "terminal must be bool"),
    "event of states": ({"events": {"bump": np.ones(S)}}, r"events\['bump'\] must have shape"),
    "event that is no number": (
        {"events": {"bump": np.full((S, A), np.nan)}},
        r"events\['bump'\]\[0, 0\] must be finite",
    ),
    "horizon zero": ({"horizon": 0}, "horizon must be at least 1"),
    "horizon a fraction": ({"horizon": 2.5}, "horizon must be a whole number"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_input_is_rejected(case, name):
    changes, message = MALFORMED[name]
    arguments = {"policy": np.ones((S, A)) / A, "reward": np.ones((S, A)), "horizon": 3} | changes
    with pytest.raises(ValueError, match=message):
        evaluate_exactly(case["mdp"], **arguments)
    with pytest.raises(ValueError, match=message):
        evaluate_by_sampling(jax.random.key(0), case["mdp"], **arguments)


@pytest.mark.parametrize("num_trials", [1, 1.5])
def test_one_trial_has_no_standard_error(case, num_trials):
    arguments = (case["mdp"], case["policies"][0], case["rewards"][0], 3)
    with pytest.raises(ValueError, match="num_trials must be"):
        evaluate_by_sampling(jax.random.key(0), *arguments, num_trials=num_trials)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy": np.ones((S + 1, A))}, "policy must have shape"),
        ({"expert_policy": np.ones((S, A + 1))}, "expert_policy must have shape"),
        ({"weights": np.ones(S + 1)}, "weights must have shape"),
        ({"weights": np.ones((S, A, 1))}, "weights must have shape"),
        ({"weights": -np.ones(S)}, r"weights\[0\] must not be negative"),
        ({"weights": np.full(S, np.nan)}, r"weights\[0\] must be finite"),
        ({"weights": np.zeros(S)}, "sum of weights must be positive"),
        ({"weights": np.eye(2, S)[[0, 0]] * [[1], [0]]}, r"sum of weights\[1\] must be positive"),
        ({"policy": np.ones((2, S, A)), "weights": np.ones((3, S))}, "batches must be of one size"),
    ],
)
def test_malformed_agreement_is_rejected(case, changes, message):
    arguments = {"policy": np.ones((S, A)), "expert_policy": np.ones((S, A))} | changes
    with pytest.raises(ValueError, match=message):
        agreement(case["mdp"], **arguments)


@pytest.mark.parametrize("num_actions", [1, 2])
def test_rewards_of_states_are_refused_beside_actions_too(num_actions):
    """Where there are as many actions as states, or one, NumPy would spread them over actions."""
    mdp = MDP.from_dense(np.full((2, num_actions, 2), 0.5), discount=0.9)
    with pytest.raises(ValueError, match="reward must have shape"):
        policy_value(mdp, np.zeros(2, int), np.ones(2))
    with pytest.raises(ValueError, match="reward must have shape"):
        evaluate_exactly(mdp, np.zeros(2, int), np.ones(2), 3)
