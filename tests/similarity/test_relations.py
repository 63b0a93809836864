"""Relations beside LP (9): isomorphism, graph kernels, lax and functions of the user's, against brute force."""

import functools
import itertools

import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from small_models import dense_transition

from jaxhom import MDP, SimilarityTable, Status, disjoint_union, gridworld
from jaxhom.similarity import local_models, relations
from jaxhom.similarity.graph_kernels import NUM_ROUNDS, NUM_STEPS, walks_in_common

PAIRS = np.array(list(itertools.product(range(6), range(6)))).T


@functools.cache
def model(kind="sparse", dtype=np.float64):
    """Six states of which some are alike."""
    rng = np.random.default_rng(4)
    if kind == "ring":  # a ring with a chord: rotations and reflections of parts
        transition = np.zeros((6, 2, 6))
        for s in range(6):
            transition[s, 0, (s + 1) % 6] = transition[s, 1, (s - 1) % 6] = 1.0
        transition[0, 1] = np.eye(6)[3]
        return MDP.from_dense(transition.astype(dtype), discount=0.9)
    transition = oracles.random_mdp(rng, 6, 3, N=1 if kind == "deterministic" else 2)[0]
    transition[4:] = transition[:2]  # the last two do what the first two do
    allowed = np.ones((6, 3), bool)
    if kind == "restricted":
        allowed = rng.random((6, 3)) < 0.7
        allowed[:, 0] = True
    return MDP.from_dense(transition.astype(dtype), discount=0.9, allowed=allowed)


def local(mdp, state, labels=None, distance=1):
    """The local model and its labels, that of actions not allowed included, or None."""
    states, found = oracles.local_model(dense_transition(mdp), state, distance)
    parts = [] if labels is None else [labels[states]]
    if mdp.restricts_actions:
        parts.append(1.0 - np.asarray(mdp.allowed, float)[states][..., None])
    return found, np.concatenate(parts, axis=2) if parts else None


def by_brute_force(mdp, error, labels=None, distance=1):
    """error(source, target, labels) of all pairs, [P]."""
    found = []
    for s, t in PAIRS.T:
        (source, own), (target, other) = (local(mdp, state, labels, distance) for state in (s, t))
        found.append(error(source, target, None if own is None else (own, other)))
    return np.array(found)


def labels_for(mdp):
    return np.random.default_rng(0).integers(0, 2, (6, mdp.num_actions, 1)) * 0.5


def assert_bounds(found, errors, tolerance=1e-9):
    assert np.all(found.lower <= errors + 1e-9) and np.all(errors <= found.upper + 1e-9)
    assert np.all(found.upper - found.lower <= tolerance)
    assert np.all(found.status == Status.SOLVED)


KINDS = pytest.mark.parametrize("kind", ["sparse", "deterministic", "restricted", "ring"])


@KINDS
@pytest.mark.parametrize("labelled", [False, True])
def test_isomorphic(kind, labelled):
    mdp = model(kind)
    labels = labels_for(mdp) if labelled else None
    errors = by_brute_force(mdp, lambda *ends: 1.0 - oracles.are_isomorphic(*ends[:2], labels=ends[2]), labels)
    assert 0 < errors.mean() < 1
    assert_bounds(SimilarityTable(mdp, relation="isomorphic", labels=labels).brackets(*PAIRS), errors)


@KINDS
@pytest.mark.parametrize(("labelled", "anchored", "distance"), [(False, True, 1), (True, True, 2), (True, False, 1)])
def test_weisfeiler_lehman(kind, labelled, anchored, distance):
    mdp = model(kind)
    labels = labels_for(mdp) if labelled else None

    def error(source, target, labels):
        return 1.0 - oracles.weisfeiler_lehman_kernel(source, target, NUM_ROUNDS, anchored, labels)

    options = {"distance": distance, "anchored": anchored, "labels": labels}
    found = SimilarityTable(mdp, relation="weisfeiler_lehman", **options).brackets(*PAIRS)
    assert_bounds(found, by_brute_force(mdp, error, labels, distance))


