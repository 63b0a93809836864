"""The table of `docs/programs.md`, cell by cell: what works under jit, vmap, grad and shard_map, and what refuses.

Each public function has one case: a function of what is traced, and an argument. Under a transformation its result has
to be that of the plain call, up to the certificates of what iterates.
"""

import functools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized
from doc_pages import DOCS

import jaxhom

LANES = 2
TOLERANCE = 5e-3  # of what iterates to a certificate


class Case(NamedTuple):
    """A function of one traced argument.

    Attributes:
      function: what is called.
      argument: its argument.
      along: the argument -> numbers that grad differentiates by, and numbers -> argument; the argument itself if None.
      result: what of the result is compared and differentiated.
    """

    function: Callable
    argument: Any
    through: Callable | None = None
    number: Any = None
    result: Callable = lambda result: result


@functools.cache
def cases() -> dict[str, Case]:
    grid = jaxhom.gridworld(4, num_regions=4, discount=0.9)
    mdp, key = grid.mdp, jax.random.key(0)
    policy = jax.random.dirichlet(key, jnp.ones(4), (16,))
    reward = mdp.features[..., 3] + 0.1 * mdp.features[..., 0]
    walks = jaxhom.sample_demonstrations(key, mdp, policy, 3, 6)
    vhat = 0.9 * jaxhom.feature_expectations(mdp, policy)
    table = jaxhom.SimilarityTable(mdp).complete()
    pairs = jnp.array([0, 5]), jnp.array([3, 6])
    models = jax.random.dirichlet(key, jnp.ones(3), (3, 2)), jax.random.dirichlet(key, jnp.ones(2), (2, 2))

    def general(found):
        """What is compared of a generalization; grad looks at its policy."""
        return found if isinstance(found, jax.Array) else (found.policy, found.visited, found.radius, found.support)

    margins = {"result": lambda solution: (solution.margin, solution.margin_bound)}

    def by_features(function):
        return lambda scale: function(mdp.replace(features=scale * mdp.features))

    def by_probability(function):
        return lambda tilt: function(mdp.replace(probability=mdp.probability * (1.0 + tilt)))

    half, one = jnp.asarray(0.5), jnp.asarray(1.0)
    return {
        "empirical_policy": Case(
            lambda walks: jaxhom.empirical_policy(mdp, walks),
            walks,
            by_features(lambda mdp: jaxhom.empirical_policy(mdp, walks)[1]),
            one,
        ),
        "monte_carlo_feature_expectations": Case(
            lambda walks: jaxhom.monte_carlo_feature_expectations(mdp, walks),
            walks,
            by_features(lambda mdp: jaxhom.monte_carlo_feature_expectations(mdp, walks)),
            one,
        ),
        "sample_demonstrations": Case(
            lambda key: jaxhom.sample_demonstrations(key, mdp, policy, 3, 6).states,
            key,
            lambda policy: jaxhom.sample_demonstrations(key, mdp, policy, 3, 6).states.astype(float),
            policy,
        ),
        "occupancy": Case(lambda policy: jaxhom.occupancy(mdp, policy), policy),
        "feature_expectations": Case(lambda policy: jaxhom.feature_expectations(mdp, policy), policy),
        "policy_value": Case(lambda reward: jaxhom.policy_value(mdp, policy, reward), reward),
        "optimal_policy": Case(
            lambda reward: jaxhom.optimal_policy(mdp, reward),
            reward,
            result=lambda plan: (plan.value, plan.action_value),
        ),
        "soft_optimal_policy": Case(
            lambda reward: jaxhom.soft_optimal_policy(mdp, reward, temperature=0.5),
            reward,
            result=lambda plan: (plan.policy, plan.value, plan.action_value),
        ),
        "max_causal_entropy": Case(
            lambda vhat: jaxhom.max_causal_entropy(mdp, expectations=vhat, l2=0.1),
            vhat,
            result=lambda learned: (learned.policy, learned.objective, learned.weights),
        ),
        "evaluate_exactly": Case(
            lambda policy: jaxhom.evaluate_exactly(mdp, policy, reward, 5),
            policy,
            result=lambda found: found.total_reward,
        ),
        "evaluate_by_sampling": Case(
            lambda key: jaxhom.evaluate_by_sampling(key, mdp, policy, reward, 5, num_trials=20).total_reward,
            key,
            lambda reward: jaxhom.evaluate_by_sampling(key, mdp, policy, reward, 5, num_trials=20).total_reward,
            reward,
        ),
        "agreement": Case(lambda policy: jaxhom.agreement(mdp, policy, policy[::-1]), policy),
        "local_similarity": Case(
            lambda sources: jaxhom.local_similarity(mdp, sources, pairs[1]),
            pairs[0],
            by_probability(lambda mdp: jaxhom.local_similarity(mdp, *pairs, table=table).upper),
            jnp.zeros_like(mdp.probability),
            lambda found: found if isinstance(found, jax.Array) else (found.lower, found.upper),
        ),
        "locally_similar": Case(
            lambda sources: jaxhom.locally_similar(mdp, sources, pairs[1], 0.1),
            pairs[0],
            by_probability(lambda mdp: jaxhom.locally_similar(mdp, *pairs, 0.1, table=table).astype(float)),
            jnp.zeros_like(mdp.probability),
        ),
        "homomorphism_error": Case(lambda source: jaxhom.homomorphism_error(source, models[1]), models[0]),
        "homomorphism_map": Case(
            lambda source: jaxhom.homomorphism_map(source, models[1], regularization=0.1), models[0]
        ),
        "stack_models": Case(
            lambda scale: jaxhom.stack_models([mdp, mdp.replace(features=scale * mdp.features)]).features, one
        ),
        "disjoint_union": Case(
            lambda scale: jaxhom.disjoint_union([mdp, mdp.replace(features=scale * mdp.features)]).mdp.features, one
        ),
        "choose_generalization": Case(
            lambda scale: jaxhom.choose_generalization(mdp.replace(features=scale * mdp.features), walks).best.policy,
            one,
        ),
        "uniform_elsewhere": Case(
            lambda walks: jaxhom.uniform_elsewhere(mdp, walks),
            walks,
            by_features(lambda mdp: jaxhom.uniform_elsewhere(mdp, walks).policy),
            one,
            general,
        ),
        "nearest_neighbors": Case(
            lambda walks: jaxhom.nearest_neighbors(mdp, walks),
            walks,
            by_features(lambda mdp: jaxhom.nearest_neighbors(mdp, walks).policy),
            one,
            general,
        ),
        "soft_local_homomorphism": Case(
            lambda walks: jaxhom.soft_local_homomorphism(mdp, walks, table=table),
            walks,
            by_features(lambda mdp: jaxhom.soft_local_homomorphism(mdp, walks, table=table).policy),
            one,
            general,
        ),
        "soft_homomorphism": Case(
            lambda walks: jaxhom.soft_homomorphism(mdp, walks, tolerance=1e-2).error_upper,
            walks,
            by_features(lambda mdp: jaxhom.soft_homomorphism(mdp, walks, tolerance=1e-2).policy),
            one,
            lambda found: found,
        ),
        "occupancy_regression": Case(
            lambda walks: jaxhom.occupancy_regression(mdp, walks, grid.coordinates),
            walks,
            by_features(lambda mdp: jaxhom.occupancy_regression(mdp, walks, grid.coordinates).policy),
            one,
        ),
        "query_states": Case(
            lambda policy: jaxhom.query_states(mdp, walks, policy, 3),
            policy,
            result=lambda queries: (queries.states.astype(float), queries.scores, queries.changes),
        ),
        "lpal": Case(lambda vhat: jaxhom.lpal(mdp, vhat), vhat, **margins),
        "LPAL.solve": Case(jaxhom.LPAL(mdp).solve, vhat, **margins),
        "loss_bound": Case(lambda policy: jaxhom.loss_bound(mdp, walks, policy).bound, policy),
        "robust_policy": Case(
            lambda scale: jaxhom.robust_policy(mdp.replace(features=scale * mdp.features), walks).policy, one
        ),
        "projection": Case(lambda vhat: jaxhom.projection(mdp, vhat), vhat),
        "mwal": Case(lambda vhat: jaxhom.mwal(mdp, vhat), vhat),
        "inverse_lp": Case(lambda policy: jaxhom.inverse_lp(mdp, policy), policy),
        "SimilarityTable": Case(
            lambda discount: jaxhom.SimilarityTable(mdp.replace(probability=mdp.probability * (discount / discount))),
            half,
        ),
        "gridworld": Case(lambda noise: jaxhom.gridworld(4, noise=noise), half),
        "racetrack": Case(lambda noise: jaxhom.racetrack("a", discount=noise), half),
        "sample_weights": Case(
            lambda key: jaxhom.sample_weights(key, 4),
            key,
            lambda scale: jaxhom.sample_weights(key, 4) + 0.0 * scale,
            one,
        ),
    }


