"""Labels that maps have to keep: in LP (9) of local models, in classes, certificates and derivatives, against HiGHS."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from small_models import dense_transition

from jaxhom import MDP, SimilarityTable, disjoint_union, gridworld, local_similarity, locally_similar
from jaxhom.similarity.classes import isomorphism

PAIRS = np.array([[0, 1, 2, 3, 5], [4, 0, 6, 2, 5]])


@functools.cache
def model(restricted=False, dtype=np.float64):
    rng = np.random.default_rng(5)
    transition = oracles.random_mdp(rng, 7, 2, N=2)[0].astype(dtype)
    allowed = rng.random((7, 2)) < 0.7 if restricted else np.ones((7, 2), bool)
    allowed[:, 0] = True
    return MDP.from_dense(transition, discount=0.9, allowed=allowed)


def labels_for(mdp, seed=0, size=2, scale=1.0):
    return scale * np.random.default_rng(seed).uniform(-1, 1, (mdp.num_states, mdp.num_actions, size))


def exact(mdp, labels, pairs=PAIRS, distance=1, anchored=True, target=None, target_labels=None):
    """HiGHS's errors; actions that are not allowed are one more label."""
    sides = []
    for one, own in ((mdp, labels), (target or mdp, labels if target is None else target_labels)):
        refused = 1.0 - np.asarray(one.allowed, float)[..., None]
        sides.append((dense_transition(one), np.concatenate([own, refused], axis=2)))
    errors = []
    for pair in zip(*pairs, strict=True):
        models, kept = [], []
        for s, (transition, own) in zip(pair, sides, strict=True):
            states, local = oracles.local_model(transition, s, distance)
            models.append(local)
            kept.append(own[states])
        errors.append(oracles.homomorphism_lp(*models, anchored, kept)[0])
    return np.array(errors)


def assert_brackets(found, errors, tolerance=1e-4):
    assert np.all(found.lower <= errors + 1e-8) and np.all(errors <= np.asarray(found.upper) + 1e-8)
    assert np.all(found.upper - found.lower <= tolerance)
    assert np.all(found.status == 0)


@pytest.mark.parametrize("method", ["auto", "pdhg", "interior_point"])
@pytest.mark.parametrize(("distance", "anchored", "restricted"), [(1, True, False), (2, True, True), (1, False, True)])
def test_errors_keep_labels(method, distance, anchored, restricted):
    mdp, options = model(restricted), {"distance": distance, "anchored": anchored}
    labels = labels_for(mdp)
    found = local_similarity(mdp, *PAIRS, labels=labels, method=method, **options)
    assert_brackets(found, exact(mdp, labels, **options))


@pytest.mark.parametrize("scale", [1e-3, 30.0, 1e7])
def test_labels_count_as_they_are(scale):
    mdp = model()
    labels = labels_for(mdp, scale=scale)
    tolerance = 1e-4 * max(scale, 1.0)
    found = local_similarity(mdp, *PAIRS, labels=labels, tolerance=tolerance)
    assert_brackets(found, exact(mdp, labels), tolerance)
    weighted = local_similarity(mdp, *PAIRS, labels=labels / scale, label_weight=scale, tolerance=tolerance)
    assert np.all(weighted.lower <= found.upper) and np.all(found.lower <= weighted.upper)


def test_labels_in_float32():
    mdp = model(True, np.float32)
    labels = labels_for(mdp, scale=3.0)
    found = local_similarity(mdp, *PAIRS, labels=labels, tolerance=1e-3)
    assert found.lower.dtype == np.float32
    errors = exact(mdp, labels.astype(np.float32).astype(float))
    assert np.all(found.lower <= errors + 1e-6) and np.all(errors <= found.upper + 1e-6)


@pytest.mark.parametrize("shape", [(7, 1), (7, 2, 3)])
@pytest.mark.parametrize("restricted", [False, True])
def test_constant_labels_change_nothing(shape, restricted):
    mdp = model(restricted)
    plain = local_similarity(mdp, *PAIRS)
    found = local_similarity(mdp, *PAIRS, labels=np.full(shape, 7.0))
    assert np.all(found.lower <= plain.upper) and np.all(plain.lower <= found.upper)
    assert np.array_equal(SimilarityTable(mdp).classes(), SimilarityTable(mdp, labels=np.full(shape, 7.0)).classes())


