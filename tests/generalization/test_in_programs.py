"""Ways to generalize inside jit and vmap: what the searches on the host say, draw by draw; and HiGHS for LP (8)."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, Demonstrations, SimilarityTable, Status, gridworld, programs, racetrack
from jaxhom.generalization import votes_in_program
from jaxhom.similarity import brackets, class_pairs

EXACT = ("visited", "radius", "support", "undecided", "status")
COUNT = 6  # draws


def grid_with_ends(rng, size, restricts):
    """A grid in which two cells absorb, and a sixth of the actions may not exist."""
    transition = oracles.gridworld_transition(size)
    ends = rng.choice(size**2, 2, replace=False)
    transition[ends] = np.eye(size**2)[ends][:, None]
    allowed = rng.uniform(size=transition.shape[:2]) > 1 / 6
    allowed[np.arange(size**2), rng.integers(4, size=size**2)] = True
    return MDP.from_dense(transition, discount=0.9, allowed=allowed if restricts else None)


def hubs():
    """A ring of 40 states in which steps may fail; two of them lead to half of all. Five never reach the others."""
    transition = np.zeros((45, 2, 45))
    for s in range(45):
        step = (s + 1) % 40 if s < 40 else 40 + (s + 1) % 5
        transition[s, :, step], transition[s, :, s] = 0.75, 0.25
    transition[[3, 17]] = 0.0
    transition[[3, 17], :, ::2] = 1 / 23
    return MDP.from_dense(transition, discount=0.9)


@functools.cache
def model(name):
    rng = np.random.default_rng(5)
    return {
        "grid": lambda: gridworld(5).mdp,
        "narrow": lambda: gridworld(5, dtype=np.float32).mdp,
        "ends": lambda: grid_with_ends(rng, 5, False),
        "restricted": lambda: grid_with_ends(rng, 5, True),
        "track": lambda: racetrack(["S..F", "S..F"]).mdp,
        "hubs": hubs,
    }[name]()


@functools.cache
def draws(name, trajectories=3, horizon=4):
    """Demonstrations [6, M, H] of lengths from 0 to H: any states, and actions that these have. The first is empty."""
    mdp, rng = model(name), np.random.default_rng(11)
    shape = (COUNT, trajectories, horizon)
    states = rng.integers(mdp.num_states, size=shape).astype(np.int32)
    score = np.where(np.asarray(mdp.allowed)[states], rng.uniform(size=(*shape, mdp.num_actions)), -1.0)
    lengths = rng.integers(horizon + 1, size=shape[:2])
    lengths[0] = 0
    mask = np.arange(horizon) < lengths[..., None]
    actions = score.argmax(axis=-1).astype(np.int32)
    arrays = {"states": np.where(mask, states, 0), "actions": np.where(mask, actions, 0), "mask": mask}
    return Demonstrations(**jax.tree.map(jnp.asarray, arrays))


@functools.cache
def completed(name, *thresholds):
    table = SimilarityTable(model(name))
    for threshold in thresholds:
        table.complete(threshold, tolerance=1e-3)
    return table


def lane(tree, i):
    return jax.tree.map(lambda leaf: leaf[i], tree)


def in_one_program(method, *batched):
    """All draws at once, twice: the second call compiles nothing."""
    chex.clear_trace_counter()
    program = jax.jit(jax.vmap(chex.assert_max_traces(lambda *one: method(*one), 1)))
    program(*batched)
    return program(*batched)


def assert_same(found, expected, tolerance=1e-14):
    for field in EXACT:
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field), err_msg=field)
        assert getattr(found, field).dtype == getattr(expected, field).dtype
    assert found.policy.dtype == expected.policy.dtype
    np.testing.assert_allclose(found.policy, expected.policy, rtol=0, atol=tolerance)


def assert_same_as_on_the_host(method, *batched, tolerance=1e-14):
    """Draw by draw; says the results."""
    found = in_one_program(method, *batched)
    for i in range(COUNT):
        assert_same(lane(found, i), method(*lane(batched, i)), tolerance)
    return found


# ------------------------------------------------------------------------------------- Algorithm 1

OPTIONS = [{}, {"threshold": 0.6}, {"threshold": 0.6, "mutual": True}]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("name", ["grid", "ends", "restricted", "track", "narrow"])
def test_algorithm_1_draw_by_draw(name, options):
    """One table for two thresholds."""
    mdp, table = model(name), completed(name, 0.0, 0.6)
    solved = table.num_solved

    def learn(shown):
        return jaxhom.soft_local_homomorphism(mdp, shown, table=table, tolerance=1e-3, **options)

    found = assert_same_as_on_the_host(learn, draws(name), tolerance=1e-6 if name == "narrow" else 1e-14)
    assert table.num_solved == solved
    assert np.any(found.radius > 0) and np.all(found.radius[0] == -1)


def test_many_steps_in_few_states():
    """Sets of several words, and of all states: more steps than states."""
    table = completed("track", 0.0, 0.6)
    learn = functools.partial(jaxhom.soft_local_homomorphism, model("track"), table=table, tolerance=1e-3)
    assert_same_as_on_the_host(learn, draws("track", 6, 12))
    assert_same_as_on_the_host(functools.partial(jaxhom.nearest_neighbors, model("grid")), draws("grid", 5, 12))
    assert_same_as_on_the_host(functools.partial(jaxhom.nearest_neighbors, model("hubs")), draws("hubs", 5, 12))


def test_keys_and_policies_may_be_traced():
    """Demonstrations that are drawn in the program itself."""
    mdp, table = model("restricted"), completed("restricted", 0.0, 0.6)

    def learn(key, policy):
        shown = jaxhom.sample_demonstrations(key, mdp, policy, 2, 5)
        return jaxhom.soft_local_homomorphism(mdp, shown, table=table, threshold=0.6, tolerance=1e-3)

    expert = np.asarray(mdp.allowed) / np.asarray(mdp.allowed).sum(axis=1, keepdims=True)
    policies = jnp.broadcast_to(expert, (COUNT, *expert.shape))
    assert_same_as_on_the_host(learn, jax.random.split(jax.random.key(0), COUNT), policies)


def test_algorithm_1_against_the_paper():
    """Set arithmetic and HiGHS."""
    mdp, table, shown = model("grid"), completed("grid", 0.0, 0.6), draws("grid")
    found = jax.jit(jax.vmap(lambda shown: jaxhom.soft_local_homomorphism(mdp, shown, table=table, tolerance=1e-3)))(
        shown
    )
    for i in range(1, 3):
        trajectories = [pair for pair in lane(shown, i) if len(pair[0])]
        policy, radius = oracles.algorithm1(np.asarray(mdp.transition), trajectories, tolerance=1e-9)
        np.testing.assert_array_equal(found.radius[i], radius)
        np.testing.assert_allclose(found.policy[i], policy, rtol=0, atol=1e-12)


def test_states_that_ask_may_differ_from_draw_to_draw():
    mdp, table = model("grid"), completed("grid", 0.0, 0.6)
    states = np.random.default_rng(0).uniform(size=(COUNT, 25)) < 0.5

    def learn(shown, states):
        return jaxhom.soft_local_homomorphism(mdp, shown, table=table, tolerance=1e-3, states=states)

    assert_same_as_on_the_host(learn, draws("grid"), jnp.asarray(states))
    one = lane(draws("grid"), 2)
    only = jax.jit(jax.vmap(functools.partial(learn, one)))(states)  # nothing but these is traced
    for i in range(COUNT):
        assert_same(lane(only, i), learn(one, states[i]))
    with pytest.raises(ValueError, match=r"states must have shape \(25,\), got \(3,\)"):
        jax.jit(functools.partial(learn, one))(states[0, :3])


@pytest.mark.parametrize("name", ["ends", "restricted"])
def test_the_model_may_be_traced(name):
    mdp, table, shown = model(name), completed(name, 0.0, 0.6), lane(draws(name), 3)

    def learn(mdp, shown):
        return jaxhom.soft_local_homomorphism(mdp, shown, table=table, tolerance=1e-3)

    expected = learn(mdp, shown)
    assert_same(jax.jit(learn)(mdp, shown), expected)
    assert_same(jax.jit(lambda mdp: learn(mdp, shown))(mdp), expected)
    probabilities = jax.jit(lambda probability: learn(mdp.replace(probability=probability), shown))
    assert_same(probabilities(mdp.probability), expected)
    discounts = jnp.array([0.5, 0.9])
    found = jax.vmap(lambda discount: learn(mdp.replace(discount=discount), shown))(discounts)
    for i in range(2):
        assert_same(lane(found, i), expected)


def test_votes_have_no_derivatives():
    mdp, table, shown = model("ends"), completed("ends", 0.0, 0.6), lane(draws("ends"), 3)

    def share(discount, probability):
        other = mdp.replace(discount=discount, probability=probability)
        general = jaxhom.soft_local_homomorphism(other, shown, table=table, tolerance=1e-3)
        return discount * general.policy[:, 0].sum()

    arguments = jnp.asarray(0.9), mdp.probability
    value, (slope, other) = jax.value_and_grad(share, argnums=(0, 1))(*arguments)
    np.testing.assert_allclose(slope, value / 0.9, rtol=1e-12)
    np.testing.assert_array_equal(other, 0.0)


def test_what_could_not_be_decided_is_said(monkeypatch):
    """A threshold beside an error, and few iterations where nothing is decided without any: as many pairs stay open for
    each state as on the host.
    """
    table = completed("grid", 0.0, 0.6)
    pairs = np.indices((25, 25)).reshape(2, -1)
    errors = table.brackets(*pairs, tolerance=1e-7).lower
    beside = float(np.median(errors[errors > 0.1])) - 1e-6
    monkeypatch.setattr(programs, "pays", lambda seconds: True)  # all by programs, whose iterations are limited
    monkeypatch.setattr(brackets, "bounds_by_intervals", lambda models, asked, *goal: (0.0 * asked, np.inf + asked))
    monkeypatch.setattr(class_pairs, "_MAX_PRODUCTS", 0.0)
    monkeypatch.setattr(class_pairs, "_MIN_ITERATIONS", 1)
    options = {"threshold": beside, "tolerance": 1e-9}
    for mutual in (False, True):
        fresh = SimilarityTable(model("grid")).complete(**options)
        learn = functools.partial(jaxhom.soft_local_homomorphism, model("grid"), table=fresh, mutual=mutual, **options)
        found = assert_same_as_on_the_host(learn, draws("grid"))
        assert np.any(found.undecided > 0)
        np.testing.assert_array_equal(found.status[1:], Status.ITERATION_LIMIT)
        assert found.status[0] == Status.SOLVED


def test_shards_of_draws():
    mdp, table = model("grid"), completed("grid", 0.0, 0.6)

    def learn(shown):
        return jax.vmap(lambda one: jaxhom.soft_local_homomorphism(mdp, one, table=table, tolerance=1e-3))(shown)

    shard_map = getattr(jax, "shard_map", None)
    if shard_map is None:
        pytest.skip("jax.shard_map is newer")
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("draws",))
    spec = jax.sharding.PartitionSpec("draws")
    found = jax.jit(shard_map(learn, mesh=mesh, in_specs=spec, out_specs=spec))(draws("grid"))
    assert_same(found, jax.jit(learn)(draws("grid")))


# ---------------------------------------------------------------------------------- the neighbours


@pytest.mark.parametrize("name", ["grid", "ends", "restricted", "track", "narrow", "hubs"])
def test_hops_draw_by_draw(name):
    learn = functools.partial(jaxhom.nearest_neighbors, model(name))
    found = assert_same_as_on_the_host(learn, draws(name), tolerance=1e-6 if name == "narrow" else 1e-14)
    assert np.any(found.radius > 1)
    if not model(name).restricts_actions:
        trajectories = [pair for pair in lane(draws(name), 1) if len(pair[0])]
        policy, radius = oracles.hops_nearest_neighbors(np.asarray(model(name).transition), trajectories)
        np.testing.assert_array_equal(found.radius[1], radius)
        np.testing.assert_allclose(found.policy[1], policy, rtol=0, atol=1e-6)
    traced = jax.jit(jaxhom.nearest_neighbors)(model(name), lane(draws(name), 1))
    assert_same(traced, lane(found, 1))


@pytest.mark.parametrize("name", ["grid", "restricted", "narrow"])
def test_euclidean_draw_by_draw(name):
    """Ties are found at any scale; coordinates may be traced, and differ from draw to draw."""
    mdp, rng = model(name), np.random.default_rng(2)
    width = round(mdp.num_states**0.5)
    cells = np.stack(np.divmod(np.arange(mdp.num_states), width), axis=1)

    def learn(shown, coordinates):
        return jaxhom.nearest_neighbors(mdp, shown, metric="euclidean", coordinates=coordinates)

    tolerance = 1e-6 if name == "narrow" else 1e-14
    found = assert_same_as_on_the_host(lambda shown: learn(shown, cells), draws(name), tolerance=tolerance)
    assert np.any(found.support > 1)
    others = jnp.asarray(0.1 * (cells + rng.integers(9, size=(COUNT, 1, 2))))
    assert_same_as_on_the_host(learn, draws(name), others, tolerance=tolerance)


def test_rounded_coordinates_tie():
    """Tenths in float32: distances that are the same differ in the last digits."""
    mdp, shown = model("grid"), lane(draws("grid"), 2)
    cells = np.stack(np.divmod(np.arange(25), 5), axis=1)
    start = jaxhom.uniform_elsewhere(mdp, shown)
    experts = votes_in_program.padded_experts(mdp, shown, start.visited)
    for scale in (1e-3, 0.1, 1e4):
        rounded = jnp.asarray(scale * (cells + 7.3), jnp.float32)
        found = votes_in_program.vote_of_nearest(mdp, start, experts, rounded)
        expected = jaxhom.nearest_neighbors(mdp, shown, metric="euclidean", coordinates=cells)
        others = ~np.asarray(start.visited)
        np.testing.assert_array_equal(found.support[others], expected.support[others])
        np.testing.assert_allclose(found.policy[others], expected.policy[others], rtol=0, atol=1e-12)


def test_coordinates_that_are_no_numbers_find_nobody():
    mdp, shown = model("grid"), lane(draws("grid"), 2)
    learn = jax.jit(lambda cells: jaxhom.nearest_neighbors(mdp, shown, metric="euclidean", coordinates=cells))
    found = learn(jnp.full((25, 2), jnp.nan))
    np.testing.assert_array_equal(found.radius, np.where(found.visited, 0, -1))
    np.testing.assert_allclose(found.policy.sum(axis=1), 1.0)


def test_uniform_elsewhere_draw_by_draw():
    assert_same_as_on_the_host(functools.partial(jaxhom.uniform_elsewhere, model("restricted")), draws("restricted"))


# ------------------------------------------------------------------------------------ the global map


def global_draws(name):
    return draws(name, 2, 3)


# HiGHS solves what is neither anchored nor restricted.
@pytest.mark.parametrize(("name", "anchored"), [("ends", False), ("restricted", True), ("narrow", False)])
def test_the_global_map_draw_by_draw(name, anchored):
    """Bounds overlap, and hold HiGHS's optimum; without a demonstration they are infinite and nothing is found."""
    mdp, shown, tolerance = model(name), global_draws(name), 3e-2

    def learn(shown):
        return jaxhom.soft_homomorphism(mdp, shown, anchored=anchored, tolerance=tolerance)

    found = in_one_program(learn, shown)
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    np.testing.assert_allclose(found.policy.sum(axis=-1), 1.0, rtol=1e-6)
    for i in range(COUNT):
        one, expected = lane(found, i), learn(lane(shown, i))
        np.testing.assert_array_equal(one.visited, expected.visited)
        np.testing.assert_array_equal(one.undecided, expected.undecided)
        np.testing.assert_array_equal(one.policy[one.visited], expected.policy[one.visited])
        assert one.error_lower <= expected.error_upper and expected.error_lower <= one.error_upper
        if np.isinf(expected.error_upper):
            assert np.isinf(one.error_lower) and np.isinf(one.error_upper)
            assert_same(one, expected)
            continue
        assert one.error_upper - one.error_lower <= tolerance
        if not (anchored or mdp.restricts_actions):
            transition = np.asarray(mdp.transition, float)
            decides = np.asarray(one.visited) & ~oracles.absorbing(transition)
            error, _ = oracles.global_homomorphism_lp(transition, decides)
            assert one.error_lower - 1e-6 <= error <= one.error_upper + 1e-6
    assert np.isinf(found.error_upper[0])
    np.testing.assert_array_equal(found.radius[0], -1)