def table() -> dict[str, dict[str, str]]:
    """The rows of the page."""
    page = (DOCS / "programs.md").read_text()
    rows = re.findall(r"^\| `([\w.]+)` \|(.*)\|$", page, flags=re.MULTILINE)
    columns = ("jit", "vmap", "grad", "shard_map", "remark")
    return {name: dict(zip(columns, (cell.strip() for cell in row.split("|")), strict=True)) for name, row in rows}


def stacked(argument):
    """Two lanes of an argument; the second is another."""

    def two(leaf):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jnp.stack([leaf, jax.random.fold_in(leaf, 1)])
        return jnp.stack([leaf, leaf[::-1] if leaf.ndim else leaf])

    return jax.tree.map(two, argument)


def of_case(case: Case) -> Callable:
    return lambda argument: case.result(case.function(argument))


@functools.cache
def plain(name: str, lane: int = 0):
    """What the plain call says in a lane; the first has the argument of the case."""
    case = cases()[name]
    return of_case(case)(jax.tree.map(lambda leaf: leaf[lane], stacked(case.argument)))


@functools.cache
def mapped(name: str):
    """The lanes under vmap; as one program, since otherwise every operation is compiled by itself."""
    case = cases()[name]
    return jax.jit(jax.vmap(of_case(case)))(stacked(case.argument))


