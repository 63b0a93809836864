"""Local models against set arithmetic; their classes against brute force over all renamings."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom.domains.gridworld import gridworld
from jaxhom.domains.racetrack import racetrack
from jaxhom.models.graph import reachable_within
from jaxhom.models.mdp import MDP
from jaxhom.similarity import classes as classes_module
from jaxhom.similarity.canonical_forms import canonical_forms
from jaxhom.similarity.classes import local_model_classes, model_rounding
from jaxhom.similarity.local_models import local_models

MODELS = {
    "grid": lambda: oracles.gridworld_transition(5),
    "sparse": lambda: oracles.random_mdp(np.random.default_rng(1), 30, 2, N=2)[0],
    "dense": lambda: small_models.case("dense").transition,
    "absorbing": lambda: small_models.case("absorbing").transition,
    "restart": lambda: small_models.case("restart").transition,
    "one_state": lambda: np.ones((1, 2, 1)),
}


def as_mdp(transition):
    return MDP.from_dense(transition, discount=0.9)


def isomorphic(one, other, tolerance=1e-9):
    """Whether two local models are equal up to a renaming that keeps state 0: tries them all."""
    if one.shape != other.shape or not np.allclose(np.sort(one.ravel()), np.sort(other.ravel())):
        return False
    orders = np.array([[0, *rest] for rest in itertools.permutations(range(1, len(one)))])
    actions = np.arange(one.shape[1])[:, None]
    renamed = one[orders[:, :, None, None], actions, orders[:, None, None, :]]
    return bool(np.any(np.abs(renamed - other).max(axis=(1, 2, 3)) <= tolerance))


def brute_force_label(transition, distance):
    """Classes of all states, numbered in order of appearance."""
    representatives, label = [], []
    for s in range(len(transition)):
        _, model = oracles.local_model(transition, s, distance)
        found = [c for c, known in enumerate(representatives) if isomorphic(known, model)]
        label.append(found[0] if found else len(representatives))
        if not found:
            representatives.append(model)
    return np.array(label)


def same_partition(one, other):
    return np.array_equal(one[:, None] == one, other[:, None] == other)


# ------------------------------------------------------------------------------- the local models


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("distance", [1, 2, 3])
def test_against_set_arithmetic(name, distance):
    transition = MODELS[name]()
    states = np.arange(len(transition))[:: 1 + len(transition) // 30]
    models = local_models(as_mdp(transition), states, distance)
    assert models.members.shape[1] == models.size.max()
    for i, s in enumerate(states):
        members, model = oracles.local_model(transition, s, distance)
        n = len(members)
        assert models.size[i] == n
        np.testing.assert_array_equal(models.members[i, :n], members)
        np.testing.assert_array_equal(models.members[i, n:], -1)
        np.testing.assert_allclose(models.transition[i, :n, :, :n], model, rtol=0, atol=1e-15)
        assert not models.transition[i, n:].any() and not models.transition[i, :, :, n:].any()


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_reachable_within(name, steps):
    transition = MODELS[name]()
    reach = reachable_within(as_mdp(transition), steps).toarray()
    for s in range(len(transition)):
        np.testing.assert_array_equal(np.flatnonzero(reach[s]), oracles.reach(transition, s, steps))


def test_states_in_any_order_and_repeated():
    mdp = as_mdp(MODELS["grid"]())
    models = local_models(mdp, [7, 0, 7])
    np.testing.assert_array_equal(models.members[0], [7, 2, 6, 8, 12])
    np.testing.assert_array_equal(models.members[1], [0, 1, 5, -1, -1])
    for field in ("members", "size", "transition"):
        np.testing.assert_array_equal(getattr(models, field)[0], getattr(models, field)[2])


def test_no_states_at_all():
    mdp = as_mdp(MODELS["grid"]())
    assert local_models(mdp, []).transition.shape[0] == 0
    assert len(local_model_classes(mdp, []).label) == 0


@pytest.mark.parametrize("distance", [1, 30, 10**9])
def test_a_distance_beyond_the_model_gives_the_model(distance):
    transition = MODELS["dense"]()
    models = local_models(as_mdp(transition), np.arange(7), distance)
    np.testing.assert_allclose(models.transition[0], transition, rtol=0, atol=1e-15)
    for s, members in enumerate(models.members):
        expected = transition[np.ix_(members, range(3), members)]
        np.testing.assert_allclose(models.transition[s], expected, rtol=0, atol=1e-15)


def test_local_models_keep_the_dtype_and_the_rows_sum_to_one():
    mdp = small_models.in_float32(small_models.case("sparse")).mdp
    models = local_models(mdp, np.arange(40))
    assert models.transition.dtype == np.float32
    total = models.transition.sum(axis=-1)
    inside = np.arange(total.shape[1]) < models.size[:, None]
    np.testing.assert_allclose(total, np.where(inside[..., None], 1.0, 0.0) + 0 * total, atol=1e-6)


# ------------------------------------------------------------------------------------ the classes


@pytest.mark.parametrize("size", [3, 5, 12])
def test_a_gridworld_has_nine_classes(size):
    """The interior, four edges and four corners: a move keeps its name, so no two of them agree."""
    mdp = gridworld(size).mdp
    classes = local_model_classes(mdp)
    rows, columns = np.divmod(np.arange(size * size), size)
    place = 3 * np.sign(rows) * (1 + (rows == size - 1)) + np.sign(columns) * (1 + (columns == size - 1))
    assert len(classes.size) == 9
    assert same_partition(classes.label, place)
    np.testing.assert_array_equal(np.sort(classes.size), [3] * 4 + [4] * 4 + [5])


def test_float32_gridworld_has_nine_classes():
    assert len(local_model_classes(gridworld(6, dtype=np.float32).mdp).size) == 9


def test_track_a_has_113_classes():
    classes = local_model_classes(racetrack("a").mdp)
    assert len(classes.label) == 5900
    assert len(classes.size) == len(classes.representative) == 113


@pytest.mark.parametrize("distance", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_classes_are_those_of_brute_force_on_random_graphs(distance, seed):
    """Few probabilities and few neighbours, so that many local models agree."""
    rng = np.random.default_rng(seed)
    transition = np.zeros((24, 2, 24))
    for s, a in itertools.product(range(24), range(2)):
        block = 3 * (s // 3)  # it sees its block of three and the first state of the next
        near = rng.choice([block, block + 1, block + 2, (block + 3) % 24], 2, replace=False)
        transition[s, a, near] = [[0.5, 0.5], [0.25, 0.75], [1.0, 0.0]][rng.integers(3)]
    expected = brute_force_label(transition, distance)
    assert max(len(oracles.reach(transition, s, distance)) for s in range(24)) <= 7
    classes = local_model_classes(as_mdp(transition), distance=distance)
    assert same_partition(classes.label, expected)


@pytest.mark.parametrize("name", ["grid", "absorbing", "sparse"])
def test_classes_of_small_models_are_those_of_brute_force(name):
    transition = MODELS[name]()
    label = local_model_classes(as_mdp(transition)).label
    assert same_partition(label, brute_force_label(transition, 1))


@pytest.mark.parametrize("name", ["grid", "absorbing", "sparse"])
def test_a_key_is_the_model_itself_renamed(name):
    """So equal keys prove isomorphism, whatever the hashes do."""
    transition = MODELS[name]()
    for s in range(len(transition)):
        _, model = oracles.local_model(transition, s, 1)
        (key,), _ = canonical_forms(model[None], 40)
        renamed = np.frombuffer(key, np.uint64).reshape(model.shape) / 2.0**40
        assert isomorphic(model, renamed)


def test_representatives_are_the_first_of_their_classes():
    transition = MODELS["grid"]()
    states = np.array([24, 12, 0, 11, 12, 4])
    classes = local_model_classes(as_mdp(transition), states)
    assert same_partition(classes.label, np.array([0, 1, 2, 1, 1, 3]))
    for c, (state, size) in enumerate(zip(classes.representative, classes.size, strict=True)):
        first = np.flatnonzero(classes.label == c)[0]
        assert state == states[first]
        assert size == len(oracles.reach(transition, state, 1))
    np.testing.assert_array_equal(np.unique(classes.label), np.arange(len(classes.size)))


@pytest.mark.parametrize("distance", [1, 2, 3])
def test_renamed_copies_fall_into_the_same_classes(distance, rng):
    """Two disjoint copies of a model, the second with its states in another order."""
    transition = MODELS["sparse"]()
    size = len(transition)
    order = rng.permutation(size)
    both = np.zeros((2 * size, 2, 2 * size))
    both[:size, :, :size] = transition
    both[size:, :, size:] = transition[np.ix_(order, range(2), order)]
    label = local_model_classes(as_mdp(both), distance=distance).label
    np.testing.assert_array_equal(label[size:], label[:size][order])


def test_different_actions_or_centres_are_different_classes():
    """0 <-> 1 by action 0; 2 <-> 3 by action 1; 4 -> 5 by action 0, where 5 stays."""
    transition = np.repeat(np.eye(6)[:, None], 2, axis=1)
    for s, action, target in [(0, 0, 1), (1, 0, 0), (2, 1, 3), (3, 1, 2), (4, 0, 5)]:
        transition[s, action] = np.eye(6)[target]
    label = local_model_classes(as_mdp(transition)).label
    assert same_partition(label, np.array([0, 0, 1, 1, 2, 3]))


@pytest.mark.parametrize("difference", [0.0, 1e-14, 1e-9])
def test_probabilities_within_the_rounding_are_equal(difference):
    """Two pairs of states, the second with a probability that is `difference` greater."""
    transition = np.zeros((4, 1, 4))
    for block, p in ((0, 0.3), (2, 0.3 + difference)):
        transition[block, 0, [block, block + 1]] = [1 - p, p]
        transition[block + 1, 0, block + 1] = 1.0
    label = local_model_classes(as_mdp(transition)).label
    assert 1e-14 < model_rounding(np.float64) < 1e-9
    assert (label[0] == label[2]) == (difference < 1e-10)


def symmetric_models():
    """Centre 0 leads uniformly to six states that walk along cycles: one of six, or two of three.

    The six look the same to colour refinement, so ties must be broken; the two are not isomorphic.
    """
    models = []
    for successor in ([2, 3, 4, 5, 6, 1], [2, 3, 1, 5, 6, 4]):
        model = np.zeros((7, 1, 7))
        model[0, 0, 1:] = 1 / 6
        for s, target in enumerate(successor, start=1):
            model[s, 0, target] = model[s, 0, 0] = 0.5
        models.append(model)
    return models


def test_symmetric_models_are_told_apart_and_found_again(rng):
    blocks, kinds = [], []
    for kind, model in enumerate(symmetric_models()):
        for _ in range(6):
            order = [0, *(1 + rng.permutation(6))]
            blocks.append(model[np.ix_(order, [0], order)])
            kinds.append(kind)
    transition = np.zeros((84, 1, 84))
    for i, block in enumerate(blocks):
        transition[7 * i : 7 * i + 7, :, 7 * i : 7 * i + 7] = block
    one, other = symmetric_models()
    assert not isomorphic(one, other) and isomorphic(blocks[0], blocks[1])
    classes = local_model_classes(as_mdp(transition), 7 * np.arange(12))
    assert same_partition(classes.label, np.array(kinds))


@pytest.mark.parametrize("leaves", [4, 40])
def test_stars_of_any_size_break_their_ties(leaves):
    """Leaves that can all be exchanged; above 32 states ties are broken all at once."""
    size = leaves + 1
    star = np.zeros((size, 1, size))
    star[0, 0, 1:] = 1 / leaves
    star[1:, 0, 0] = 1.0
    transition = np.zeros((2 * size, 1, 2 * size))
    transition[:size, :, :size] = transition[size:, :, size:] = star
    label = local_model_classes(as_mdp(transition), [0, size, 1, size + 1], distance=2).label
    assert same_partition(label, np.array([0, 0, 1, 1]))


def test_large_models_that_only_look_alike_stay_apart():
    """Above 32 states: forty states on two cycles, or on one, below a centre."""
    transition = np.zeros((82, 1, 82))
    for start, cycles in ((0, [20, 20]), (41, [40])):
        transition[start, 0, start + 1 : start + 41] = 1 / 40
        first = start + 1
        for length in cycles:
            for i in range(length):
                transition[first + i, 0, [start, first + (i + 1) % length]] = 0.5
            first += length
    assert len(local_model_classes(as_mdp(transition), [0, 41]).size) == 2


@pytest.mark.parametrize("models_per_chunk", [1, 2, 7])
def test_classes_do_not_depend_on_the_chunks(models_per_chunk, monkeypatch):
    """Random blocks settle in one round, chains in several: a key must not know its neighbours."""
    block = oracles.random_mdp(np.random.default_rng(2), 8, 1)[0]
    chain = np.eye(8)[np.minimum(np.arange(8) + 1, 7)][:, None]
    transition = np.zeros((96, 1, 96))
    for i in range(12):
        transition[8 * i : 8 * i + 8, :, 8 * i : 8 * i + 8] = chain if i % 5 == 3 else block
    expected = local_model_classes(as_mdp(transition), distance=7).label
    assert np.unique(expected[0::8]).size == 2
    monkeypatch.setattr(classes_module, "_CHUNK_BYTES", models_per_chunk * 8 * 8**2)
    label = local_model_classes(as_mdp(transition), distance=7).label
    np.testing.assert_array_equal(label, expected)


# ---------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize("function", [local_models, local_model_classes])
@pytest.mark.parametrize(
    ("states", "distance", "message"),
    [
        ([0, 7], 1, r"states\[1\] must be below 7, got 7"),
        ([-1], 1, r"states\[0\] must not be negative, got -1"),
        ([0.5], 1, r"states\[0\] must be whole, got 0.5"),
        ([[0]], 1, r"states must have shape \[P\], got \(1, 1\)"),
        (3, 1, r"states must have shape \[P\], got \(\)"),
        ([True] * 7, 1, "states must hold integers, got dtype bool"),
        ([0], 0, "distance must be at least 1, got 0"),
        ([0], -2, "distance must be at least 1, got -2"),
    ],
)
def test_refused(function, states, distance, message):
    with pytest.raises(ValueError, match=message):
        function(small_models.case("dense").mdp, states, distance)


@pytest.mark.parametrize("function", [local_models, local_model_classes])
def test_traced_input_is_refused(function):
    mdp = small_models.case("dense").mdp
    with pytest.raises(ValueError, match="call this outside jit, vmap and grad"):
        jax.jit(lambda mdp: function(mdp, [0]))(mdp)
    with pytest.raises(ValueError, match="states is a traced value"):
        jax.jit(lambda states: function(mdp, states))(jnp.array([0]))
