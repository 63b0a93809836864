"""The error of LP (9) as a differentiable function of two models: values and slopes against HiGHS."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxhom import homomorphism_error, homomorphism_map
from jaxhom.similarity import model_errors
from jaxhom.solvers import pdhg


def random_model(rng, size, num_actions, concentration=0.5):
    return rng.dirichlet(np.full(size, concentration), size=(size, num_actions))


@functools.cache
def small_pairs():
    """Models of three and of four states, [12, 3, 2, 3] and [12, 4, 2, 4]; of the last two pairs e = 0."""
    rng = np.random.default_rng(8)
    sources, targets = (np.stack([random_model(rng, n, 2, 1.0) for _ in range(12)]) for n in (3, 4))
    targets[10:] = 0.0
    targets[10:, :3, :, :3] = sources[10:]
    targets[10:, 3, :, 0] = 1.0
    return sources, targets


@functools.cache
def small_errors(anchored):
    pairs = zip(*small_pairs(), strict=True)
    return np.array([oracles.homomorphism_lp(*pair, anchored)[0] for pair in pairs])


@functools.cache
def compiled(anchored):
    """Values and derivatives of all twelve pairs."""
    error = functools.partial(homomorphism_error, anchored=anchored)
    return jax.jit(jax.vmap(jax.value_and_grad(error, argnums=(0, 1))))


@pytest.mark.parametrize("anchored", [True, False])
def test_value(anchored):
    values, _ = compiled(anchored)(*small_pairs())
    np.testing.assert_allclose(values, small_errors(anchored), rtol=0, atol=1e-6)


@pytest.mark.parametrize("anchored", [True, False])
def test_gradient_against_differences_of_highs(anchored):
    """In random directions that keep the sums of rows; at a kink, between the one-sided slopes."""
    sources, targets = small_pairs()
    _, gradients = compiled(anchored)(sources, targets)
    rng, h, smooth = np.random.default_rng(9), 1e-5, 0
    for i in range(12):
        directions = [rng.normal(size=model[i].shape) for model in (sources, targets)]
        directions = [d - d.mean(axis=-1, keepdims=True) for d in directions]
        for moves in ((1, 0), (0, 1), (1, 1)):
            ds, dt = (move * d for move, d in zip(moves, directions, strict=True))
            up, down = (oracles.homomorphism_lp(sources[i] + t * ds, targets[i] + t * dt, anchored)[0] for t in (h, -h))
            slopes = np.sort([up - small_errors(anchored)[i], small_errors(anchored)[i] - down]) / h
            slope = np.sum(gradients[0][i] * ds) + np.sum(gradients[1][i] * dt)
            assert slopes[0] - 2e-3 <= slope <= slopes[1] + 2e-3
            smooth += slopes[1] - slopes[0] < 1e-3
    assert smooth >= 28


def test_transformations_agree():
    """Eager calls, jvp, and nested vmap, each over one argument, under jit."""
    sources, targets = small_pairs()
    values, gradients = compiled(True)(sources, targets)
    eager = homomorphism_error(sources[0], targets[0])
    chex.assert_shape(eager, ())
    np.testing.assert_allclose(eager, values[0], rtol=0, atol=1e-6)
    over_targets = jax.vmap(homomorphism_error, in_axes=(None, 0))
    table = jax.jit(jax.vmap(over_targets, in_axes=(0, None)))(sources[:3], targets[:4])
    expected = [[oracles.homomorphism_lp(s, t)[0] for t in targets[:4]] for s in sources[:3]]
    np.testing.assert_allclose(table, expected, rtol=0, atol=1e-6)
    tangents = sources[0] - sources[1], targets[0] - targets[1]
    value, slope = jax.jvp(homomorphism_error, (sources[0], targets[0]), tangents)
    np.testing.assert_allclose(value, values[0], rtol=0, atol=1e-6)
    expected = sum(np.sum(g[0] * t) for g, t in zip(gradients, tangents, strict=True))
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-4)


def test_eager_calls_compile_once(monkeypatch):
    sources, targets = small_pairs()
    homomorphism_error(sources[0], targets[0])
    traces = []
    monkeypatch.setattr(pdhg, "step", lambda *args: traces.append(args))
    homomorphism_error(sources[1], targets[1])
    assert not traces


def test_a_pair_that_is_not_a_number_spoils_no_other():
    sources, targets = (model.copy() for model in small_pairs())
    sources[0, 0, 0, 0] = np.nan
    values, gradients = compiled(True)(sources, targets)
    np.testing.assert_allclose(values[1:], small_errors(True)[1:], rtol=0, atol=1e-6)
    assert not np.isfinite(values[0]) and np.all(np.isfinite(gradients[0][1:]))


def test_one_state():
    """Anchored, its one row is fixed: the error is what leaves the target's centre. To one state everything fits."""
    alone = np.ones((1, 2, 1))
    leaving = np.array([[[0.6, 0.4], [1.0, 0.0]], [[0.0, 1.0], [0.0, 1.0]]])
    value, slope = jax.value_and_grad(homomorphism_error, argnums=1)(alone, leaving)
    np.testing.assert_allclose(value, 0.4, rtol=0, atol=1e-6)
    direction = np.zeros((2, 2, 2))
    direction[0, 0] = [-1.0, 1.0]
    np.testing.assert_allclose(np.sum(slope * direction), 1.0, rtol=0, atol=1e-5)
    np.testing.assert_allclose(homomorphism_error(leaving, alone), 0.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(homomorphism_error(alone, leaving, anchored=False), 0.0, rtol=0, atol=1e-6)
    assert oracles.homomorphism_lp(alone, leaving)[0] == pytest.approx(0.4)


@pytest.mark.parametrize(
    "twice",
    [
        jax.hessian(homomorphism_error),
        jax.jacfwd(jax.jacfwd(homomorphism_error)),
        jax.jit(jax.jacrev(jax.grad(homomorphism_error))),
        jax.vmap(jax.hessian(homomorphism_error)),
    ],
    ids=["forward over reverse", "forward over forward", "reverse over reverse", "under vmap"],
)
def test_second_derivatives_are_refused(twice, request):
    index = slice(0, 2) if "vmap" in request.node.name else 0
    with pytest.raises(ValueError, match="homomorphism_error has first derivatives only"):
        twice(*(model[index] for model in small_pairs()))


def test_an_open_bracket_is_no_number(monkeypatch):
    monkeypatch.setattr(model_errors, "_MAX_ITERATIONS", 16)
    monkeypatch.setattr(model_errors, "choose_method", lambda *args: "pdhg")
    rng = np.random.default_rng(1)
    value, slope = jax.value_and_grad(homomorphism_error)(random_model(rng, 3, 2), random_model(rng, 5, 2))
    assert np.isnan(value) and np.isnan(slope).all()


@functools.cache
def labelled_pairs():
    """Models of three and four states with one label each."""
    rng = np.random.default_rng(11)
    return tuple(np.stack(a) for a in zip(*([rng.dirichlet(np.ones(3), (3, 2)), rng.dirichlet(np.ones(4), (4, 2)),
                 rng.random((3, 2, 1)), rng.random((4, 2, 1))] for _ in range(4)), strict=True))  # fmt: skip


def labelled_error(source, target, source_labels, target_labels):
    return homomorphism_error(source, target, source_labels=source_labels, target_labels=target_labels)


def test_labels_and_their_derivatives():
    """Against HiGHS, and differences of it, in random directions of all four arrays; forward and in reverse."""
    pairs = labelled_pairs()
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(labelled_error, argnums=(0, 1, 2, 3))))(*pairs)
    rng, h, smooth = np.random.default_rng(12), 1e-5, 0

    def exact(arrays):
        return oracles.homomorphism_lp(*arrays[:2], True, arrays[2:])[0]

    for i in range(4):
        arrays = [array[i] for array in pairs]
        middle = exact(arrays)
        np.testing.assert_allclose(values[i], middle, rtol=0, atol=1e-6)
        moves = [rng.normal(size=array.shape) for array in arrays]
        moves[:2] = [move - move.mean(axis=-1, keepdims=True) for move in moves[:2]]
        up, down = (exact([a + t * move for a, move in zip(arrays, moves, strict=True)]) for t in (h, -h))
        one_sided = np.sort([up - middle, middle - down]) / h
        slope = sum(np.sum(g[i] * move) for g, move in zip(slopes, moves, strict=True))
        assert one_sided[0] - 2e-3 <= slope <= one_sided[1] + 2e-3
        smooth += one_sided[1] - one_sided[0] < 1e-3
    assert smooth >= 3
    _, forward = jax.jvp(labelled_error, tuple(arrays), tuple(moves))
    np.testing.assert_allclose(forward, slope, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("source_labels", "target_labels", "message"),
    [
        (np.ones((3, 2, 1)), None, "must be given together"),
        (np.ones((3, 1, 1)), np.ones((4, 2, 1)), r"source_labels must have shape \[3, 2, L\], got \(3, 1, 1\)"),
        (np.ones((3, 2, 1)), np.ones((4, 2, 2)), r"target_labels must have shape \(4, 2, 1\), got \(4, 2, 2\)"),
    ],
)
def test_labels_that_do_not_fit_are_refused(source_labels, target_labels, message):
    source, target = (model[0] for model in small_pairs())
    with pytest.raises(ValueError, match=message):
        labelled_error(source, target, source_labels, target_labels)


