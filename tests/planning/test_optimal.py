"""Optimal plans against policy iteration in NumPy; residuals and bounds, by their definitions."""

import functools
import time

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom.domains.gridworld import gridworld
from jaxhom.models.mdp import MDP
from jaxhom.planning.optimal import optimal_policy
from jaxhom.planning.plan import Plan, greedy_policy
from jaxhom.status import Status

BOTH_WAYS = pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["concrete", "jit"])


@pytest.fixture(params=["one_state", "dense", "absorbing", "sparse", "restart"])
def case(request):
    return small_models.case(request.param)


@functools.cache
def reward_of(name):
    """One reward per model, of both signs."""
    case = small_models.case(name)
    return np.random.default_rng(20).normal(size=case.shape)


@functools.cache
def optimum(name):
    """Optimal value and action value by the oracle."""
    case = small_models.case(name)
    return oracles.optimal_value(case.transition, case.discount, reward_of(name))


def bellman_residual(case, reward, value):
    """max_s |max_a r + gamma T V - V|, by NumPy."""
    action_value = reward + case.discount * case.transition @ value
    return np.abs(action_value.max(axis=1) - value).max()


def first_best(action_value, slack):
    """The lowest action within `slack` of the best."""
    return np.argmax(action_value >= action_value.max(axis=1, keepdims=True) - slack, axis=1)


# -------------------------------------------------------------------------------------- the numbers


@BOTH_WAYS
def test_against_policy_iteration(case, transform):
    reward = reward_of(case.name)
    value, action_value = optimum(case.name)
    plan = transform(optimal_policy)(case.mdp, reward)
    assert plan.status == Status.SOLVED
    chex.assert_shape([plan.policy, plan.action_value], case.shape)
    chex.assert_shape([plan.iterations, plan.residual], ())
    bound = float(plan.residual) / (1 - case.discount)
    assert plan.residual <= 1e-10 * np.abs(reward).max()
    np.testing.assert_allclose(plan.value, value, rtol=0, atol=1.01 * bound + 1e-12)
    np.testing.assert_allclose(plan.action_value, action_value, rtol=0, atol=1.01 * bound + 1e-12)
    np.testing.assert_array_equal(plan.policy.argmax(axis=1), first_best(action_value, 1e-8))
    np.testing.assert_array_equal(np.sort(plan.policy, axis=1)[:, -1], 1)
    np.testing.assert_array_equal(plan.policy.sum(axis=1), 1)


