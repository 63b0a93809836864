"""Models side by side: every part is what it was alone, and none leads to another."""

import jax
import numpy as np
import pytest
import small_models

import jaxhom
from jaxhom import Demonstrations, disjoint_union

LAKES = (["SFF", "FHF", "FFG"], ["SFFF", "FHFH", "FFFH", "HFFG"])


def lake(rows, dtype=np.float64):
    """Ice on which every move slips to the sides with probability 2/3; holes and the goal absorb."""
    height, width = len(rows), len(rows[0])
    transition = np.zeros((height * width, 4, height * width), dtype)
    for cell, action in np.ndindex(height * width, 4):
        row, column = divmod(cell, width)
        if rows[row][column] in "HG":
            transition[cell, action, cell] = 1
            continue
        for turn in (-1, 0, 1):
            down, right = [(0, -1), (1, 0), (0, 1), (-1, 0)][(action + turn) % 4]
            there = np.clip(row + down, 0, height - 1) * width + np.clip(column + right, 0, width - 1)
            transition[cell, action, there] += 1 / 3
    features = np.array([[letter == "G", letter == "H"] for line in rows for letter in line], float)
    return jaxhom.MDP.from_dense(transition, discount=0.9, initial=np.eye(len(features))[0], features=features)


def restricted(seed, states, dtype=np.float64):
    """A few successors per pair, and a few pairs that do not exist."""
    rng = np.random.default_rng(seed)
    transition = np.zeros((states, 3, states))
    for s, a in np.ndindex(states, 3):
        transition[s, a, rng.choice(states, 2, replace=False)] = rng.dirichlet(np.ones(2))
    allowed = rng.uniform(size=(states, 3)) < 0.8
    allowed[:, 0] = True
    features = rng.uniform(size=(states, 3, 2)).astype(dtype)
    return jaxhom.MDP.from_dense(transition.astype(dtype), discount=0.8, features=features, allowed=allowed)


UNIONS = {
    "lakes": lambda: [lake(rows) for rows in LAKES],
    "grids, lists": lambda: [jaxhom.gridworld(5, num_regions=1, discount=0.9), jaxhom.gridworld(7, num_regions=1)],
    "dense beside lists": lambda: [restricted(0, 4), restricted(1, 60)],
    "float32": lambda: [restricted(2, 5, np.float32), restricted(3, 30, np.float32)],
    "one": lambda: [restricted(4, 6)],
    "no features": lambda: [jaxhom.MDP.from_dense(np.eye(n)[:, None], discount=0.5) for n in (2, 1, 3)],
}


@pytest.fixture(params=UNIONS, scope="module")
def case(request):
    models = [getattr(model, "mdp", model) for model in UNIONS[request.param]()]
    models = [model.replace(discount=models[0].discount) for model in models]
    return models, disjoint_union(models)


def test_the_union_is_its_parts_block_by_block(case):
    models, union = case
    transition = small_models.dense_transition(union.mdp)
    assert union.mdp.num_states == sum(mdp.num_states for mdp in models) and union.mdp.dtype == models[0].dtype
    assert union.offsets.dtype == np.int32 and len(union.offsets) == len(models)
    for number, mdp in enumerate(models):
        inside = union.states(number)
        assert (inside.start, inside.stop - inside.start) == (union.offsets[number], mdp.num_states)
        np.testing.assert_array_equal(transition[inside, :, inside], small_models.dense_transition(mdp))
        np.testing.assert_array_equal(union.mdp.features[inside], mdp.features)
        np.testing.assert_array_equal(union.mdp.allowed[inside], mdp.allowed)
        np.testing.assert_allclose(len(models) * union.mdp.initial[inside], mdp.initial, rtol=1e-6)
        transition[inside, :, inside] = 0
    assert not transition.any()


def test_occupancies_and_values_are_those_of_the_parts(case):
    models, union = case
    rng, tolerance = np.random.default_rng(0), 1e-4 if union.mdp.dtype == np.float32 else 1e-9
    weight = rng.uniform(size=union.mdp.allowed.shape) * np.asarray(union.mdp.allowed)
    policy = weight / weight.sum(axis=1, keepdims=True)
    reward = rng.normal(size=policy.shape)
    occupancy, plan = jaxhom.occupancy(union.mdp, policy), jaxhom.optimal_policy(union.mdp, reward)
    for number, mdp in enumerate(models):
        inside = union.states(number)
        alone = jaxhom.occupancy(mdp, policy[inside])
        np.testing.assert_allclose(len(models) * occupancy[inside], alone, rtol=0, atol=10 * tolerance)
        value = jaxhom.optimal_policy(mdp, reward[inside]).value
        np.testing.assert_allclose(plan.value[inside], value, rtol=0, atol=10 * tolerance)


def test_sparse_parts_stay_lists():
    models = [jaxhom.gridworld(40, num_regions=1).mdp, jaxhom.gridworld(30, num_regions=1).mdp]
    union = disjoint_union(models)
    assert not union.mdp.is_dense and union.mdp.probability.shape == (2500, 4, models[0].probability.shape[-1])


