"""The model: its layouts, the one-step maps against dense products, what constructors refuse."""

import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import checks
from jaxhom.domains.gridworld import gridworld
from jaxhom.models.mdp import MDP, expected_next_value, push_forward, state_transition


def as_successors(transition, rng, extra=2):
    """Successor lists in random order, each successor listed twice, with `extra` slots of junk."""
    num_states, num_actions, _ = transition.shape
    width = 2 * int((transition > 0).sum(axis=-1).max()) + extra
    next_state = rng.integers(0, num_states, size=(num_states, num_actions, width))
    probability = np.zeros(next_state.shape)
    for s, a in np.ndindex(num_states, num_actions):
        successors = np.flatnonzero(transition[s, a])
        slots = rng.permutation(width)[: 2 * len(successors)]
        next_state[s, a, slots] = np.repeat(successors, 2)
        probability[s, a, slots] = np.repeat(transition[s, a, successors] / 2, 2)
    return next_state, probability


# ---------------------------------------------------------------------------------- the layouts


@pytest.mark.parametrize(
    ("name", "is_dense", "has_wide_pairs", "has_wide_rows"),
    [
        ("dense", True, False, False),
        ("sparse", False, False, False),
        ("restart", False, True, True),
        ("dense_krylov", True, False, False),
    ],
)
def test_layout(name, is_dense, has_wide_pairs, has_wide_rows):
    mdp = small_models.case(name).mdp
    assert mdp.is_dense == is_dense
    assert mdp.is_dense or (mdp.dynamics.wide_pairs.size > 0) == has_wide_pairs
    assert mdp.is_dense or (mdp.dynamics.predecessors.wide_row.size > 0) == has_wide_rows


def test_restart_rows_alone_are_wide():
    mdp = small_models.case("restart").mdp
    assert mdp.dynamics.narrow_width == 3
    np.testing.assert_array_equal(mdp.dynamics.wide_pairs[:5], 3 * np.arange(95, 100) + 2)
    assert (np.asarray(mdp.dynamics.wide_pairs)[5:] == 300).all()  # no pair: the array is filled up
    rows = mdp.dynamics.predecessors
    is_used = np.asarray(rows.wide)[:, 0] < mdp.probability.size
    np.testing.assert_array_equal(np.unique(np.asarray(rows.wide_row)[is_used]), [0])


@pytest.mark.parametrize("is_shared", [True, False])
def test_expectations_over_wide_rows(is_shared, rng):
    """Five pairs restart, among the same 24 states or each among others."""
    transition, discount, initial, features = small_models.restart()
    if not is_shared:
        for state in range(95, 100):
            transition[state, 2] = np.roll(transition[state, 2], state)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    assert (mdp.dynamics.wide_successors is not None) == is_shared
    if is_shared:
        np.testing.assert_array_equal(mdp.dynamics.wide_successors, np.arange(10, 34))
    for value in (rng.normal(size=100), rng.normal(size=(100, 1)), rng.normal(size=(100, 4))):
        expected = np.tensordot(transition, value, axes=1)
        np.testing.assert_allclose(jax.jit(expected_next_value)(mdp, value), expected, rtol=0, atol=1e-14)


def test_sizes_dtype_and_fields(case):
    mdp = case.mdp
    assert (mdp.num_states, mdp.num_actions) == case.shape
    assert mdp.num_features == case.features.shape[-1]
    assert mdp.dtype == jnp.float64
    np.testing.assert_array_equal(mdp.initial, case.initial)
    np.testing.assert_array_equal(mdp.features, case.features)
    assert float(mdp.discount) == case.discount


def test_transition_is_given_back(case):
    transition = jax.jit(lambda mdp: mdp.transition)(case.mdp)
    np.testing.assert_array_equal(transition, case.transition)


def test_successors_in_any_order_repeated_and_padded_make_the_same_model(case, rng):
    if case.name == "dense_krylov":
        pytest.skip("nothing new, and slow to list")
    mdp = MDP.from_successors(
        *as_successors(case.transition, rng),
        discount=case.discount,
        initial=case.initial,
        features=case.features,
    )
    chex.assert_trees_all_close(mdp, case.mdp, rtol=1e-15)


def test_successors_ascend_and_padding_is_last():
    mdp = small_models.case("restart").mdp
    inside = np.asarray(mdp.probability > 0)
    assert np.all(inside[..., :-1] >= inside[..., 1:])
    ascends = np.diff(mdp.next_state, axis=-1) > 0
    assert np.all(ascends | ~inside[..., 1:])
    assert np.all(np.asarray(mdp.next_state)[~inside] == 0)