def test_the_global_map_is_the_one_on_the_host():
    """Where the list has no padding, the iterations are the same up to rounding."""
    mdp = model("ends")
    decides = np.flatnonzero(~oracles.absorbing(np.asarray(mdp.transition)))[:4]
    shown = Demonstrations.from_trajectories([(decides, [0, 1, 2, 3])])
    options = {"tolerance": 1e-9, "max_iterations": 320}
    learn = functools.partial(jaxhom.soft_homomorphism, mdp, **options)
    found, expected = jax.jit(learn)(shown), learn(shown)
    assert_same(found, expected, tolerance=1e-6)
    np.testing.assert_allclose(found.error_lower, expected.error_lower, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.error_upper, expected.error_upper, rtol=0, atol=1e-6)


def test_what_is_not_finite_ends_the_global_map():
    mdp, shown = model("ends"), lane(global_draws("ends"), 2)
    broken = mdp.probability.at[1, 1].set(jnp.nan)

    @jax.jit
    def learn(probability):
        return jaxhom.soft_homomorphism(mdp.replace(probability=probability), shown, tolerance=3e-2)

    assert Status(int(learn(broken).status)) == Status.ITERATION_LIMIT
    assert not np.isfinite(learn(broken).error_upper)
    beside = jax.jit(jax.vmap(learn))(jnp.stack([broken, mdp.probability]))
    assert beside.status.tolist() == [Status.ITERATION_LIMIT, Status.SOLVED]