def test_empty_slots_of_a_part_do_not_widen_the_others():
    """A dense part is a tensor, of which few entries of a row are successors."""
    few = np.zeros((8, 1, 8))
    few[np.arange(8), 0, np.arange(8)[::-1]] = few[np.arange(8), 0, (np.arange(8) + 2) % 8] = 0.5
    dense = jaxhom.MDP.from_dense(few, discount=0.9)
    long = jaxhom.MDP.from_successors(
        np.minimum(np.arange(50) + 1, 49)[:, None, None], np.ones((50, 1, 1)), discount=0.9
    )
    assert dense.is_dense
    assert disjoint_union([dense, long]).mdp.probability.shape == (58, 1, 2)


def test_a_union_of_unions_is_the_union_of_all_but_for_the_start():
    a, b, c = (restricted(seed, states) for seed, states in ((5, 3), (6, 4), (7, 5)))
    nested, flat = disjoint_union([disjoint_union([a, b]), c]), disjoint_union([a, b, c])
    expected = small_models.dense_transition(flat.mdp)
    np.testing.assert_array_equal(small_models.dense_transition(nested.mdp), expected)
    np.testing.assert_array_equal(nested.mdp.allowed, flat.mdp.allowed)
    assert nested.offsets.tolist() == [0, 7] and flat.offsets.tolist() == [0, 3, 7]
    np.testing.assert_allclose(nested.mdp.initial, np.repeat([1 / 12, 1 / 16, 1 / 10], [3, 4, 5]))


def test_demonstrations_in_a_part():
    models = [lake(rows) for rows in LAKES]
    union = disjoint_union(models)
    shown = Demonstrations.from_trajectories([([0, 1, 2], [2, 2]), ([0], [1])], terminated=[False, True])
    placed = union.place(1, shown)
    assert placed.states.tolist() == [[9, 10], [9, 0]] and placed.final_states.tolist() == [11, -1]
    assert placed.actions.tolist() == shown.actions.tolist() and placed.terminated.tolist() == [False, True]
    placed.validate(union.mdp, "ignore")
    inside = jax.jit(lambda union, shown: union.place(1, shown))(union, shown)
    np.testing.assert_array_equal(inside.states, placed.states)
    np.testing.assert_array_equal(inside.final_states, placed.final_states)
    one, _ = jaxhom.empirical_policy(models[1], shown)
    both, _ = jaxhom.empirical_policy(union.mdp, placed)
    np.testing.assert_array_equal(np.asarray(both)[union.states(1)], one)
    assert not np.asarray(both)[union.states(0)].any()


def test_demonstrations_in_one_model_vote_in_a_copy_of_it():
    """Neighbours in coordinates that both maps share are the same cells."""
    mdp = lake(LAKES[0])
    union = disjoint_union([mdp, mdp])
    shown = union.place(0, Demonstrations.from_trajectories([(np.arange(9), [0, 1, 2, 3, 0, 1, 2, 3, 0])]))
    cells = np.tile(np.indices((3, 3)).reshape(2, -1).T, (2, 1))
    general = jaxhom.nearest_neighbors(union.mdp, shown, metric="euclidean", coordinates=cells)
    decides = np.asarray([letter not in "HG" for line in LAKES[0] for letter in line])
    np.testing.assert_array_equal(general.policy[9:][decides], general.policy[:9][decides])


BAD = {
    "none": ([], "models is empty: a union needs one at least"),
    "no list": (lake(LAKES[0]), "models must be several, in a list for one, got MDP"),
    "no model": ([lake(LAKES[0]), 3], r"models\[1\]: a jaxhom.MDP is needed"),
    "actions": ([lake(LAKES[0]), restricted(0, 4)], r"models\[1\] has num_actions 3, models\[0\] has 4"),
    "features": (
        [lake(LAKES[0]), lake(LAKES[1]).replace(features=np.ones((16, 3)))],
        r"models\[1\] has num_features 3, models\[0\] has 2",
    ),
    "type": (
        [restricted(0, 4), restricted(0, 4, np.float32)],
        r"models\[1\] has dtype float32, models\[0\] has float64",
    ),
    "discount": (
        [lake(LAKES[0]), lake(LAKES[1]), lake(LAKES[1]).replace(discount=0.5)],
        r"models\[2\] has discount 0.5, models\[0\] has 0.9",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_models_that_do_not_fit_are_refused(name):
    models, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        disjoint_union(models)


def test_traced_models_are_refused():
    mdp = lake(LAKES[0])
    with pytest.raises(ValueError, match=r"models\[1\] is traced: unite models outside jit, vmap and grad"):
        jax.jit(lambda discount: disjoint_union([mdp, mdp.replace(discount=discount)]).mdp.initial)(0.9)


def test_parts_and_states_that_are_not_there_are_refused():
    union = disjoint_union([lake(rows) for rows in LAKES])
    with pytest.raises(ValueError, match="part must be below 2, got 2"):
        union.states(2)
    with pytest.raises(ValueError, match="part must be at least 0, got -1"):
        union.states(-1)
    with pytest.raises(ValueError, match=r"states\[0, 1\] must lie in \[0, 9\), the part's states .* got 9"):
        union.place(0, Demonstrations.from_trajectories([([0, 9], [0, 0])]))
    with pytest.raises(ValueError, match=r"final_states\[0\] must lie in \[0, 9\)"):
        union.place(0, Demonstrations.from_trajectories([([0, 12], [0])]))
    with pytest.raises(ValueError, match="offsets is a traced value"):
        jax.jit(lambda union: union.mdp.initial[union.states(0)])(union)