@KINDS
@pytest.mark.parametrize(("labelled", "anchored", "distance"), [(False, True, 1), (True, True, 2), (True, False, 1)])
def test_walks_in_common(kind, labelled, anchored, distance):
    """Unnormalised, by walking through all pairs of paths of three steps."""
    mdp = model(kind)
    labels = labels_for(mdp) if labelled else None

    def both(source, target, labels):
        sizes = np.array([len(source)]), np.array([len(target)])
        kept = () if labels is None else tuple(side[None] for side in labels)
        found = walks_in_common(source[None], target[None], *sizes, kept, anchored=anchored, num_steps=3)[0]
        expected = oracles.walk_kernel(source, target, 3, anchored, labels)
        # Padding changes nothing.
        wide = np.zeros((1, len(source) + 2, source.shape[1], len(source) + 2))
        wide[0, : len(source), :, : len(source)] = source
        if labels is not None:
            kept = np.zeros((1, len(source) + 2, *labels[0].shape[1:])), kept[1]
            kept[0][0, : len(source)] = labels[0]
        again = walks_in_common(wide, target[None], *sizes, kept, anchored=anchored, num_steps=3)[0]
        return [found, expected, again]

    found, expected, again = by_brute_force(mdp, both, labels, distance).T
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(again, expected, rtol=1e-12)


@KINDS
def test_random_walk_is_the_normalised_kernel_of_long_walks(kind):
    """The walks that are cut off change little; by the linear system for walks without end."""
    mdp = model(kind)

    def kernel(source, target):
        n, m, num_actions = len(source), len(target), source.shape[1]
        alike = (np.arange(n) == 0)[:, None] == (np.arange(m) == 0)
        step = np.zeros((n, m, n, m))
        for i, k, j, q in np.ndindex(step.shape):
            if alike[j, q] and (i == j) == (k == q):
                step[i, k, j, q] = source[i, :, j] @ target[k, :, q] / num_actions
        matrix = np.eye(n * m) - 0.5 * step.reshape(n * m, n * m)
        return np.linalg.solve(matrix, np.ones(n * m))[0]

    def error(source, target, _):
        return 1.0 - kernel(source, target) / np.sqrt(kernel(source, source) * kernel(target, target))

    table = SimilarityTable(mdp, relation="random_walk")
    if not mdp.restricts_actions:
        np.testing.assert_allclose(table.brackets(*PAIRS).upper, by_brute_force(mdp, error), atol=0.5**NUM_STEPS)
    alike = SimilarityTable(mdp, relation="isomorphic").decide(*PAIRS)
    found = table.brackets(*PAIRS)
    assert np.all(found.upper[alike] < 1e-12) and np.all(found.lower <= 1.0)


@pytest.mark.parametrize(
    ("kind", "labelled", "anchored"),
    [
        ("sparse", False, True),
        ("sparse", True, True),
        ("deterministic", False, False),
        ("deterministic", True, True),
        ("restricted", False, True),
        ("restricted", False, False),
        ("ring", False, True),
        ("ring", True, True),
    ],
)
def test_lax_is_the_least_error_over_permutations(kind, labelled, anchored):
    mdp, solved = model(kind), {}
    labels = labels_for(mdp) if labelled else None
    table = SimilarityTable(mdp, relation="lax", labels=labels, anchored=anchored)

    def solve(source, target, both):
        """The oracle's error and its orders; pairs of models that occur twice are solved once."""
        arrays = [source, target, *(both or ())]
        key = tuple((array.shape, array.tobytes()) for array in map(np.ascontiguousarray, arrays))
        if key not in solved:
            solved[key] = oracles.lax_homomorphism_lp(source, target, anchored, both)
        return solved[key]

    least = by_brute_force(mdp, lambda *ends: solve(*ends)[0], labels)
    for threshold in (0.0, 0.3):
        asked = np.abs(least - threshold) > 2e-4
        similar = table.decide(*PAIRS, threshold)
        assert np.array_equal(similar[asked], (least <= threshold)[asked])
    found = table.brackets(*PAIRS)
    assert_bounds(found, least, 1e-4)
    renamings = table.renamings(*PAIRS)
    for (s, t), renaming, error in zip(PAIRS.T, renamings, least, strict=True):
        (source, own), (target, other) = (local(mdp, state, labels) for state in (s, t))
        kept = None if own is None else (own, other[:, renaming])
        assert oracles.homomorphism_lp(source, target[:, renaming], anchored, kept)[0] <= error + 2e-4
        best = solve(source, target, None if own is None else (own, other))[1]
        moved = [sum(a != b for a, b in enumerate(order)) for order in (renaming, *best)]
        assert moved[0] <= min(moved[1:])  # the fewest actions are renamed


def test_lax_maps_prove_their_errors():
    mdp = model("deterministic")
    table = SimilarityTable(mdp, relation="lax")
    maps, renamings = table.maps(*PAIRS), table.renamings(*PAIRS)
    for p, (s, t) in enumerate(PAIRS.T):
        (source, _), (target, _) = (local(mdp, state) for state in (s, t))
        f = maps.maps[p][: len(source), : len(target)]
        assert oracles.homomorphism_residual(source, target[:, renamings[p]], f) <= maps.upper[p] + 1e-12
    least = by_brute_force(mdp, lambda *ends: oracles.lax_homomorphism_lp(*ends[:2])[0])
    assert np.all(maps.lower <= least + 1e-9) and np.all(least <= maps.upper + 1e-9)
    assert_bounds(table.brackets(*PAIRS), least, 1e-4)  # after the maps, too