def test_a_label_of_the_state_counts_for_every_action_and_a_reward_is_one_of_each():
    mdp = model()
    of_state = labels_for(mdp)[:, 0, :1]
    by_pair = np.repeat(of_state[:, None], 2, axis=1)
    assert np.allclose(local_similarity(mdp, *PAIRS, labels=of_state).upper, exact(mdp, by_pair), atol=1e-4)
    reward = labels_for(mdp)[..., 0]
    assert np.allclose(local_similarity(mdp, *PAIRS, labels=reward).upper, exact(mdp, reward[..., None]), atol=1e-4)


@pytest.mark.parametrize("distance", [1, 2])
def test_an_isomorphic_copy_has_error_0_and_the_same_classes(distance):
    mdp = model(True)
    labels, order = labels_for(mdp), np.random.default_rng(3).permutation(7)
    back = np.argsort(order)
    transition = dense_transition(mdp)[back][:, :, back]
    copy = MDP.from_dense(transition, discount=0.9, allowed=np.asarray(mdp.allowed)[back])
    states = np.arange(7)
    both = {"target_mdp": copy, "labels": labels, "target_labels": labels[back], "distance": distance}
    found = local_similarity(mdp, states, order, **both)
    assert np.all(found.upper < 1e-9) and np.all(found.iterations == 0)
    assert locally_similar(mdp, states, order, 0.0, mutual=True, **both).all()
    moved = labels[back].copy()
    moved[order[2]] += 0.25  # no longer a copy
    assert local_similarity(mdp, [2], order[[2]], **{**both, "target_labels": moved}).lower[0] > 0.2


def test_classes_tell_labels_apart():
    grid = gridworld(6)
    goal = np.zeros((36, 1))
    goal[14] = 1.0
    plain, table = SimilarityTable(grid), SimilarityTable(grid, labels=goal)
    assert len(np.unique(plain.classes([7, 8, 14]))) == 1
    assert len(np.unique(table.classes([7, 8, 14]))) == 3  # away from it, beside it, and it
    assert not table.decide([7], [8], 0.1)[0] and plain.decide([7], [8])[0]
    nearly = goal.copy()
    nearly[7] = 1e-14  # rounding
    assert len(np.unique(SimilarityTable(grid, labels=nearly).classes([7, 28]))) == 1


def test_renamings_keep_labels():
    mdp, labels = model(), np.array([[[0.0]], [[1.0]]])
    swap = np.array([[[0.0, 1.0]], [[1.0, 0.0]]])
    assert isomorphism(swap, swap, (labels, labels)).tolist() == [0, 1]
    assert isomorphism(swap, swap, (labels, labels[::-1])) is None
    maps = SimilarityTable(mdp, labels=labels_for(mdp)).maps(*PAIRS)
    assert np.all(exact(mdp, labels_for(mdp)) <= maps.upper + 1e-8)
    assert np.all(maps.upper - maps.lower <= 2e-6)


@pytest.mark.parametrize("restricted", [False, True])
def test_two_models_and_their_labels(restricted):
    rng = np.random.default_rng(8)
    mdp, other = model(restricted), MDP.from_dense(oracles.random_mdp(rng, 5, 2, N=2)[0], discount=0.5)
    labels, others, pairs = labels_for(mdp), labels_for(other, 1), np.array([[0, 3, 6], [4, 1, 0]])
    errors = exact(mdp, labels, pairs, target=other, target_labels=others)
    ends = {"target_mdp": other, "labels": labels, "target_labels": others}
    assert_brackets(local_similarity(mdp, *pairs, **ends), errors)
    similar = locally_similar(mdp, *pairs, float(np.median(errors)) + 0.01, **ends)
    assert similar.tolist() == (errors <= np.median(errors) + 0.01).tolist()
    union = disjoint_union([mdp, MDP.from_dense(dense_transition(other), discount=0.9)])
    table = SimilarityTable(union, labels=np.concatenate([labels, others]))
    assert_brackets(table.brackets(pairs[0], pairs[1] + union.offsets[1]), errors)