# ----------------------------------------------------------------------------- constants, and errors


def doors(mdp, table):
    cells = np.stack(np.divmod(np.arange(25), 5), axis=1)
    return {
        "Algorithm 1": lambda shown: jaxhom.soft_local_homomorphism(mdp, shown, table=table, tolerance=1e-3),
        "without table": lambda shown: jaxhom.soft_local_homomorphism(mdp, shown),
        "hops": lambda shown: jaxhom.nearest_neighbors(mdp, shown),
        "euclidean": lambda shown: jaxhom.nearest_neighbors(mdp, shown, metric="euclidean", coordinates=cells),
        "uniform": lambda shown: jaxhom.uniform_elsewhere(mdp, shown),
        "global": lambda shown: jaxhom.soft_homomorphism(mdp, shown, tolerance=1e-2, progress=True),
        "regression": lambda shown: jaxhom.occupancy_regression(mdp, shown, cells),
    }


@pytest.mark.parametrize("name", doors(None, None))
def test_concrete_values_give_constants_inside_programs(name):
    """And know how they were made there."""
    shown = lane(draws("ends"), 3)
    door = doors(model("ends"), completed("ends", 0.0, 0.6))[name]
    first, texts = int(shown.states[shown.mask][0]), []

    def program(number):
        general = door(shown)
        texts.append(str(general.explain(first)))
        assert not isinstance(general.policy, jax.core.Tracer)
        return number * general.policy, general

    expected = door(shown)
    scaled, general = jax.jit(program)(2.0)
    np.testing.assert_allclose(scaled, 2.0 * expected.policy, rtol=1e-12)
    assert_same(general, expected)
    several, _ = jax.vmap(program)(jnp.arange(2.0))
    assert several.shape == (2, *expected.policy.shape) and "demonstrated" in texts[0]