def test_the_policy_is_worth_what_the_plan_says(case):
    reward = reward_of(case.name)
    plan = optimal_policy(case.mdp, reward)
    achieved = oracles.policy_value(case.transition, case.discount, np.asarray(plan.policy), reward)
    np.testing.assert_allclose(achieved, optimum(case.name)[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("tolerance", [3.0, 1e-2, 1e-5, 0.0])
@pytest.mark.parametrize("name", ["dense", "absorbing", "restart"])
def test_residual_and_bounds_hold_at_every_tolerance(name, tolerance):
    case, reward = small_models.case(name), reward_of(name)
    plan = optimal_policy(case.mdp, reward, tolerance=tolerance)
    value = np.asarray(plan.value)
    scale = np.abs(plan.action_value).max()
    assert plan.residual <= max(tolerance, 1e-14 * scale)
    true_residual = bellman_residual(case, reward, value)
    np.testing.assert_allclose(plan.residual, true_residual, rtol=1e-9, atol=1e-14 * scale)
    action_value = reward + case.discount * case.transition @ value
    np.testing.assert_allclose(plan.action_value, action_value, rtol=0, atol=1e-14 * scale)
    error = np.abs(value - optimum(name)[0]).max()
    assert error <= plan.residual / (1 - case.discount) + 1e-12 * scale
    assert np.all(plan.upper_bound(case.mdp) >= optimum(name)[0] - 1e-13 * scale)
    achieved = oracles.policy_value(case.transition, case.discount, np.asarray(plan.policy), reward)
    loss = (optimum(name)[0] - achieved).max()
    # twice the residual for the value, four times for actions that tie
    assert loss <= 6 * plan.residual / (1 - case.discount) + 1e-9


@pytest.mark.parametrize("max_iterations", [0, 5])
def test_a_plan_that_is_cut_short_says_so_and_its_bound_holds(max_iterations):
    case, reward = small_models.case("restart"), reward_of("restart")
    plan = optimal_policy(case.mdp, reward, tolerance=1e-10, max_iterations=max_iterations)  # by sweeps
    assert plan.iterations == max_iterations
    assert plan.residual > 1e-3
    residual = bellman_residual(case, reward, np.asarray(plan.value))
    np.testing.assert_allclose(plan.residual, residual, rtol=1e-12)
    assert np.all(plan.upper_bound(case.mdp) >= optimum("restart")[0])


@pytest.mark.parametrize("discount", [0.01, 0.999])
def test_extreme_discounts(discount):
    case = small_models.case("restart")._replace(discount=discount)
    reward = reward_of("restart")
    plan = optimal_policy(case.mdp.replace(discount=np.asarray(discount)), reward)
    value, action_value = oracles.optimal_value(case.transition, discount, reward)
    np.testing.assert_allclose(plan.value, value, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(plan.policy.argmax(axis=1), first_best(action_value, 1e-8))


def test_a_model_that_never_mixes():
    """Two ends of different worth: the span of the error shrinks by the discount alone."""
    case = small_models.case("absorbing")
    reward = np.array([[0, 0], [0, 0], [1, 1], [0, 0], [-1, -1], [-1, -1]])
    plan = optimal_policy(case.mdp, reward)
    g = case.discount
    expected = np.array([g**2, g, 1, g**3, -1, -1]) / (1 - g)
    expected[3] = max(g**3, -g) / (1 - g)
    np.testing.assert_allclose(plan.value, expected, rtol=0, atol=1e-9)


def test_zero_reward_gives_zero_and_the_first_action(case):
    plan = optimal_policy(case.mdp, np.zeros(case.shape))
    np.testing.assert_array_equal(plan.value, 0)
    np.testing.assert_array_equal(plan.policy, np.eye(case.shape[1])[np.zeros(case.shape[0], int)])
    assert plan.iterations <= 1 and plan.residual == 0


# ---------------------------------------------------------------------------------- ties, float32


def test_equal_actions_go_to_the_lowest():
    """Actions 1 and 3 are copies, and better than 0 and 2."""
    case = small_models.case("dense")
    transition = case.transition[:, [0, 1, 0, 1]]
    mdp = MDP.from_dense(transition, discount=case.discount)
    plan = optimal_policy(mdp, np.tile([0.0, 10.0, 0.0, 10.0], (7, 1)))
    np.testing.assert_array_equal(plan.policy, np.eye(4)[np.ones(7, int)])


def test_ties_of_a_gridworld_are_not_left_to_rounding():
    """To the far corner, right and down are equally good inside: down is the lower action."""
    world = gridworld(6, discount=0.99)
    reward = np.zeros(36)
    reward[-1] = 1.0
    _, action_value = oracles.optimal_value(
        oracles.gridworld_transition(6), 0.99, np.repeat(reward[:, None], 4, axis=1)
    )
    actions = np.asarray(optimal_policy(world.mdp, reward).policy.argmax(axis=1))
    np.testing.assert_array_equal(actions, first_best(action_value, 1e-9))
    rows, columns = np.divmod(np.arange(36), 6)
    np.testing.assert_array_equal(actions[rows == columns][:-1], 1)


@pytest.mark.parametrize(("slack", "expected"), [(0.0, [2, 0]), (0.1, [1, 0]), (5.0, [0, 0])])
def test_greedy_policy(slack, expected):
    action_value = np.array([[0.0, 0.95, 1.0], [2.0, 2.0, 2.0]])
    np.testing.assert_array_equal(greedy_policy(action_value, slack), np.eye(3)[expected])
    batch = np.stack([action_value, action_value + 7])
    np.testing.assert_array_equal(greedy_policy(batch, slack)[1], np.eye(3)[expected])


@pytest.mark.parametrize("name", ["one_state", "sparse"])
@pytest.mark.parametrize("discount", [0.9, 0.999])
def test_float32_stops_by_itself_and_its_bound_holds(name, discount):
    """Against the optimum of the rounded model, in float64."""
    case = small_models.in_float32(small_models.case(name)._replace(discount=discount))
    rewards = np.random.default_rng(21).uniform(size=(8, *case.shape)).astype(np.float32)
    plans = optimal_policy(case.mdp, rewards)
    assert plans.value.dtype == plans.residual.dtype == jnp.float32
    assert np.all(plans.iterations < 2000)
    upper = np.asarray(plans.upper_bound(case.mdp), np.float64)
    for lane, reward in enumerate(rewards.astype(float)):
        value, _ = oracles.optimal_value(case.transition, case.discount, reward)
        assert np.all(upper[lane] >= value)
        slack = np.abs(plans.value[lane] - value).max()
        assert slack <= 1e-5 * np.abs(value).max() / (1 - case.discount)


def test_float64_bound_holds_where_the_residual_rounds_to_zero(rng):
    mdp = small_models.case("one_state").mdp
    rewards = rng.uniform(size=(50, 1, 1))
    plans = optimal_policy(mdp, rewards)
    # by hand, in extended precision: one state, one action
    exact = rewards[:, :, 0].astype(np.longdouble) / (1 - np.longdouble(float(mdp.discount)))
    assert np.all(np.asarray(plans.upper_bound(mdp)) >= exact)


# ------------------------------------------------------------------ shapes, batches, jit and vmap


def test_batches_agree_with_single_rewards_lane_by_lane():
    case, reward = small_models.case("restart"), reward_of("restart")
    rewards = np.stack([reward, np.zeros_like(reward), -3 * reward])
    batched = optimal_policy(case.mdp, rewards)
    chex.assert_shape(batched.value, (3, case.shape[0]))
    chex.assert_shape([batched.iterations, batched.residual], (3,))
    singles = [optimal_policy(case.mdp, r) for r in rewards]
    stacked = jax.tree.map(lambda *lanes: jnp.stack(lanes), *singles)
    np.testing.assert_array_equal(batched.iterations, stacked.iterations)
    chex.assert_trees_all_close(batched, stacked, rtol=1e-12, atol=1e-12)
    chex.assert_trees_all_close(batched.upper_bound(case.mdp), stacked.upper_bound(case.mdp), rtol=1e-12)


def test_state_rewards_hold_for_every_action():
    case = small_models.case("dense")
    rewards = np.random.default_rng(22).normal(size=(4, 7))
    spread = np.repeat(rewards[..., None], 3, axis=2)
    for state_reward, reward in ((rewards, spread), (rewards[0], spread[0]), (rewards[:3, :, None], spread[:3])):
        chex.assert_trees_all_equal(optimal_policy(case.mdp, state_reward), optimal_policy(case.mdp, reward))


def test_a_square_reward_is_one_reward():
    mdp = MDP.from_dense(np.full((2, 2, 2), 0.5), discount=0.5)
    plan = optimal_policy(mdp, np.array([[0.0, 1.0], [2.0, 0.0]]))
    np.testing.assert_array_equal(plan.policy, [[0, 1], [1, 0]])


def test_a_former_value_saves_the_sweeps():
    case, reward = small_models.case("restart"), reward_of("restart")
    cold = optimal_policy(case.mdp, reward, tolerance=1e-10)  # by sweeps
    assert cold.iterations > 20
    warm = optimal_policy(case.mdp, reward, tolerance=1e-10, initial_value=cold.value)
    assert warm.iterations <= 2
    rewards = np.stack([reward] * 3)
    for start in (cold.value, jnp.stack([cold.value, cold.value + 1, cold.value])):
        lanes = optimal_policy(case.mdp, rewards, initial_value=start)
        assert np.all(lanes.iterations <= 2)
        np.testing.assert_allclose(lanes.value[1], cold.value, rtol=0, atol=1e-7)


def test_vmapped_discounts_and_jit():
    case, reward = small_models.case("sparse"), reward_of("sparse")
    discounts = np.array([0.5, 0.9])

    @jax.jit
    @jax.vmap
    def plan_and_bound(discount) -> tuple[Plan, jax.Array]:
        mdp = case.mdp.replace(discount=discount)
        plan = optimal_policy(mdp, reward)
        return plan, plan.upper_bound(mdp)

    plans, bounds = plan_and_bound(discounts)
    for i, discount in enumerate(discounts):
        value, _ = oracles.optimal_value(case.transition, discount, reward)
        np.testing.assert_allclose(plans.value[i], value, rtol=0, atol=1e-8)
        assert np.all(bounds[i] >= value - 1e-12)


def test_one_trace_serves_all_rewards_of_one_shape():
    chex.clear_trace_counter()
    case = small_models.case("dense")
    plan = jax.jit(chex.assert_max_traces(optimal_policy, n=1))
    for scale in (1.0, 2.0):
        plan(case.mdp, scale * reward_of("dense"))


# ------------------------------------------------------------------- discounts near 1, ties, forbidden actions


def two_classes(discount, dtype=np.float64):
    """A corridor 0-1-2-3 whose end absorbs, and a state that absorbs at -3 and that nobody can reach."""
    next_state = np.array([[0, 1], [0, 2], [1, 3], [3, 3], [4, 4]])[..., None]
    reward = np.array([[-1, -1], [-1, -1], [-1, -1], [0, 0], [-3, -3]], dtype)
    return MDP.from_successors(next_state, np.ones((5, 2, 1), dtype), discount=discount), reward


@BOTH_WAYS
@pytest.mark.parametrize(
    ("dtype", "discount"), [(np.float64, 0.99999), (np.float64, 1 - 1e-10), (np.float32, 0.999), (np.float32, 0.99999)]
)
def test_two_recurrent_classes_and_a_discount_near_one(dtype, discount, transform):
    mdp, reward = two_classes(discount, dtype)
    plan = transform(optimal_policy)(mdp, reward)
    g = float(mdp.discount)
    tolerance = 1e-6 if dtype == np.float64 else 1e-5
    atol = 4 * np.finfo(np.float64).eps / (1 - g)  # a rounding of the reward, for ever
    np.testing.assert_allclose(plan.value[:4], [-1 - g - g**2, -1 - g, -1, 0], rtol=tolerance, atol=atol)
    np.testing.assert_allclose(plan.value[4], -3 / (1 - g), rtol=1e-4)
    assert plan.policy.argmax(axis=1)[:3].tolist() == [1, 1, 1]
    assert plan.value.dtype == dtype and plan.status == Status.SOLVED


@pytest.mark.parametrize("discount", [0.99, 0.9999, 0.999999])
def test_deterministic_states_that_fall_into_many_classes(discount, rng):
    """Sixty of them; every cycle is a class of its own."""
    next_state, reward = rng.integers(60, size=(60, 3, 1)), rng.normal(size=(60, 3))
    plan = optimal_policy(MDP.from_successors(next_state, np.ones((60, 3, 1)), discount=discount), reward)
    value, _ = oracles.optimal_value(np.eye(60)[next_state[..., 0]], discount, reward)
    np.testing.assert_allclose(plan.value, value, rtol=1e-8, atol=1e-8)
    assert plan.status == Status.SOLVED


def test_slow_lanes_of_a_batch_are_brought_to_the_end_and_the_others_stay(rng):
    """Eight rewards, more than the host takes by itself; those over one class alone are quick."""
    mdp, reward = two_classes(0.9999)
    rewards = np.stack([reward * [[1], [1], [1], [1], [slow]] for slow in (0, 1) * 4])
    plans = optimal_policy(mdp, rewards)
    for lane, reward in enumerate(rewards):
        value, _ = oracles.optimal_value(np.eye(5)[np.asarray(mdp.next_state)[..., 0]], 0.9999, reward)
        np.testing.assert_allclose(plans.value[lane], value, rtol=1e-7, atol=1e-6)
    assert (np.asarray(plans.status) == Status.SOLVED).all()


@BOTH_WAYS
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("penalty", [-1e6, -np.inf])
def test_a_penalty_that_is_never_paid_decides_nothing(penalty, dtype, transform):
    """Six states in a row: left at a penalty, stay, right; staying in the last is worth 1."""
    cell = np.arange(6)
    next_state = np.stack([np.maximum(cell - 1, 0), cell, np.minimum(cell + 1, 5)], axis=1)[..., None]
    mdp = MDP.from_successors(next_state, np.ones((6, 3, 1), dtype), discount=0.9)
    reward = np.zeros((6, 3), dtype)
    reward[:, 0], reward[5, 1] = penalty, 1
    plan = transform(optimal_policy)(mdp, reward)
    assert plan.policy.argmax(axis=1).tolist() == [2, 2, 2, 2, 2, 1]
    np.testing.assert_allclose(plan.value[0], 5.9049, rtol=1e-5)
    assert np.all(np.isfinite(np.asarray(plan.upper_bound(mdp))))


@BOTH_WAYS
def test_what_the_model_does_not_allow_is_never_planned_for(transform, rng):
    """The oracle sees the same model with a penalty that nobody would pay."""
    case = small_models.case("sparse")
    reward = rng.normal(size=case.shape)
    allowed = rng.uniform(size=case.shape) < 0.5
    allowed[np.arange(len(allowed)), rng.integers(case.shape[1], size=len(allowed))] = True
    mdp = case.mdp.replace(allowed=allowed)
    plan = transform(optimal_policy)(mdp, np.where(allowed, reward, np.nan) if transform is not jax.jit else reward)
    value, action_value = oracles.optimal_value(case.transition, case.discount, np.where(allowed, reward, -1e3))
    np.testing.assert_allclose(plan.value, value, rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.asarray(plan.action_value)[allowed], action_value[allowed], rtol=0, atol=1e-7)
    assert (np.asarray(plan.action_value)[~allowed] == -np.inf).all() and not np.asarray(plan.policy)[~allowed].any()
    if transform is jax.jit:
        gradient = jax.jit(jax.grad(lambda reward: optimal_policy(mdp, reward).value.sum()))(reward)
        assert np.isfinite(gradient).all() and not gradient[~allowed].any()


def test_many_actions_compile_in_seconds(rng):
    next_state, reward = rng.integers(40, size=(40, 200, 2)), rng.normal(size=(40, 200))
    mdp = MDP.from_successors(next_state, np.full((40, 200, 2), 0.5), discount=0.9)
    begin = time.perf_counter()
    plan = jax.jit(optimal_policy)(mdp, reward)
    assert time.perf_counter() - begin < 60  # 5 s on quiet cores; unrolled it took minutes
    np.testing.assert_allclose(plan.value, optimal_policy(mdp, reward).value, rtol=1e-8)


# ---------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (np.full((7, 3), np.nan), r"reward\[0, 0\] must be finite, got nan"),
        (np.full((7, 3), np.inf), r"reward\[0, 0\] must be finite, got inf"),
        (np.where(np.arange(7)[:, None] == 4, -np.inf, np.zeros((7, 3))), r"reward\[4\] is -inf for every action"),
        (np.zeros((2, 7, 3)) - np.array([0, np.inf])[:, None, None], r"reward\[1, 0\] is -inf for every action"),
        (np.zeros((3, 7)), r"reward has shape \(3, 7\): transpose it"),
    ],
)
def test_rewards_that_mean_nothing_are_refused(reward, message):
    with pytest.raises(ValueError, match=message):
        optimal_policy(small_models.case("dense").mdp, reward)


@pytest.mark.parametrize("shape", [(), (3,), (6, 3), (7, 2), (2, 7, 2), (2, 6, 3), (1, 2, 7, 3)])
def test_rewards_of_another_shape_are_refused(shape):
    message = r"reward must have shape \(7, 3\), \(7,\), \(B, 7, 3\) or \(B, 7\), got"
    with pytest.raises(ValueError, match=message):
        optimal_policy(small_models.case("dense").mdp, np.zeros(shape))


@pytest.mark.parametrize("shape", [(6,), (7, 1), (3, 7), (1, 2, 7)])
def test_initial_values_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"initial_value must have shape \(7,\) or \(2, 7\), got"):
        optimal_policy(small_models.case("dense").mdp, np.zeros((2, 7)), initial_value=np.zeros(shape))


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["concrete", "jit"])
@pytest.mark.parametrize("other", [0.5, 0.9, 0.95])
@pytest.mark.parametrize("discount", [0.999, 0.9999, 0.99999])
def test_what_float32_calls_a_tie_does_not_add_up(transform, other, discount):
    """A state with a better and a worse way to stay, and rare ways out: what is lost in a step is lost for ever."""
    rare = np.float32(2**-20)
    transition = np.zeros((3, 2, 3), np.float32)
    transition[0] = [1 - 2 * rare, rare, rare]
    transition[1, :, 1] = transition[2, :, 2] = 1.0
    reward = np.array([[other, 1.0], [1.0, 1.0], [-1.0, -1.0]], np.float32)
    mdp = MDP.from_dense(transition, discount=discount)
    plan = transform(optimal_policy)(mdp, reward)
    best, _ = oracles.optimal_value(transition.astype(float), float(mdp.discount), reward.astype(float))
    worth = oracles.policy_value(transition.astype(float), float(mdp.discount), np.asarray(plan.policy), reward)
    np.testing.assert_allclose(worth, best, rtol=1e-6)