def test_features_of_states_hold_for_every_action():
    features = np.arange(6.0).reshape(3, 2)
    mdp = MDP.from_dense(np.full((3, 4, 3), 1 / 3), discount=0.9, features=features)
    np.testing.assert_array_equal(mdp.features, np.repeat(features[:, None], 4, axis=1))


def test_initial_is_uniform_and_features_are_empty_by_default():
    mdp = MDP.from_dense(np.full((4, 2, 4), 0.25), discount=0.9)
    np.testing.assert_array_equal(mdp.initial, np.full(4, 0.25))
    chex.assert_shape(mdp.features, (4, 2, 0))


@pytest.mark.parametrize(
    ("transition", "expected"),
    [
        (np.ones((1, 1, 1), int), jnp.float64),
        (np.ones((1, 1, 1), np.float32), jnp.float32),
        ([[[1.0]]], jnp.float64),
        (np.ones((1, 1, 1), np.longdouble), jnp.float64),
        (jnp.ones((1, 1, 1), jnp.float32), jnp.float32),
    ],
)
def test_dtype_follows_the_transition(transition, expected):
    mdp = MDP.from_dense(transition, discount=0.9, features=np.ones((1, 2)))
    assert {mdp.dtype, mdp.initial.dtype, mdp.features.dtype, mdp.discount.dtype} == {jnp.dtype(expected)}


def test_replace_exchanges_arrays_and_keeps_the_rest():
    mdp = small_models.case("dense").mdp
    other = mdp.replace(discount=jnp.asarray(0.5))
    assert float(other.discount) == 0.5 and other.probability is mdp.probability


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("discount", [0.5, np.float64(0.5), jnp.asarray(0.5, jnp.float32), np.asarray(0.5)])
def test_replaced_numbers_have_the_type_of_the_old_ones(dtype, discount):
    mdp = MDP.from_dense(np.ones((1, 1, 1), dtype), discount=0.9, features=np.ones((1, 2)))
    other = mdp.replace(discount=discount, initial=[1], features=np.ones((1, 1, 2), int))
    for name in ("discount", "initial", "features"):
        assert getattr(other, name).aval == getattr(mdp, name).aval  # weak types would be traced anew


def test_replace_serves_descriptions_of_models_and_refuses_unknown_names():
    """Such as the axes of a vmap, whose leaves are no arrays."""
    mdp = small_models.case("dense").mdp
    assert jax.tree.map(lambda _: None, mdp).replace(discount=0).discount == 0
    with pytest.raises(ValueError, match="reward cannot be replaced"):
        mdp.replace(reward=0.0)


def test_model_is_a_pytree_that_passes_through_jit():
    for name in ("dense", "restart"):
        mdp = small_models.case(name).mdp
        chex.assert_trees_all_equal(jax.jit(lambda mdp: mdp)(mdp), mdp)


# ----------------------------------------------------------------------------- the one-step maps


class SweepsTest(chex.TestCase):
    """Both maps against dense products, compiled and not, with a trailing batch."""

    @chex.variants(with_jit=True, without_jit=True)
    def test_backward_and_forward(self):
        for name in ("dense", "restart"):
            case = small_models.case(name)
            rng = np.random.default_rng(1)
            num_states, num_actions = case.shape
            value = rng.normal(size=(num_states, 5))
            x = rng.normal(size=(num_states, num_actions, 5))
            backward = self.variant(expected_next_value)(case.mdp, value)
            forward = self.variant(push_forward)(case.mdp, x)
            expected = np.einsum("saz,zb->sab", case.transition, value)
            np.testing.assert_allclose(backward, expected, rtol=0, atol=1e-13)
            expected = np.einsum("saz,sab->zb", case.transition, x)
            np.testing.assert_allclose(forward, expected, rtol=0, atol=1e-12)


def test_sweeps_of_every_model(case, rng):
    """With a batch of one, which goes a way of its own."""
    value, x = rng.normal(size=(case.shape[0], 1)), rng.normal(size=(*case.shape, 1))
    backward = jax.jit(expected_next_value)(case.mdp, value)
    np.testing.assert_allclose(backward, case.transition @ value, rtol=0, atol=1e-13)
    forward = jax.jit(push_forward)(case.mdp, x)
    expected = np.einsum("saz,sab->zb", case.transition, x)
    np.testing.assert_allclose(forward, expected, rtol=0, atol=1e-12)


def test_sweeps_in_float32():
    case = small_models.in_float32(small_models.case("restart"))
    value = np.random.default_rng(1).normal(size=100).astype(np.float32)
    swept = jax.jit(expected_next_value)(case.mdp, value)
    assert swept.dtype == jnp.float32
    np.testing.assert_allclose(swept, case.transition @ value, rtol=0, atol=1e-6)