@pytest.mark.parametrize("name", ["Algorithm 1", "hops", "euclidean", "uniform", "global"])
def test_what_was_traced_does_not_know_how_it_was_made(name):
    door, shown = doors(model("ends"), completed("ends", 0.0, 0.6))[name], lane(draws("ends"), 3)

    def inside(shown):
        with pytest.raises(ValueError, match="no longer knows how it was made"):
            door(shown).explain(0)
        return door(shown)

    with pytest.raises(ValueError, match="no longer knows how it was made"):
        jax.jit(inside)(shown).explain(0)


def refused():
    mdp, table = model("grid"), completed("grid", 0.0, 0.6)
    learn = functools.partial(jaxhom.soft_local_homomorphism, mdp, tolerance=1e-3)
    return {
        "no table": (learn, r"SimilarityTable\(mdp, ...\).complete\(threshold\)"),
        "another threshold": (
            functools.partial(learn, table=SimilarityTable(mdp), threshold=0.1),
            r"call table.complete\(threshold=0.1\) first",
        ),
        "another distance": (functools.partial(learn, table=table, distance=2), "made with distance=1"),
        "as printed": (functools.partial(learn, table=table, anchored=False), "and anchored=True, not with"),
        "another model": (
            functools.partial(jaxhom.soft_local_homomorphism, gridworld(5, noise=0.1), table=table),
            "table was made for another model",
        ),
        "no table at all": (functools.partial(learn, table="table"), "table must be a SimilarityTable, got str"),
        "regression": (
            lambda shown: jaxhom.occupancy_regression(mdp, shown, np.zeros((25, 2))),
            "the linear program of occupancy_regression is solved on the host",
        ),
    }