@pytest.mark.parametrize("discount", [0.9, 0.9999, 0.999999])
@pytest.mark.parametrize("excess", [0.0, 9e-7])
def test_float32_says_what_rounding_may_have_made_of_a_value(discount, excess):
    """Reward 1 everywhere; rows that sum to 1 but for a few roundings, which a program takes as they are."""
    transition = (np.full((3, 1, 3), 1 / 3) * (1 + excess)).astype(np.float32)
    mdp = MDP.from_dense(transition, discount=discount)
    reward = np.ones((3, 1), np.float32)
    exact = 1 / (1 - float(mdp.discount))
    plan = jax.jit(optimal_policy)(mdp, reward)
    error = np.abs(np.asarray(plan.value, float) - exact).max()
    assert error <= 1.001 * float(plan.residual) * exact
    assert plan.status != Status.SOLVED or error <= 0.02 * exact
    np.testing.assert_allclose(optimal_policy(mdp, reward).value, exact, rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_iterations": 1.5}, "max_iterations must be a whole number, got 1.5"),
        ({"max_iterations": -1}, "max_iterations must be at least 0, got -1"),
        ({"tolerance": -1.0}, "tolerance must not be negative, got -1.0"),
        ({"tolerance": np.nan}, "tolerance must be finite, got nan"),
        ({"tolerance": [0.1, 0.1]}, r"tolerance must have shape \(\) or \(1,\), got \(2,\)"),
        ({"initial_value": [np.nan]}, r"initial_value\[0\] must be finite, got nan"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, message):
    mdp = MDP.from_dense(np.ones((1, 1, 1)), discount=0.9)
    with pytest.raises(ValueError, match=message):
        optimal_policy(mdp, np.zeros((1, 1)), **options)


def test_every_plan_says_how_it_ended():
    """Concrete, in a program and lane by lane: solved, and stopped by the limit."""
    case = small_models.case("dense")
    rewards = np.stack([reward_of("dense"), -reward_of("dense")])

    def statuses(limit):
        plan = functools.partial(optimal_policy, case.mdp, tolerance=1e-9, max_iterations=limit)
        return plan(rewards).status, jax.jit(plan)(rewards).status, jax.vmap(plan)(rewards).status

    for limit, expected in ((100_000, Status.SOLVED), (1, Status.ITERATION_LIMIT)):
        for status in statuses(limit):
            assert status.tolist() == [expected] * 2


@pytest.mark.parametrize("name", ["sparse", "restart", "absorbing"])
def test_patient_sweeps_of_large_models(name, rng, monkeypatch, capsys):
    """What models of more than 200,000 states go through, on small ones; it says how far it is."""
    case = small_models.case(name)
    reward = rng.normal(size=case.shape[:2])
    plain = optimal_policy(case.mdp, reward)
    monkeypatch.setattr("jaxhom.planning.optimal._SWEPT", ((0, 0.999),))
    patient = optimal_policy(case.mdp, reward, progress=True)
    np.testing.assert_allclose(patient.value, plain.value, atol=1e-7)
    assert patient.status == Status.SOLVED
    assert "sweeps" in capsys.readouterr().err