def test_vmapped_sweeps_agree_with_the_trailing_batch(rng):
    mdp = small_models.case("restart").mdp
    value, x = rng.normal(size=(100, 5)), rng.normal(size=(100, 3, 5))
    for sweep, batch in ((expected_next_value, value), (push_forward, x)):
        by_vmap = jax.jit(jax.vmap(sweep, in_axes=(None, -1), out_axes=-1))(mdp, batch)
        chex.assert_trees_all_close(by_vmap, jax.jit(sweep)(mdp, batch), atol=1e-13)


@pytest.mark.parametrize("name", ["dense", "sparse", "restart"])
def test_state_transition(name, rng):
    case = small_models.case(name)
    policy = small_models.random_policy(rng, *case.shape)
    expected = np.einsum("sa,saz->sz", policy, case.transition)
    np.testing.assert_allclose(jax.jit(state_transition)(case.mdp, policy), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_derivative_in_the_probabilities_is_the_transpose(name, rng):
    """d <x, T v> / dT is x(s, a) v(s') on the entries of T, whichever map it is computed by."""
    case = small_models.case(name)
    mdp = case.mdp
    value, x = jnp.asarray(rng.normal(size=case.shape[0])), jnp.asarray(rng.normal(size=case.shape))

    def by_backward(probability):
        return jnp.vdot(x, expected_next_value(mdp.replace(probability=probability), value))

    def by_forward(probability):
        return jnp.vdot(push_forward(mdp.replace(probability=probability), x), value)

    inside = np.asarray(mdp.probability > 0)
    expected = np.asarray(x[..., None] * value[mdp.next_state])
    for function in (by_backward, by_forward):
        gradient = np.asarray(jax.jit(jax.grad(function))(mdp.probability))
        np.testing.assert_allclose(gradient[inside], expected[inside], rtol=0, atol=1e-14)


def test_one_compilation_serves_all_models_of_one_shape(rng):
    chex.clear_trace_counter()
    sweep = jax.jit(chex.assert_max_traces(expected_next_value, n=1))
    mdp = small_models.case("restart").mdp
    for discount in (0.5, 0.9):
        other = mdp.replace(discount=jnp.asarray(discount), initial=np.full(100, 0.01))
        sweep(other, rng.normal(size=100))


# ---------------------------------------------------------------------------------- what is refused


def changed(array, index, value):
    array = np.array(array)
    array[index] = value
    return array


HALF = np.full((2, 2, 2), 0.5)


@pytest.mark.parametrize(
    ("transition", "message"),
    [
        (np.eye(2), "transition must have shape [S, A, S] with S, A >= 1, got (2, 2)"),
        (np.full((3, 2, 2), 0.5), "with S, A >= 1, got (3, 2, 2)"),
        (np.zeros((0, 2, 0)), "with S, A >= 1, got (0, 2, 0)"),
        (np.zeros((2, 0, 2)), "with S, A >= 1, got (2, 0, 2)"),
        (1.0, "with S, A >= 1, got ()"),
        ([[[1.0, 0.0]], [[1.0]]], "transition is not a rectangular array"),
        (changed(HALF, (1, 0, 1), np.nan), "transition[1, 0, 1] must be finite, got nan"),
        (changed(HALF, (0, 1, 0), np.inf), "transition[0, 1, 0] must be finite, got inf"),
        (changed(HALF, (1, 1), (1.5, -0.5)), "transition[1, 1, 1] must not be negative, got -0.5"),
        (changed(HALF, (1, 0, 1), 0.6), "sum of transition[1, 0] must be 1, got 1.1"),
        (changed(HALF, (0, 1, 1), 0.4), "sum of transition[0, 1] must be 1, got 0.9"),
        (HALF.astype(str), "transition must hold real numbers, got dtype <U"),
        (HALF.astype(complex), "transition must hold real numbers, got dtype complex128"),
        (HALF * 1e308, "sum of transition[0, 0] must be 1, got "),
        (jax.random.key(0), "transition is not a rectangular array"),
        (np.broadcast_to(1e-5, (40_000, 2, 40_000)), "40000 x 2 x 40000 successor slots"),
    ],
)
def test_from_dense_refuses_transition(transition, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MDP.from_dense(transition, discount=0.9)


@pytest.mark.parametrize(
    ("discount", "message"),
    [
        (0.0, "discount must lie strictly between 0 and 1, got 0.0"),
        (1.0, "discount must lie strictly between 0 and 1, got 1.0"),
        (1, "discount must lie strictly between 0 and 1, got 1.0"),
        (-0.5, "discount must lie strictly between 0 and 1, got -0.5"),
        (np.nan, "discount must be finite, got nan"),
        ([0.9, 0.9], "discount must have shape (), got (2,)"),
        ("high", "discount must hold real numbers"),
    ],
)
def test_constructors_refuse_discount(discount, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MDP.from_dense(HALF, discount=discount)


@pytest.mark.parametrize(
    ("discount", "message"),
    [
        (1.0 - 1e-9, "got 0.999999999: that is 1.0 in float32"),
        (1e-60, "got 1e-60: that is 0.0 in float32"),
    ],
)
def test_discounts_that_rounding_makes_useless_are_refused(discount, message):
    transition = changed(HALF, (1, 0, 1), 0.50009).astype(np.float32)
    with pytest.raises(ValueError, match=re.escape(message)):
        MDP.from_dense(transition, discount=discount)
    assert float(MDP.from_dense(HALF, discount=0.99995).discount) == 0.99995


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        ([1.0], "initial must have shape (2,), got (1,)"),
        ([[0.5, 0.5]], "initial must have shape (2,), got (1, 2)"),
        ([1.5, -0.5], "initial[1] must not be negative, got -0.5"),
        ([0.5, 0.6], "sum of initial must be 1, got 1.1"),
        ([0.5, np.nan], "initial[1] must be finite, got nan"),
    ],
)
def test_constructors_refuse_initial(initial, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MDP.from_dense(HALF, discount=0.9, initial=initial)


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (np.zeros(2), "features must have shape (2, 2, K) or (2, K), got (2,)"),
        (np.zeros((3, 4)), "features must have shape (2, 2, K) or (2, K), got (3, 4)"),
        (np.zeros((2, 3, 4)), "features must have shape (2, 2, K) or (2, K), got (2, 3, 4)"),
        (changed(np.zeros((2, 2, 3)), (0, 1, 2), np.nan), "features[0, 1, 2] must be finite"),
        (changed(np.zeros((2, 3)), (1, 2), np.inf), "features[1, 2] must be finite, got inf"),
        (changed(np.zeros((2, 3)), (1, 2), 1e60), "features[1, 2] is too large for float32, got 1e+60"),
    ],
)
def test_constructors_refuse_features(features, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MDP.from_dense(HALF.astype(np.float32), discount=0.9, features=features)


STATES = np.zeros((2, 1, 2), int)
CHANCES = np.full((2, 1, 2), 0.5)


@pytest.mark.parametrize(
    ("next_state", "probability", "message"),
    [
        (
            STATES[0],
            CHANCES[0],
            "next_state must have shape [S, A, N] with S, A, N >= 1, got (1, 2)",
        ),
        (STATES[..., :0], CHANCES[..., :0], "with S, A, N >= 1, got (2, 1, 0)"),
        (STATES, CHANCES[..., :1], "probability must have shape (2, 1, 2), got (2, 1, 1)"),
        (changed(STATES, (1, 0, 1), 2), CHANCES, "next_state[1, 0, 1] must be below 2, got 2"),
        (changed(STATES, (0, 0, 1), -1), CHANCES, "next_state[0, 0, 1] must not be negative"),
        (STATES + 0.5, CHANCES, "next_state[0, 0, 0] must be whole, got 0.5"),
        (STATES, changed(CHANCES, (1, 0, 0), np.nan), "probability[1, 0, 0] must be finite"),
        (
            STATES,
            changed(CHANCES, (1, 0), (1.5, -0.5)),
            "probability[1, 0, 1] must not be negative",
        ),
        (STATES, changed(CHANCES, (1, 0, 0), 0.6), "sum of probability[1, 0] must be 1, got 1.1"),
        (
            np.broadcast_to(0, (50_000, 5, 9_000)),
            np.broadcast_to(1 / 9_000, (50_000, 5, 9_000)),
            "50000 x 5 x 9000 successor slots",
        ),
    ],
)
def test_from_successors_refuses(next_state, probability, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MDP.from_successors(next_state, probability, discount=0.9)


def test_a_dense_layout_with_too_many_entries_is_refused_before_it_is_made(monkeypatch):
    """One row with a quarter of the states asks for the dense layout; the limit is lowered, for want of memory."""
    monkeypatch.setattr(checks, "MAX_SLOTS", 1000)
    next_state = np.tile(np.arange(10), (40, 1, 1))
    with pytest.raises(ValueError, match="40 x 1 x 40 successor slots"):
        MDP.from_successors(next_state, np.full(next_state.shape, 0.1), discount=0.9)


@pytest.mark.parametrize("argument", ["transition", "discount", "initial", "features"])
def test_traced_input_is_refused_with_the_remedy(argument):
    concrete = {"transition": HALF, "discount": 0.9, "initial": [0.5, 0.5], "features": np.eye(2)}

    def build(value):
        return MDP.from_dense(**{**concrete, argument: value})

    with pytest.raises(ValueError, match=rf"{argument} is a traced value.*\.replace"):
        jax.jit(build)(jnp.asarray(concrete[argument]))


def test_oracle_models_keep_their_zeros(rng):
    """A random sparse model, built both ways, has the oracle's successors and no others."""
    transition, discount, *_ = oracles.random_mdp(rng, 40, 3, N=4)
    mdp = MDP.from_dense(transition, discount=discount)
    chex.assert_shape(mdp.probability, (40, 3, 4))
    np.testing.assert_array_equal(np.asarray(mdp.transition) > 0, transition > 0)


def test_replacing_the_discount_asks_what_the_constructor_asks():
    """Rows within a few roundings of 1 are kept; with a discount nearer to 1 than that, sums would diverge."""
    transition = (np.full((3, 1, 3), 1 / 3) * (1 + 9e-7)).astype(np.float32)
    with pytest.raises(ValueError, match=r"too far above 1 for a discount of 0\.9999995"):
        MDP.from_dense(transition, discount=0.9999995)
    mdp = MDP.from_dense(transition, discount=0.9)
    with pytest.raises(ValueError, match=r"too far above 1 for a discount of 0\.9999995"):
        mdp.replace(discount=0.9999995)


def test_features_of_states_are_zero_where_an_action_does_not_exist():
    allowed = np.array([[True, False], [True, True]])
    mdp = MDP.from_dense(np.full((2, 2, 2), 0.5), discount=0.9, features=np.ones((2, 3)), allowed=allowed)
    np.testing.assert_array_equal(np.asarray(mdp.features), np.broadcast_to(allowed[..., None], (2, 2, 3)))


@pytest.mark.parametrize("name", ["features", "probability"])
def test_what_is_replaced_under_jit_is_zero_where_an_action_does_not_exist(name):
    """As it is at hand: what stands there may be anything."""
    allowed = np.array([[True, False], [True, True]])
    mdp = MDP.from_dense(np.full((2, 2, 2), 0.5), discount=0.9, features=np.ones((2, 3)), allowed=allowed)
    new = np.where(allowed[..., None], getattr(mdp, name), np.nan)
    replaced = jax.jit(lambda mdp, new: mdp.replace(**{name: new}))(mdp, new)
    chex.assert_trees_all_equal(replaced, mdp)


@pytest.mark.parametrize("is_model_traced", [True, False])
def test_actions_are_taken_away_under_jit(is_model_traced):
    mdp = MDP.from_dense(np.full((2, 2, 2), 0.5), discount=0.9, features=np.ones((2, 3)))
    allowed = np.array([[True, False], [True, True]])
    expected = mdp.replace(allowed=allowed)
    if is_model_traced:
        found = jax.jit(lambda mdp: mdp.replace(allowed=allowed))(mdp)
    else:
        found = jax.jit(lambda allowed: mdp.replace(allowed=allowed))(allowed)
    chex.assert_trees_all_equal(found, expected)
    with pytest.raises(ValueError, match="allowed must have shape"):
        jax.jit(lambda mdp: mdp.replace(allowed=allowed[:1]))(mdp)


def test_models_are_short_when_printed():
    text = repr(gridworld(5, num_regions=25).mdp)
    start = "MDP(num_states=25, num_actions=4, num_features=25, discount=0.99, dtype='float64', "
    assert text == start + "layout='successors', width=4)"
    axes = jax.tree.map(lambda _: None, gridworld(5).mdp)
    assert repr(axes).startswith("MDP(")


def test_a_dense_tensor_that_is_too_large_says_how_large():
    ring = np.arange(1, 50_001) % 50_000
    mdp = MDP.from_successors(np.tile(ring[:, None, None], (1, 2, 1)), np.ones((50_000, 2, 1)), discount=0.9)
    with pytest.raises(ValueError, match=r"would hold 50000 x 2 x 50000 numbers, 37 GiB in float64: work on its succ"):
        mdp.transition  # noqa: B018
    with pytest.raises(ValueError, match=r"chain would hold 50000 x 50000 numbers, 19 GiB"):
        mdp.dynamics.state_transition(np.full((50_000, 2), 0.5))
