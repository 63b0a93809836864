"""A completed table as arrays of classes: what `decisions` says of every pair of states, and nothing solved for it."""

import functools

import jax
import numpy as np
import pytest

from jaxhom import MDP, Demonstrations, SimilarityTable, Status, gridworld, programs, soft_local_homomorphism
from jaxhom.similarity import brackets, class_pairs, decisions


@functools.cache
def model(dtype=np.float64):
    """Two models of three and four dense states, and one state that absorbs."""
    rng, transition = np.random.default_rng(0), np.zeros((8, 2, 8), dtype)
    transition[:3, :, :3] = rng.dirichlet(np.ones(3), size=(3, 2))
    transition[3:7, :, 3:7] = rng.dirichlet(np.ones(4), size=(4, 2))
    transition[7, :, 7] = 1.0
    return MDP.from_dense(transition, discount=0.9)


def assert_relation_is_decisions(table, mdp, threshold, **options):
    """Every pair of states, read off the arrays by hand."""
    solved = table.num_solved
    relation = table.relation(threshold, **options)
    assert table.num_solved == solved
    states = np.arange(mdp.num_states)
    sources, targets = np.repeat(states, len(states)), np.tile(states, len(states))
    expected = table.decisions(sources, targets, threshold, **options)
    assert table.num_solved == solved
    np.testing.assert_array_equal(relation.label, table.classes())
    pairs = relation.label[sources], relation.label[targets]
    np.testing.assert_array_equal(relation.similar[pairs], expected.similar)
    np.testing.assert_array_equal(relation.status[pairs], expected.status)
    np.testing.assert_array_equal(relation.undecided[pairs], expected.status != Status.SOLVED)
    assert (relation.label.dtype, relation.similar.dtype, relation.status.dtype) == (np.int32, bool, np.int32)
    return relation


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_relation_is_what_decisions_say(dtype):
    """Two thresholds of one table, in one direction and in both."""
    mdp = model(dtype)
    options = {"tolerance": 1e-3}
    table = SimilarityTable(mdp).complete(0.05, **options).complete(0.3, **options)
    shares = []
    for threshold in (0.05, 0.3):
        for mutual in (False, True):
            relation = assert_relation_is_decisions(table, mdp, threshold, mutual=mutual, **options)
            assert np.all(relation.similar == relation.similar.T) or not mutual
            shares.append(relation.similar.mean())
    assert shares[1] < shares[0] < shares[2] and shares[3] < shares[2]


def test_what_stayed_open_is_undecided(monkeypatch):
    """A threshold beside an error, and few iterations where nothing is decided without any."""
    grid = gridworld(4).mdp
    table = SimilarityTable(grid)
    errors = table.brackets(np.repeat(range(16), 16), np.tile(range(16), 16), tolerance=1e-7).lower
    beside = float(np.median(errors[errors > 0.1])) - 1e-6
    monkeypatch.setattr(programs, "pays", lambda seconds: True)  # all by programs, whose iterations are limited
    monkeypatch.setattr(brackets, "bounds_by_intervals", lambda models, asked, *goal: (0.0 * asked, np.inf + asked))
    monkeypatch.setattr(class_pairs, "_MAX_PRODUCTS", 0.0)
    monkeypatch.setattr(class_pairs, "_MIN_ITERATIONS", 1)
    fresh = SimilarityTable(grid).complete(beside, tolerance=1e-9)
    for mutual in (False, True):
        relation = assert_relation_is_decisions(fresh, grid, beside, mutual=mutual, tolerance=1e-9)
        assert np.any(relation.undecided) and not np.any(relation.similar & relation.undecided)


def test_a_table_that_is_not_complete_says_so():
    table = SimilarityTable(gridworld(4))
    with pytest.raises(ValueError, match=r"classes of 0 of 16 states: call table.complete\(threshold=0.0\) first"):
        table.relation()
    table.classes()
    message = r"not decided 81 of 81 pairs of classes for threshold 0.1 and .*: call table.complete\(threshold=0.1\)"
    with pytest.raises(ValueError, match=message):
        table.relation(0.1)
    table.complete(0.1)
    table.relation(0.1)
    with pytest.raises(ValueError, match="threshold must not be negative"):
        table.relation(-0.1)


def test_too_many_classes_are_refused(monkeypatch):
    monkeypatch.setattr(decisions, "MAX_CLASSES", 8)
    message = r"has 9 classes of local models: their 81 ordered pairs would take 0\.0 GB, and more than 8 classes"
    with pytest.raises(ValueError, match=message):
        SimilarityTable(gridworld(4)).complete()


def test_a_table_answers_inside_programs_of_constants():
    """Made, completed and asked while something else is traced."""
    grid = gridworld(3)

    @jax.jit
    def program(number):
        table = SimilarityTable(grid).complete(0.2)
        similar = table.decide([0, 4], [8, 4], 0.2)
        assert isinstance(table.relation(0.2).similar, np.ndarray) and table.brackets([0], [8]).upper.shape == (1,)
        return number * similar

    assert program(2).shape == (2,)


@pytest.mark.parametrize("name", ["threshold", "tolerance"])
def test_traced_options_are_refused(name):
    table = SimilarityTable(gridworld(3))
    for method in (table.complete, table.relation, lambda **options: table.decide([0], [1], **options)):
        with pytest.raises(ValueError, match=f"{name} is a traced value: inside jit, vmap and grad it must be a con"):
            jax.jit(lambda value, method=method: method(**{name: value}))(0.1)


def test_a_table_of_another_model_is_refused_inside_programs():
    """Where the model is traced its shapes are compared; where it is not, its graph."""
    grid, other = gridworld(4), gridworld(4, noise=0.1)
    table = SimilarityTable(grid).complete()

    def learn(mdp, states):
        shown = uniform_steps(states)
        return soft_local_homomorphism(mdp, shown, table=table).radius

    with pytest.raises(ValueError, match="table was made for another model"):
        jax.jit(learn)(gridworld(5).mdp, np.arange(3))
    with pytest.raises(ValueError, match="table was made for another model"):
        jax.jit(lambda states: learn(other.mdp, states))(np.arange(3))
    assert jax.jit(learn)(grid.mdp, np.arange(3)).shape == (16,)


def uniform_steps(states):
    states = states[None].astype(np.int32)
    return Demonstrations(states=states, actions=0 * states, mask=states >= 0)