def test_corners_of_a_grid_are_alike_but_for_the_names_of_actions():
    table = SimilarityTable(gridworld(5), relation="lax")
    corners = np.array([[0, 0, 0], [4, 20, 24]])
    assert table.decide(*corners).all()
    for (s, t), renaming in zip(corners.T, table.renamings(*corners), strict=True):
        transition = np.asarray(gridworld(5).mdp.transition)
        (_, source), (_, target) = (oracles.local_model(transition, state, 1) for state in (s, t))
        assert oracles.homomorphism_lp(source, target[:, renaming])[0] < 1e-9
        assert sorted(renaming.tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize("relation", ["weisfeiler_lehman", "random_walk", "lax", "isomorphic"])
def test_relations_in_float32(relation):
    found = SimilarityTable(model("sparse", np.float32), relation=relation).brackets(*PAIRS, tolerance=1e-3)
    exact = SimilarityTable(model("sparse"), relation=relation).brackets(*PAIRS)
    assert found.lower.dtype == np.float32
    assert np.all(found.lower <= exact.upper + 1e-6) and np.all(exact.lower <= found.upper + 1e-6)


def test_a_function_of_the_users():
    mdp, asked = model("restricted"), []

    def size_matters(source, target):
        asked.append((source, target))
        return abs(len(source.states) - len(target.states)) / 10

    table = SimilarityTable(mdp, relation=size_matters)
    sizes = [len(local(mdp, s)[0]) for s in range(6)]
    errors = np.array([abs(sizes[s] - sizes[t]) / 10 for s, t in PAIRS.T])
    assert_bounds(table.brackets(*PAIRS), errors)
    assert len(asked) <= table.num_classes**2  # once for each pair of classes
    source, target = asked[-1]
    np.testing.assert_array_equal(source.transition, local(mdp, source.states[0])[0])
    np.testing.assert_array_equal(target.labels, local(mdp, target.states[0])[1])
    assert "size_matters" in repr(table)
    said = SimilarityTable(mdp, relation=lambda source, target: len(source.states) == len(target.states))
    assert np.array_equal(said.decide(*PAIRS), errors == 0)
    wide = SimilarityTable(mdp, relation=lambda source, target: (0.1, 0.4))
    found = wide.decisions(*PAIRS, 0.2)
    assert not found.similar.any() and np.all(found.status != Status.SOLVED)


@pytest.mark.parametrize("said", [-0.1, np.nan, "near", None, (0.3, 0.1), (0.1, 0.2, 0.3), np.ones(3)])
def test_what_a_function_must_not_say(said):
    with pytest.raises(ValueError, match="relation must return a bool, an error of at least 0, or a pair"):
        SimilarityTable(model(), relation=lambda source, target: said).decide([0], [1])


@pytest.mark.parametrize(
    ("relation", "message"),
    [
        ("isomorph", "relation must be one of .* or a function, got 'isomorph'"),
        (3, "relation must be one of .* or a function, got 3"),
        (None, "relation must be one of"),
    ],
)
def test_relations_that_there_are_not(relation, message):
    with pytest.raises(ValueError, match=message):
        SimilarityTable(model(), relation=relation)


def test_lax_with_too_many_actions_is_refused():
    mdp = MDP.from_dense(np.ones((1, 7, 1)), discount=0.9)
    with pytest.raises(ValueError, match="permutations of at most 6 actions, and the model has 7"):
        SimilarityTable(mdp, relation="lax")


@pytest.mark.parametrize("relation", ["weisfeiler_lehman", "random_walk", "isomorphic"])
def test_relations_without_maps_say_so(relation):
    table = SimilarityTable(model(), relation=relation)
    assert table.num_solved == 0 and table.renamings([0], [1]) is None
    with pytest.raises(ValueError, match=f"there are no maps behind the relation {relation}"):
        table.maps([0], [1])


def test_bounds_serve_all_thresholds():
    table = SimilarityTable(model("sparse"), relation="lax").complete(0.0).complete(0.2)
    solved = table.num_solved
    table.complete(0.0)
    table.decide(*PAIRS, 0.2)
    assert table.num_solved == solved


def cycles(lengths, order):
    """A centre that leads to all states of some cycles, numbered in some order."""
    size = 1 + sum(lengths)
    transition, first = np.zeros((size, 1, size)), 1
    transition[0, 0, 1:] = 1.0 / (size - 1)
    for length in lengths:
        here = first + np.arange(length)
        transition[here, 0, np.roll(here, 1)] += 0.5
        transition[here, 0, np.roll(here, -1)] += 0.5
        first += length
    renamed = np.append(0, 1 + np.asarray(order))
    return transition[renamed][:, :, renamed]


@pytest.mark.parametrize("lengths", [(6, 3, 3), (40,), (5, 5, 5, 5)])
def test_isomorphic_models_that_refinement_does_not_tell(lengths):
    """All states but the centre look the same to colours, and ties can be broken badly."""
    rng, size = np.random.default_rng(0), sum(lengths)
    models = [MDP.from_dense(cycles(lengths, rng.permutation(size)), discount=0.9) for _ in range(4)]
    union = disjoint_union(models)
    table = SimilarityTable(union, relation="isomorphic")
    assert table.decide(np.repeat(union.offsets, 4), np.tile(union.offsets, 4)).all()
    found = table.brackets(union.offsets[:1], union.offsets[1:2])
    assert found.lower[0] == 0.0 and found.upper[0] < 1e-9


def test_models_of_the_same_colours_that_are_not_isomorphic():
    union = disjoint_union([MDP.from_dense(cycles(one, range(12)), discount=0.9) for one in ((6, 6), (4, 4, 4), (12,))])
    starts = union.offsets
    found = SimilarityTable(union, relation="isomorphic").brackets(np.repeat(starts, 3), np.tile(starts, 3))
    assert found.upper.round(9).tolist() == [0, 1, 1, 1, 0, 1, 1, 1, 0]
    kernel = SimilarityTable(union, relation="weisfeiler_lehman").brackets(starts[:1], starts[1:2])
    assert kernel.upper[0] < 1e-9  # which is why it is another relation


def test_booleans_of_any_kind_say_the_same():
    mdp = model()
    expected = SimilarityTable(mdp, relation="isomorphic").decide(*PAIRS)
    iso = SimilarityTable(mdp, relation="isomorphic")
    for kind in (bool, np.bool_, np.array, jnp.asarray):

        def relation(source, target, kind=kind):
            return kind(bool(iso.decide(source.states[:1], target.states[:1])[0]))

        assert np.array_equal(SimilarityTable(mdp, relation=relation).decide(*PAIRS), expected)


def test_lax_renamings_do_not_depend_on_what_was_asked_before():
    """Of permutations whose errors differ by less than 1e-4 the first one counts, however close the brackets."""
    transition = np.zeros((6, 2, 6))
    for first, chances in ((0, (0.5, 0.50004)), (3, (0.50004, 0.5))):
        for action, chance in enumerate(chances):
            transition[first, action, [first + 1, first + 2]] = chance, 1.0 - chance
        transition[first + 1, :, first + 1] = transition[first + 2, :, first] = 1.0
    mdp = MDP.from_dense(transition, discount=0.9)
    for tolerance in (None, 1e-6, 1e-4, 0.9):
        table = SimilarityTable(mdp, relation="lax")
        if tolerance is not None:
            table.brackets([0], [3], tolerance=tolerance)
        assert table.renamings([0], [3]).tolist() == [[0, 1]]


def test_lax_maps_are_as_close_as_others():
    found = SimilarityTable(model("deterministic"), relation="lax").maps(*PAIRS)
    assert np.all(found.status == Status.SOLVED)


@pytest.mark.parametrize("relation", ["isomorphic", "weisfeiler_lehman", "random_walk"])
def test_hubs_too_large_to_be_looked_at_stay_undecided(relation, monkeypatch):
    """Two hubs lead to many states each, of which every other leads back and the rest stay."""
    monkeypatch.setattr(local_models, "_MAX_ENTRIES", 500)
    widths = []

    def walks(source, *others, **options):
        widths.append(source.shape[1])
        return walks_in_common(source, *others, **options)

    monkeypatch.setattr(relations, "walks_in_common", walks)
    transition, size = np.zeros((82, 2, 82)), 40
    for hub in (0, 1):
        spokes = 2 + hub * size + np.arange(size)
        transition[hub, :, spokes] = 1.0 / size
        transition[spokes[::2], :, spokes[::2]] = transition[spokes[1::2], :, hub] = 1.0
    table = SimilarityTable(MDP.from_dense(transition, discount=0.9), relation=relation)
    found = table.decisions([0, 0, 2, 2], [0, 1, 4, 0], 0.1)
    assert found.similar.tolist() == [relation == "isomorphic", False, True, False]
    assert found.status.tolist()[1:] == [Status.ITERATION_LIMIT, Status.SOLVED, Status.ITERATION_LIMIT]
    assert max(widths, default=0) ** 2 * 2 <= 500  # hubs are not walked on, against themselves neither
