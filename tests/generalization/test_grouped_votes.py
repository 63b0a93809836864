"""Votes by groups of states, for large models, against rings around every state."""

import jax
import numpy as np
import pytest
import small_models

import jaxhom
from bench.road_graph import road_graph
from jaxhom.generalization import grouped_votes


def both(monkeypatch, learn):
    """What `learn` returns by rings, and by groups."""
    plain = learn()
    monkeypatch.setattr(grouped_votes, "_LARGE", 0)
    return plain, learn()


def require_equal(plain, grouped):
    for name in ("radius", "support", "undecided"):
        np.testing.assert_array_equal(getattr(grouped, name), getattr(plain, name))
    np.testing.assert_allclose(grouped.policy, plain.policy, atol=1e-12)
    assert grouped.status == plain.status


def walks_of(case, seed=0, count=3, steps=8):
    walk = small_models.random_policy(np.random.default_rng(seed), *case.shape)
    return jaxhom.sample_demonstrations(jax.random.key(seed), case.mdp, walk, count, steps)


SOME = [name for name in small_models.NAMES if name not in ("krylov", "dense_krylov")]  # whose local models are large


@pytest.mark.parametrize("name", SOME)
def test_small_models(name, monkeypatch):
    case = small_models.case(name)
    walks, threshold = walks_of(case), 0.3
    learn = lambda: jaxhom.soft_local_homomorphism(case.mdp, walks, threshold=threshold)  # noqa: E731
    require_equal(*both(monkeypatch, learn))


@pytest.mark.parametrize("name", SOME)
def test_nearest_neighbours(name, monkeypatch):
    case = small_models.case(name)
    walks = walks_of(case, seed=1)
    require_equal(*both(monkeypatch, lambda: jaxhom.nearest_neighbors(case.mdp, walks)))


def test_more_demonstrated_states_than_a_word_has_bits(monkeypatch):
    grid = jaxhom.gridworld(20)
    rng = np.random.default_rng(2)
    chosen = rng.choice(400, 150, replace=False)
    walks = jaxhom.Demonstrations.from_trajectories([([state], [rng.integers(4)]) for state in chosen])
    for relation in ("homomorphism", "lax"):
        learn = lambda relation=relation: jaxhom.soft_local_homomorphism(grid, walks, relation=relation)  # noqa: E731
        with monkeypatch.context() as patch:
            require_equal(*both(patch, learn))


def test_some_states_lack_actions(monkeypatch):
    """Roads: exits that states lack, and parts that nothing leads back from."""
    rng = np.random.default_rng(3)
    allowed = rng.random((60, 3)) < 0.7
    allowed[~allowed.any(axis=1), 0] = True
    following = (np.arange(60)[:, None] + rng.integers(1, 9, (60, 3))) % 60
    mdp = jaxhom.MDP.from_successors(following[..., None], np.ones((60, 3, 1)), discount=0.9, allowed=allowed)
    walks = jaxhom.sample_demonstrations(jax.random.key(0), mdp, allowed / allowed.sum(axis=1, keepdims=True), 2, 6)
    for learn in (jaxhom.soft_local_homomorphism, jaxhom.nearest_neighbors):
        with monkeypatch.context() as patch:
            require_equal(*both(patch, lambda learn=learn: learn(mdp, walks)))


def test_groups_are_asked_together_or_by_rings(monkeypatch):
    """Few groups in one call; all states different, or too many searches: rings, which ask for the nearest alone."""
    roads = road_graph(9, num_destinations=3).mdp
    walk = np.asarray(roads.allowed / roads.allowed.sum(axis=1, keepdims=True))
    walks = jaxhom.sample_demonstrations(jax.random.key(0), roads, walk, 3, 6)
    learn = lambda: jaxhom.soft_local_homomorphism(roads, walks)  # noqa: E731
    monkeypatch.setattr(grouped_votes, "_SHARED", 1)
    calls, decisions = [], jaxhom.SimilarityTable.decisions
    monkeypatch.setattr(
        jaxhom.SimilarityTable, "decisions", lambda *args, **options: calls.append(0) or decisions(*args, **options)
    )
    plain, grouped = both(monkeypatch, learn)
    require_equal(plain, grouped)
    assert len(calls) > 2
    calls.clear()
    learn()
    assert len(calls) == 1
    monkeypatch.setattr(grouped_votes, "_MOST_WORK", 0)
    require_equal(plain, learn())
    require_equal(jaxhom.nearest_neighbors(roads, walks), jaxhom.nearest_neighbors(roads, walks, progress=True))
    monkeypatch.undo()
    assert grouped_votes.are_searched(10**6, 1000, np.zeros(10**6, int))
    assert not grouped_votes.are_searched(3000, 300, np.arange(3000))


def test_undecided_states_are_counted_by_rings(monkeypatch):
    """How many of the pairs that stay open lie within the radius, only rings know."""
    grid = jaxhom.gridworld(6)
    walks = jaxhom.Demonstrations.from_trajectories([([0, 1, 7, 13], [3, 1, 1, 1])])
    learn = lambda: jaxhom.soft_local_homomorphism(grid, walks)  # noqa: E731
    decisions = jaxhom.SimilarityTable.decisions

    def some_open(self, *arguments, **options):
        found = decisions(self, *arguments, **options)
        status = np.array(found.status)
        status[~np.asarray(found.similar)] = jaxhom.Status.STALLED
        return found.replace(status=status)

    monkeypatch.setattr(jaxhom.SimilarityTable, "decisions", some_open)
    plain, grouped = both(monkeypatch, learn)
    assert np.asarray(plain.undecided).any()
    require_equal(plain, grouped)
