"""Stacked models under vmap do what each does alone, whatever the sizes of its lists; and what does not fit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_models

import jaxhom
from jaxhom.models.mdp import expected_next_value, expected_next_values, push_forward

STATES, ACTIONS, FEATURES = 120, 3, 2


def ragged(seed, *, hub=24, shared=True, refused=6, dtype=np.float64, states=STATES):
    """A few successors per pair, but for some pairs that lead to `hub` states, the same for all or others for each."""
    rng = np.random.default_rng(seed)
    transition = np.zeros((states, ACTIONS, states))
    for s, a in np.ndindex(states, ACTIONS):
        count = rng.integers(1, 4)
        transition[s, a, rng.choice(states, count, replace=False)] = rng.dirichlet(np.ones(count))
    ends = rng.choice(states, hub, replace=False)
    for s in rng.choice(states, rng.integers(1, 6), replace=False) if hub else ():
        transition[s, 1] = 0.0
        transition[s, 1, ends if shared else rng.choice(states, hub, replace=False)] = rng.dirichlet(np.ones(hub))
    allowed = np.ones((states, ACTIONS), bool)
    allowed[rng.choice(states, refused, replace=False), 2] = False
    return jaxhom.MDP.from_dense(
        transition.astype(dtype),
        discount=rng.uniform(0.8, 0.9),
        initial=rng.dirichlet(np.ones(states)).astype(dtype),
        features=rng.uniform(size=(states, ACTIONS, FEATURES)).astype(dtype),
        allowed=allowed,
    )


STACKS = {
    "same sizes": lambda: [jaxhom.gridworld(5, noise=noise, num_regions=1).mdp for noise in (0.1, 0.5)],
    "other N": lambda: [jaxhom.gridworld(5, noise=noise, num_regions=1).mdp for noise in (0.0, 0.5)],
    "dense": lambda: [small_models.case("dense").mdp.replace(discount=np.asarray(d)) for d in (0.5, 0.9)],
    "one state": lambda: [small_models.case("one_state").mdp],
    "wide, alike": lambda: [ragged(1), ragged(2), ragged(3, hub=20)],
    "wide, or not": lambda: [ragged(4), ragged(5, hub=0, refused=0)],
    "wide, each its own": lambda: [ragged(6), ragged(7, shared=False), ragged(8, hub=0)],
}


# What `test_functions` asks of large stacks, whose programs take long to compile; of small ones it asks everything.
SHARES = {
    "wide, alike": ("plan", "trials", "empirical"),
    "wide, or not": ("occupancy", "walks"),
    "wide, each its own": ("expectations", "value", "walks", "trials"),
}


@functools.cache
def stack(name):
    return STACKS[name]()


@pytest.fixture(params=STACKS, scope="module")
def models(request):
    return stack(request.param)


def policies(models, rng):
    """One for each, on the actions that it allows."""
    allowed = np.stack([np.asarray(mdp.allowed) for mdp in models])
    policy = small_models.random_policy(rng, *allowed.shape) * allowed
    return policy / policy.sum(axis=-1, keepdims=True)


def test_one_step_maps(models, rng):
    """Of the stack, against the dense tensors that the models have alone."""
    stacked, tensors = jaxhom.stack_models(models), np.stack([small_models.dense_transition(mdp) for mdp in models])
    pairs = tensors.shape[:3]
    values, flows = rng.normal(size=(*pairs[:2], 2)), rng.normal(size=(*pairs, 2))
    policy = policies(models, rng)

    @jax.jit
    @jax.vmap
    def maps(mdp, value, flow, policy):
        chain, chains = mdp.dynamics.chain(policy), mdp.dynamics.action_chains()
        return {
            "backward": expected_next_value(mdp, value),
            "action by action": jnp.stack(expected_next_values(mdp, value), axis=1),
            "action chains": jnp.stack((chains or mdp.dynamics).expected_next_values(value), axis=1),
            "forward": push_forward(mdp, flow),
            "chain backward": chain.expected_next_value(value[:, 0]),
            "chain forward": chain.push_forward(value[:, 0]),
            "transition": mdp.transition,
        }

    backward, step = np.einsum("bsat,bti->bsai", tensors, values), np.einsum("bsa,bsat->bst", policy, tensors)
    expected = {
        "backward": backward,
        "action by action": backward,
        "action chains": backward,
        "forward": np.einsum("bsat,bsai->bti", tensors, flows),
        "chain backward": np.einsum("bst,bt->bs", step, values[..., 0]),
        "chain forward": np.einsum("bst,bs->bt", step, values[..., 0]),
        "transition": tensors,
    }
    for name, found in maps(stacked, values, flows, policy).items():
        np.testing.assert_allclose(found, expected[name], rtol=0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("name", STACKS)
def test_functions(name, rng):
    """Planning, occupancies, values and draws, against a call for each model."""
    models = stack(name)
    stacked, policy = jaxhom.stack_models(models), policies(models, rng)
    reward, keys = rng.uniform(size=policy.shape), jax.random.split(jax.random.key(0), len(models))

    def functions(mdp, policy, reward, key):
        def plan():
            found = jaxhom.optimal_policy(mdp, reward)
            return found.value, found.policy

        walks = jaxhom.sample_demonstrations(key, mdp, policy, 3, 8)
        calls = {
            "plan": plan,
            "occupancy": lambda: jaxhom.occupancy(mdp, policy),
            "expectations": lambda: jaxhom.feature_expectations(mdp, policy),
            "value": lambda: jaxhom.policy_value(mdp, policy, reward),
            "walks": lambda: (walks.states, walks.actions),
            "empirical": lambda: jaxhom.empirical_policy(mdp, walks),
            "trials": lambda: jaxhom.evaluate_exactly(mdp, policy, reward, 5).total_reward,
        }
        return {what: calls[what]() for what in SHARES.get(name, calls)}

    found = jax.jit(jax.vmap(functions))(stacked, policy, reward, keys)
    for b, mdp in enumerate(models):
        alone = functions(mdp, policy[b], reward[b], keys[b])
        for what, expected in alone.items():
            for one, other in zip(jax.tree.leaves(found[what]), jax.tree.leaves(expected), strict=True):
                np.testing.assert_allclose(one[b], other, rtol=1e-7, atol=1e-9, err_msg=what)


def test_a_model_comes_out_as_it_went_in(models):
    stacked = jaxhom.stack_models(models)
    for b, mdp in enumerate(models):
        again, slots = jax.tree.map(lambda leaf, b=b: leaf[b], stacked), mdp.probability.shape[-1]
        np.testing.assert_array_equal(again.probability[..., :slots], mdp.probability)
        for name in ("initial", "features", "discount", "allowed"):
            np.testing.assert_array_equal(getattr(again, name), getattr(mdp, name))
        np.testing.assert_array_equal(again.dynamics.known_slots()[..., :slots], mdp.dynamics.known_slots())
        np.testing.assert_array_equal(small_models.dense_transition(again), small_models.dense_transition(mdp))
    assert stacked.restricts_actions == any(mdp.restricts_actions for mdp in models)


def test_slots_without_probability_stay_known():
    """Successors whose probability was taken away may get it back: they are not searched for again."""
    less, other = (jaxhom.gridworld(5, noise=noise, num_regions=1).mdp for noise in (0.0, 0.5))
    allowed = np.ones((25, 4), bool)
    allowed[7, 2] = False
    stacked = jaxhom.stack_models([less.replace(allowed=allowed), other])
    first = jax.tree.map(lambda leaf: leaf[0], stacked)
    assert first.probability.shape[-1] == 4
    assert not np.asarray(first.probability)[7, 2].any()
    assert first.dynamics.known_slots()[7, 2].tolist() == [True, False, False, False]


def test_lpal_over_stacked_models(rng):
    """Expectations within reach of another policy: margins and bounds are those of single calls, up to the gap."""
    models = [jaxhom.gridworld(4, noise=noise, num_regions=4, discount=0.9).mdp for noise in (0.1, 0.4)]
    stacked = jaxhom.stack_models(models)
    policy = small_models.random_policy(rng, 16, 4)
    vhat = jax.vmap(lambda mdp: 0.8 * jaxhom.feature_expectations(mdp, policy))(stacked)
    margins = jax.jit(jax.vmap(lambda mdp, vhat: [jaxhom.lpal(mdp, vhat)[name] for name in ("margin", "margin_bound")]))
    for b, (lower, upper) in enumerate(zip(*margins(stacked, vhat), strict=True)):
        alone = jaxhom.lpal(models[b], vhat[b])
        assert lower <= upper
        assert upper - lower <= 1e-3
        assert lower <= alone.margin_bound + 1e-9
        assert alone.margin <= upper + 1e-9


def test_derivatives_pass_through(rng):
    """Of numbers that are traced, also where arrays have to be made larger."""
    models, policy = [ragged(4), ragged(5, hub=0, refused=6)], np.full((STATES, ACTIONS), 0.0)
    policy[:, 0] = 1.0

    def total(scale):
        features = models[1].replace(features=scale * models[1].features)
        stacked = jaxhom.stack_models([models[0], features])
        return jax.vmap(lambda mdp: jaxhom.feature_expectations(mdp, policy))(stacked).sum()

    expected = float(jaxhom.feature_expectations(models[1], policy).sum())
    assert float(jax.grad(total)(1.0)) == pytest.approx(expected)


def test_under_jit_where_sizes_agree():
    """A traced graph cannot be searched, but stacked as it is."""
    one, other = (jaxhom.gridworld(5, noise=noise, num_regions=1).mdp for noise in (0.1, 0.5))
    values = jax.jit(lambda *models: jax.vmap(lambda mdp: mdp.transition)(jaxhom.stack_models(models)))(one, other)
    np.testing.assert_array_equal(values[1], other.transition)
    with pytest.raises(ValueError, match=r"models\[0\] has a traced graph of other sizes"):
        jax.jit(lambda *models: jaxhom.stack_models(models))(one, jaxhom.gridworld(5, noise=0.0, num_regions=1).mdp)


@pytest.mark.parametrize(
    ("models", "message"),
    [
        (list, "models is empty"),
        (lambda: jaxhom.gridworld(3), "models must be several"),
        (lambda: 3, "models must be several"),
        (lambda: [jaxhom.gridworld(3), 3], r"models\[1\]: a jaxhom.MDP is needed"),
        (lambda: [jaxhom.stack_models([jaxhom.gridworld(3)])], r"models\[0\]: this is a stack of 1 models"),
        (lambda: [jaxhom.gridworld(4), jaxhom.gridworld(3)], r"models\[1\] has num_states 9, models\[0\] has 16"),
        (lambda: [ragged(1), ragged(1, dtype=np.float32)], r"models\[1\] has dtype float32, models\[0\] has float64"),
        (lambda: [jaxhom.gridworld(4, num_regions=1), jaxhom.gridworld(4)], r"models\[1\] has num_features 0"),
        (lambda: [jaxhom.gridworld(4), jaxhom.gridworld(4, noise=0.0)], r"models\[1\] has layout 'successors'"),
    ],
)
def test_what_does_not_fit(models, message):
    with pytest.raises(ValueError, match=message):
        jaxhom.stack_models(models())


def test_a_stack_is_no_model():
    """It says what it is, and the doors say what to do with it."""
    stacked = jaxhom.stack_models([jaxhom.gridworld(3), jaxhom.gridworld(3)])
    assert "batch=2, num_states=9, num_actions=4" in repr(stacked)
    with pytest.raises(ValueError, match=r"a stack of 2 models.*jax\.vmap"):
        jaxhom.occupancy(stacked, np.zeros(9, int))
