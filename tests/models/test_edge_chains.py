"""Chains of policies and of actions on a model's edges, and their derivatives, against dense NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_models

from jaxhom.models.edge_chains import action_chains, find_edges, policy_chain, saves_gathers

# "absorbing": actions share edges; "sparse": over 16 predecessors in a row; "restart": wide rows of both kinds
NAMES = ["absorbing", "sparse", "restart"]
BATCH = 3


def inputs(case, seed=0):
    """Policies, and vectors over the states; the batch comes last."""
    rng = np.random.default_rng(seed)
    states, actions = case.shape
    policies = np.moveaxis(small_models.random_policy(rng, BATCH, states, actions), 0, -1)
    policies[: states // 2, :, 0] = np.eye(actions)[rng.integers(actions, size=states // 2)]
    return policies, *rng.normal(size=(2, states, BATCH))


@jax.jit
def products(edges, probability, policies, values, flows):
    """All products, of a batch and of its first member alone."""
    chain, alone = policy_chain(edges, probability, policies), policy_chain(edges, probability, policies[..., 0])
    chains = action_chains(edges, probability)
    return {
        "backward": chain.expected_next_value(values),
        "forward": chain.push_forward(flows),
        "backward alone": alone.expected_next_value(values[:, 0]),
        "forward alone": alone.push_forward(flows[:, 0]),
        "one chain, many values": alone.expected_next_value(values),
        "one chain, many flows": alone.push_forward(flows),
        "actions": jnp.stack(chains.expected_next_values(values), axis=1),
        "actions alone": jnp.stack(chains.expected_next_values(values[:, 0]), axis=1),
    }


def dense_products(transition, policies, values, flows):
    step = np.einsum("sab,sat->stb", policies, transition)
    return {
        "backward": np.einsum("stb,tb->sb", step, values),
        "forward": np.einsum("stb,sb->tb", step, flows),
        "backward alone": step[..., 0] @ values[:, 0],
        "forward alone": flows[:, 0] @ step[..., 0],
        "one chain, many values": step[..., 0] @ values,
        "one chain, many flows": step[..., 0].T @ flows,
        "actions": np.einsum("sat,tb->sab", transition, values),
        "actions alone": transition @ values[:, 0],
    }


@pytest.mark.parametrize("name", NAMES)
def test_edges(name):
    case = small_models.case(name)
    edges, entries = case.mdp.dynamics.edges, np.append(np.ravel(case.mdp.probability), 0.0)
    source, target = np.nonzero((case.transition > 0).any(axis=1))
    count = len(source)  # what is behind fills the arrays up
    np.testing.assert_array_equal(edges.source[:count], source)
    np.testing.assert_array_equal(edges.target[:count], target)
    np.testing.assert_array_equal(entries[edges.entry[:count]], case.transition[source, :, target])
    assert (np.asarray(edges.entry)[count:] == case.mdp.probability.size).all()
    for rows, ends in ((edges.outgoing, source), (edges.incoming, target)):
        for s in range(len(case.transition)):
            listed = np.concatenate([rows.narrow[s], *np.asarray(rows.wide)[np.asarray(rows.wide_row) == s]])
            np.testing.assert_array_equal(listed[listed < len(source)], np.flatnonzero(ends == s))


def test_the_cases_have_wide_rows():
    """What the other tests rely on."""
    edges = small_models.case("restart").mdp.dynamics.edges
    assert edges.outgoing.wide_row.size and edges.incoming.wide_row.size
    assert small_models.case("sparse").mdp.dynamics.edges.incoming.narrow.shape[1] > 16


@pytest.mark.parametrize("name", NAMES)
def test_products(name):
    case = small_models.case(name)
    policies, values, flows = inputs(case)
    found = products(case.mdp.dynamics.edges, case.mdp.probability, policies, values, flows)
    for product, expected in dense_products(case.transition, policies, values, flows).items():
        np.testing.assert_allclose(found[product], expected, rtol=0, atol=1e-12, err_msg=product)


def test_products_follow_the_probabilities():
    """The edges are those of the graph; the numbers on them are given with each call."""
    case = small_models.case("restart")
    policies, values, flows = inputs(case, 1)
    factor = np.random.default_rng(2).uniform(size=case.transition.shape)
    s, a, _ = np.indices(case.mdp.next_state.shape)
    found = products(
        case.mdp.dynamics.edges, case.mdp.probability * factor[s, a, case.mdp.next_state], policies, values, flows
    )
    for product, expected in dense_products(case.transition * factor, policies, values, flows).items():
        np.testing.assert_allclose(found[product], expected, rtol=0, atol=1e-12, err_msg=product)


def test_derivatives():
    """u . P_pi v is linear in probability and policy: its derivatives are written down from the dense model."""
    case = small_models.case("restart")
    policies, values, flows = map(jnp.asarray, inputs(case))
    edges, on_pairs = case.mdp.dynamics.edges, np.random.default_rng(3).normal(size=(*case.shape, BATCH))

    @jax.jit
    def gradients(probability, policies):
        def backward(probability, policies):
            return (flows * policy_chain(edges, probability, policies).expected_next_value(values)).sum()

        def forward(probability, policies):
            return (values * policy_chain(edges, probability, policies).push_forward(flows)).sum()

        def actions(probability):
            expected = action_chains(edges, probability).expected_next_values(values)
            return (on_pairs * jnp.stack(expected, axis=1)).sum()

        both = [jax.grad(product, argnums=(0, 1))(probability, policies) for product in (backward, forward)]
        return *both, jax.grad(actions)(probability)

    *both, of_actions = gradients(case.mdp.probability, policies)
    next_state, is_used = np.asarray(case.mdp.next_state), np.asarray(case.mdp.probability) > 0
    gathered = np.asarray(values)[next_state]
    for by_probability, by_policy in both:
        expected = np.einsum("sb,sab,sanb->san", flows, policies, gathered)
        np.testing.assert_allclose(by_probability, np.where(is_used, expected, 0.0), rtol=0, atol=1e-12)
        expected = flows[:, None] * np.einsum("sat,tb->sab", case.transition, values)
        np.testing.assert_allclose(by_policy, expected, rtol=0, atol=1e-12)
    expected = np.where(is_used, np.einsum("sab,sanb->san", on_pairs, gathered), 0.0)
    np.testing.assert_allclose(of_actions, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("shared", "width", "saves"),
    [
        (True, 4, True),  # 4 gathers and 16 weights at a fifth of their cost, against 16 gathers
        (True, 1, False),  # ... against 4
        (False, 4, False),  # 16 gathers all the same
    ],
)
def test_gathers_are_saved_where_actions_share_successors(shared, width, saves):
    """Twenty states of a ring, four actions with four successors each: the same ones, or others."""
    s, a, n = np.indices((20, 4, 4))
    next_state = (s + n + (0 if shared else 4 * a)) % 20
    edges = find_edges(next_state, np.full(next_state.shape, True))
    assert len(edges.source) == (80 if shared else 320)
    assert saves_gathers(edges, width) == saves