def test_float32_error():
    sources, targets = (jnp.asarray(model[:4], jnp.float32) for model in small_pairs())
    values = jax.vmap(homomorphism_error)(sources, targets)
    assert values.dtype == jnp.float32
    np.testing.assert_allclose(values, small_errors(True)[:4], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ((3, 2), (4, 2, 4), r"source must have shape \[n, A, n\], got \(3, 2\)"),
        ((3, 2, 4), (4, 2, 4), r"source must have shape \[n, A, n\], got \(3, 2, 4\)"),
        ((3, 2, 3), (4, 2, 3), r"target must have shape \[n, A, n\], got \(4, 2, 3\)"),
        ((3, 2, 3), (4, 3, 4), r"target must have shape \[m, 2, m\], got \(4, 3, 4\)"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(source, target, message):
    with pytest.raises(ValueError, match=message):
        homomorphism_error(np.ones(source), np.ones(target))


@pytest.mark.parametrize("use", [homomorphism_error, homomorphism_map])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda model: 2.0 * model, r"sum of source\[0, 0\] must be 1"),
        (lambda model: -model, r"source\[0, 0, 0\] must not be negative"),
        (lambda model: model * np.nan, r"source\[0, 0, 0\] must be finite"),
        (lambda model: model[:0, :, :0], r"source must have shape \[n, A, n\], got \(0, 1, 0\)"),
        (lambda model: [["a"]], "source must hold real numbers"),
    ],
)
def test_what_is_no_model_is_refused(use, change, message):
    model = np.full((2, 1, 2), 0.5)
    with pytest.raises(ValueError, match=message):
        use(change(model), model)
