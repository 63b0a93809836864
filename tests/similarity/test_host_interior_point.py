"""LP (9) on the host: against HiGHS, with padding, labels and thresholds; and which work is small enough for it."""

import dataclasses

import numpy as np
import oracles
import pytest

from jaxhom import gridworld, local_similarity, locally_similar
from jaxhom.similarity import brackets, host_interior_point, newton
from jaxhom.similarity.brackets import Goal, bracket_errors
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.host_certificates import forward
from jaxhom.similarity.host_interior_point import solve_on_host
from jaxhom.similarity.host_normal_matrices import normal_matrices
from jaxhom.status import Status


def random_models(rng, count, n, actions, concentration=0.3):
    return rng.dirichlet(np.full(n, concentration), (count, n, actions))


def padded(models, width):
    """[P, n, A, n] -> [P, width, A, width], padding without transitions."""
    count, n, actions, _ = models.shape
    result = np.zeros((count, width, actions, width))
    result[:, :n, :, :n] = models
    return result


def problem(source, target, anchored=True, labels=None, sizes=None):
    sizes = sizes or (source.shape[1], target.shape[1])
    last = [None if a is None else np.moveaxis(a, 0, -1) for a in (source, target, *(labels or (None, None)))]
    of_size = [np.full(len(source), size) for size in sizes]
    return HomomorphismProblem(*last[:2], *of_size, anchored, *last[2:])


def solve(*args, tolerance=1e-7, threshold=np.nan, **options):
    return solve_on_host(problem(*args, **options), tolerance, threshold, lambda _: None)


@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize(("n", "m", "actions"), [(1, 1, 1), (1, 3, 2), (4, 1, 2), (3, 5, 2), (6, 4, 3)])
def test_brackets_against_highs(n, m, actions, anchored, rng):
    source, target = random_models(rng, 5, n, actions), random_models(rng, 5, m, actions)
    found = solve(source, target, anchored)
    exact = np.array([oracles.homomorphism_lp(*pair, anchored)[0] for pair in zip(source, target, strict=True)])
    assert np.all(found.lower <= exact + 1e-9)
    assert np.all(exact <= found.upper + 1e-9)
    assert np.all(found.upper - found.lower <= 1e-7)
    own = np.abs(forward(source, target, None, None, found.maps)).max(axis=(1, 2, 3))
    assert np.all(own <= found.upper)
    np.testing.assert_allclose(found.maps.sum(axis=2), 1.0, atol=1e-12)


@pytest.mark.parametrize("anchored", [True, False])
def test_padding_and_labels(anchored, rng):
    source, target = random_models(rng, 4, 3, 2), random_models(rng, 4, 4, 2)
    own, other = rng.uniform(size=(4, 3, 2, 2)), rng.uniform(size=(4, 4, 2, 2))
    wide = tuple(np.pad(labels, ((0, 0), (0, 6 - labels.shape[1]), (0, 0), (0, 0))) for labels in (own, other))
    found = solve(padded(source, 6), padded(target, 6), anchored, labels=wide, sizes=(3, 4))
    plain = solve(source, target, anchored, labels=(own, other))
    for k in range(4):
        exact = oracles.homomorphism_lp(source[k], target[k], anchored, labels=(own[k], other[k]))[0]
        for bounds in (found, plain):
            assert bounds.lower[k] - 1e-9 <= exact <= bounds.upper[k] + 1e-9
            assert bounds.upper[k] - bounds.lower[k] <= 1e-7
    assert np.all(found.maps[:, 3:] == 0)
    assert np.all(found.maps[:, :, 4:] == 0)


@pytest.mark.parametrize("first", [0, 1])
def test_normal_matrices_are_those_of_the_compiled_method(first, rng):
    source, target = random_models(rng, 3, 4, 2), random_models(rng, 3, 3, 2)
    labels = rng.uniform(size=(3, 4, 2, 2)), rng.uniform(size=(3, 3, 2, 2))
    weight = rng.uniform(size=(3, 4, 2, 5))
    found = normal_matrices(source, target, weight, first, *labels)
    for k in range(3):
        other = newton.normal_matrix(source[k], target[k], weight[k], first, labels[0][k], labels[1][k])
        np.testing.assert_allclose(found[k], other, rtol=1e-12, atol=1e-12)