def test_labels_inside_programs_and_their_derivatives():
    mdp = model(True)
    labels = labels_for(mdp)
    pairs = PAIRS[:, :4]
    errors = exact(mdp, labels, pairs)

    def error(labels):
        return local_similarity(mdp, *pairs, labels=labels, tolerance=1e-7, method="interior_point").upper

    found = jax.jit(lambda own: local_similarity(mdp, *pairs, labels=own))(labels)
    assert np.all(found.lower <= errors + 1e-8) and np.all(errors <= found.upper + 1e-8)
    direction = labels_for(mdp, 9)
    _, slope = jax.jit(lambda x: jax.jvp(error, (x,), (jnp.asarray(direction),)))(jnp.asarray(labels))
    step = 1e-5
    ahead, behind = (exact(mdp, labels + sign * step * direction, pairs) for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), atol=1e-3)
    gradient = jax.grad(lambda x: error(x).sum())(jnp.asarray(labels))
    np.testing.assert_allclose((gradient * direction).sum(), slope.sum(), atol=1e-6)


def test_two_models_inside_programs():
    rng = np.random.default_rng(8)
    mdp, other = model(True), MDP.from_dense(oracles.random_mdp(rng, 5, 2, N=2)[0], discount=0.5)
    labels, others, pairs = labels_for(mdp), labels_for(other, 1), np.array([[0, 3, 6], [4, 1, 0]])
    errors = exact(mdp, labels, pairs, target=other, target_labels=others)

    def bounds(labels, others, **options):
        return local_similarity(mdp, *pairs, target_mdp=other, labels=labels, target_labels=others, **options)

    assert_brackets(jax.jit(bounds)(labels, others), errors)
    eager = locally_similar(mdp, *pairs, 0.5, target_mdp=other, mutual=True)
    traced = jax.jit(lambda s: locally_similar(mdp, s, pairs[1], 0.5, target_mdp=other, mutual=True))(pairs[0])
    assert traced.tolist() == eager.tolist()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"labels": np.zeros((3, 1))}, r"labels must have shape \(7, 2, L\) or \(7, L\), got \(3, 1\)"),
        ({"labels": np.full((7, 1), np.nan)}, r"labels\[0, 0\] must be finite"),
        ({"labels": np.zeros((7, 1)), "label_weight": -1.0}, "label_weight must not be negative"),
        ({"target_labels": np.zeros((7, 1))}, "target_labels are those of target_mdp, which is not given"),
        ({"target_mdp": model(), "labels": np.zeros((7, 1))}, "labels and target_labels must be given together"),
        (
            {"target_mdp": model(), "labels": np.zeros((7, 1)), "target_labels": np.zeros((7, 3))},
            "target_labels must have shape",
        ),
        ({"target_mdp": gridworld(3)}, "target_mdp has 4 actions, and mdp 2"),
        ({"target_mdp": model(), "table": SimilarityTable(model())}, "a table is about one model"),
        ({"table": SimilarityTable(model(), labels=np.ones((7, 1)))}, "table was made with labels, not without them"),
        (
            {"table": SimilarityTable(model()), "labels": np.ones((7, 1))},
            "table was made without labels, not with them",
        ),
        (
            {"table": SimilarityTable(model(), labels=np.ones((7, 1))), "labels": np.zeros((7, 1))},
            "table was made with other labels",
        ),
        ({"table": SimilarityTable(model(), relation="lax")}, "table was made with relation='lax', not with relation="),
    ],
)
def test_what_does_not_fit_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        local_similarity(model(), *PAIRS, **options)


@pytest.mark.parametrize(
    ("dtype", "size"), [(np.float32, 100.0), (np.float32, 1e9), (np.float64, 2e8), (np.float64, 1e100)]
)
def test_copies_are_alike_however_large_their_labels(dtype, size):
    """A ring of six, all alike; then one label is another."""
    transition = np.zeros((6, 2, 6), dtype)
    for s in range(6):
        transition[s, 0, (s + 1) % 6] = transition[s, 1, (s - 1) % 6] = 1.0
    mdp = MDP.from_dense(transition, discount=0.9)
    labels = np.full((6, 1), -size, dtype)
    found = SimilarityTable(mdp, labels=labels).decisions([0, 0], [0, 3])
    assert found.similar.all() and np.all(found.status == 0)
    labels[3] = 0.5 * size
    assert SimilarityTable(mdp, labels=labels).decide([0, 0], [0, 3]).tolist() == [True, False]


def test_labels_without_end_and_a_weight_without_labels_are_refused():
    with pytest.raises(ValueError, match=r"labels\[0, 0\] must be at most 1e\+154 in size, got 1e\+308"):
        SimilarityTable(model(), labels=np.full((7, 1), 1e308))
    with pytest.raises(ValueError, match="label_weight is 2.0, and there are no labels"):
        SimilarityTable(model(), label_weight=2.0)