def close(found, expected):
    chex.assert_trees_all_close(found, expected, rtol=TOLERANCE, atol=TOLERANCE)


def refusal(name: str) -> str:
    """What the error has to say: the handle, or what the remark says."""
    remark = table()[name]["remark"]
    return {"built outside": "outside jit, vmap and grad"}.get(remark, remark)


def test_every_public_function_is_in_the_table():
    functions = {name for name in jaxhom.__all__ if not isinstance(getattr(jaxhom, name), type)}
    assert functions - {"maximum_entropy"} | {"LPAL.solve", "SimilarityTable"} == set(table()) == set(cases())


class Programs(chex.TestCase):
    """On the device and off it; `test_jit` has the variant with jit, and all are held to the one without."""

    @chex.variants(with_device=True, without_device=True)
    @parameterized.named_parameters((name, name) for name in table() if table()[name]["jit"] != "no")
    def test_variants(self, name):
        case = cases()[name]
        close(self.variant(of_case(case))(case.argument), plain(name))


EVERY_FUNCTION = pytest.mark.parametrize("name", table(), scope="module")  # one after the other: they share results


@EVERY_FUNCTION
def test_jit(name):
    """Compiled once for arguments of one shape; or refused."""
    case = cases()[name]
    if table()[name]["jit"] == "no":
        with pytest.raises(ValueError, match=refusal(name)):
            jax.jit(case.function)(case.argument)
        return
    chex.clear_trace_counter()
    once = jax.jit(chex.assert_max_traces(of_case(case), n=1))
    lanes = stacked(case.argument)
    for lane in range(LANES):
        argument = jax.tree.map(lambda leaf, lane=lane: leaf[lane], lanes)
        close(once(argument), plain(name, lane))


@EVERY_FUNCTION
def test_vmap(name):
    case = cases()[name]
    lanes = stacked(case.argument)
    if table()[name]["vmap"] == "no":
        with pytest.raises(ValueError, match=refusal(name)):
            jax.vmap(case.function)(lanes)
        return
    for lane in range(LANES):
        close(jax.tree.map(lambda leaf, lane=lane: leaf[lane], mapped(name)), plain(name, lane))


@EVERY_FUNCTION
def test_grad(name):
    """Under jit; and without where there is something to see."""
    case, cell = cases()[name], table()[name]["grad"]
    function, number = (case.through, case.number) if case.through else (case.function, case.argument)

    def total(number):
        return sum(leaf.sum() for leaf in jax.tree.leaves(case.result(function(number))))

    if cell == "no":
        with pytest.raises(ValueError, match=refusal(name)):
            jax.grad(total)(number)
        return
    gradient = jax.jit(jax.grad(total))(number)
    assert np.isfinite(gradient).all()
    assert bool(np.any(np.asarray(gradient) != 0)) == (cell == "yes")
    if cell == "yes":
        close(jax.grad(total)(number), gradient)


@EVERY_FUNCTION
def test_shard_map(name):
    """Over the devices that there are; `test_sharding` forces two."""
    case = cases()[name]
    lanes = stacked(case.argument)
    spec = jax.sharding.PartitionSpec("lanes")
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("lanes",))
    sharded = jax.jit(jax.shard_map(jax.vmap(of_case(case)), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    if table()[name]["shard_map"] == "no":
        with pytest.raises(ValueError, match=refusal(name)):
            sharded(lanes)
        return
    close(sharded(lanes), mapped(name))


def test_a_table_is_asked_for():
    """Without one Algorithm 1 says what it needs."""
    case = cases()["soft_local_homomorphism"]
    mdp = jaxhom.gridworld(4, num_regions=4, discount=0.9).mdp
    with pytest.raises(ValueError, match=r"SimilarityTable\(mdp.*\.complete\("):
        jax.jit(lambda walks: jaxhom.soft_local_homomorphism(mdp, walks))(case.argument)