@pytest.mark.parametrize("name", refused())
def test_what_programs_lack_is_said(name):
    method, message = refused()[name]
    with pytest.raises(ValueError, match=message):
        jax.jit(method)(lane(draws("grid"), 1))


@pytest.mark.parametrize("option", ["threshold", "tolerance", "mutual", "distance", "anchored"])
def test_traced_options_of_algorithm_1_are_refused(option):
    table, shown = completed("grid", 0.0, 0.6), lane(draws("grid"), 1)
    value = {"threshold": 0.6, "tolerance": 1e-3, "mutual": True, "distance": 1, "anchored": True}[option]
    with pytest.raises(ValueError, match=f"{option} is a traced value: inside jit, vmap and grad it must be a constan"):
        jax.jit(lambda x: jaxhom.soft_local_homomorphism(model("grid"), shown, table=table, **{option: x}))(value)


@pytest.mark.parametrize("option", ["anchored", "tolerance", "max_iterations"])
def test_traced_options_of_the_global_map_are_refused(option):
    value = {"anchored": True, "tolerance": 1e-2, "max_iterations": 10}[option]
    with pytest.raises(ValueError, match=f"{option} is a traced value"):
        jax.jit(lambda x: jaxhom.soft_homomorphism(model("grid"), lane(draws("grid"), 1), **{option: x}))(value)


def test_coordinates_of_another_shape_are_refused_inside_programs():
    shown = lane(draws("grid"), 1)
    with pytest.raises(ValueError, match=r"coordinates must have shape \(25, D\), got \(24, 2\)"):
        jax.jit(lambda cells: jaxhom.nearest_neighbors(model("grid"), shown, metric="euclidean", coordinates=cells))(
            jnp.zeros((24, 2))
        )