def test_thresholds_end_sooner(rng):
    source, target = random_models(rng, 6, 4, 2), random_models(rng, 6, 4, 2)
    full, quick = solve(source, target), solve(source, target, threshold=0.05)
    is_similar, is_far = quick.upper <= 0.05 + 1e-7, quick.lower > 0.05
    assert np.all(is_similar | is_far)
    assert quick.steps.sum() < full.steps.sum()


def test_what_is_not_finite_ends_alone(rng):
    source, target = random_models(rng, 3, 4, 2), random_models(rng, 3, 4, 2)
    source[1] = np.nan
    found = solve(source, target)
    assert np.all((found.upper - found.lower)[[0, 2]] <= 1e-7)
    assert not found.upper[1] - found.lower[1] <= 1e-7


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_few_pairs_compile_nothing(dtype, monkeypatch, rng):
    """And are as close as asked for in float32, whose bounds are rounded outwards."""

    def refuse(*_, **__):
        raise AssertionError("a program was asked for")

    monkeypatch.setattr(brackets, "solve_many", refuse)
    source, target = (random_models(rng, 5, n, 3).astype(dtype) for n in (5, 4))
    found = bracket_errors(source, target, goal=Goal(tolerance=1e-5))
    assert found.lower.dtype == dtype
    assert np.all(found.status == Status.SOLVED)
    for k in range(5):
        exact = oracles.homomorphism_lp(source[k].astype(float), target[k].astype(float))[0]
        assert found.lower[k] <= exact + 1e-6
        assert exact <= found.upper[k] + 1e-6
    grid = gridworld(5)
    near = local_similarity(grid, [0, 6], [4, 7])
    assert np.all(near.upper - near.lower <= 1e-4)
    assert locally_similar(grid, [0, 6], [4, 7], 0.1).tolist() == [False, True]


def test_many_pairs_and_large_models_are_compiled():
    def sizes(n, m, count):
        shapes = ((n, 2, n, count), (m, 2, m, count))
        return HomomorphismProblem(*map(np.zeros, shapes), np.full(count, n), np.full(count, m), True)

    assert brackets.is_small_work(sizes(5, 5, 1000))
    assert not brackets.is_small_work(sizes(5, 5, 10_000))
    assert brackets.is_small_work(sizes(25, 25, 4))
    assert not brackets.is_small_work(sizes(25, 25, 400))
    assert not brackets.is_small_work(sizes(60, 4, 1))


def test_pairs_of_mixed_sizes_are_solved_as_if_alone(rng):
    """Batches of similar sizes, on all cores: every pair gets what it gets by itself, in its place."""
    sizes = [(1, 1), (2, 7), (9, 3), (4, 4), (9, 9), (3, 8), (5, 2), (9, 8)]
    alone, lanes = [], []
    for n, m in sizes:
        source, target = random_models(rng, 1, n, 3), random_models(rng, 1, m, 3)
        alone.append(solve(source, target))
        lanes.append((padded(source, 9), padded(target, 9)))
    source, target = map(np.concatenate, zip(*lanes, strict=True))
    together = dataclasses.replace(
        problem(source, target),
        source_size=np.array([n for n, _ in sizes]),
        target_size=np.array([m for _, m in sizes]),
    )
    seen = []
    found = solve_on_host(together, 1e-7, np.nan, seen.append)
    assert sum(seen) == len(sizes) and len(seen) > 1
    np.testing.assert_allclose(found.lower, np.concatenate([one.lower for one in alone]), rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.upper, np.concatenate([one.upper for one in alone]), rtol=0, atol=1e-7)
    for k, (n, m) in enumerate(sizes):
        np.testing.assert_allclose(found.maps[k, :n, :m].sum(axis=1), 1.0, rtol=0, atol=1e-12)
        assert not found.maps[k, n:].any() and not found.maps[k, :, m:].any()


def test_a_singular_lane_stops_alone(monkeypatch, rng):
    source, target = random_models(rng, 7, 4, 2), random_models(rng, 7, 3, 2)
    whole, step = solve(source, target), host_interior_point._step

    def fail_where(models, point):
        if np.any(np.all(models.source == source[2], axis=(1, 2, 3))):
            raise np.linalg.LinAlgError
        return step(models, point)

    monkeypatch.setattr(host_interior_point, "_step", fail_where)
    found = solve(source, target)
    others = np.arange(7) != 2
    np.testing.assert_allclose(found.upper[others], whole.upper[others], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.steps[others], whole.steps[others])
    assert found.steps[2] < whole.steps[2]
    assert found.lower[2] <= whole.upper[2] <= found.upper[2] < np.inf
