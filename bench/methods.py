"""The methods: from a problem's demonstrations to one policy per draw.

A method is a function of a `Problem`. Those of Table I end in LPAL, which gets the feature expectations of a
generalized policy, of the expert's complete policy, or of the demonstrations themselves (Monte Carlo). Those of
Figure 1 come with LPAL and without.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxhom
from bench.problems import Problem, build_domain
from bench.settings import Setting
from jaxhom import MDP, SimilarityTable

_SIMILARITY_TOLERANCE = 1e-4  # the library's default, which decisions shared by draws have to repeat
_MONTE_CARLO_SHARE = 1e-3  # LPAL's gap as a share of what each of K regions gets of evenly spread time: no digit shown
_MANY_FEATURES = 8  # grids have 16 and more, for which columns take long; racetracks two


@dataclasses.dataclass(frozen=True, eq=False)
class Learned:
    """Policies [B, S, A]; where a solver was at work, how it ended and its certificate per draw, [B] (`rows.Row`)."""

    policy: jnp.ndarray
    status: np.ndarray | None = None
    certificate: np.ndarray | None = None


Method = Callable[[Problem], Learned]


def expert(problem: Problem) -> Learned:
    """The expert's own policies."""
    return Learned(problem.expert.policy)


def soft(problem: Problem, **options) -> Learned:
    """Algorithm 1, with the setting's distance and threshold unless `options` say otherwise."""
    setting = problem.setting
    of_setting = {"distance": setting.distance, "threshold": setting.threshold, "tolerance": _SIMILARITY_TOLERANCE}
    options = of_setting | options
    kind = {name: options[name] for name in ("anchored", "relation", "labels") if name in options}
    if problem.domain.terminal is not None:
        options["states"] = ~problem.domain.terminal  # the finish line puts the car back, whatever the action
    found, excess = [], []
    for model, demonstrations in zip(problem.models, problem.demonstrations, strict=True):
        table = _table(setting, model, **kind)
        found.append(jaxhom.soft_local_homomorphism(model, demonstrations, table=table, **options))
        excess.append(excess_of(table, options["threshold"]))
    return Learned(jnp.stack([one.policy for one in found]), np.array([one.status for one in found]), np.array(excess))


def excess_of(table: SimilarityTable, threshold: float) -> float:
    """By how much the error of a pair that counts as similar may exceed epsilon, of all that the table has met."""
    upper = table.known()[1].upper
    return float((upper[upper <= threshold + _SIMILARITY_TOLERANCE] - threshold).max(initial=0.0))


def _table(setting: Setting, model: MDP, labels=None, **kind) -> SimilarityTable:
    """What is known of the model's local models: shared by all draws and thresholds, unless each has its own model."""
    if setting.samples:
        return SimilarityTable(model, distance=setting.distance, labels=labels, **kind)
    return shared_table(setting.domain, setting.distance, labels is not None, **kind)


@functools.lru_cache(maxsize=64)
def shared_table(domain: str, distance: int, is_labelled: bool, **kind) -> SimilarityTable:
    """A domain's table of similarities, with the labels of the domain or without."""
    found = build_domain(domain, 4 if domain.startswith(("grid", "wrong")) else 0)
    return SimilarityTable(found.bare, distance=distance, labels=found.labels if is_labelled else None, **kind)


def generalize(function: Callable) -> Method:
    """A method that applies `function(model, demonstrations, coordinates)` draw by draw."""

    def method(problem: Problem) -> Learned:
        pairs = zip(problem.models, problem.demonstrations, strict=True)
        return Learned(jnp.stack([function(*pair, problem.domain.coordinates).policy for pair in pairs]))

    return method


maximum_entropy = generalize(lambda mdp, shown, _: jaxhom.uniform_elsewhere(mdp, shown))
manhattan_knn = generalize(lambda mdp, shown, _: jaxhom.nearest_neighbors(mdp, shown))
euclidean_knn = generalize(
    lambda mdp, shown, coordinates: jaxhom.nearest_neighbors(mdp, shown, metric="euclidean", coordinates=coordinates)
)
regression = generalize(jaxhom.occupancy_regression)


def uniform(problem: Problem) -> Learned:
    """Every action alike, everywhere: what no demonstration is worth."""
    mdp = problem.domain.mdp
    policy = np.asarray(mdp.allowed, float)
    policy /= policy.sum(axis=1, keepdims=True)
    return Learned(jnp.broadcast_to(policy, (len(problem.draws), *policy.shape)))


def apprentice(method: Method) -> Method:
    """LPAL on the feature expectations of a method's policies, started from them."""

    def learn(problem: Problem) -> Learned:
        mdp = problem.domain.mdp
        policy = problem.once(method).policy
        # `jaxhom.feature_expectations`, compiled once per domain and not once per number of features.
        expectations = jnp.einsum("bsa,sak->bk", jaxhom.occupancy(problem.domain.bare, policy), mdp.features)
        return of_solution(mdp, jaxhom.lpal(mdp, expectations, initial_policy=policy))

    return learn


def full_policy(problem: Problem) -> Learned:
    """LPAL on the expert's complete policy; solved once where all draws share it."""
    if problem.domain.weights is None:
        return apprentice(expert)(problem)
    mdp, policy = problem.domain.mdp, problem.expert.policy
    solution = jaxhom.lpal(mdp, jaxhom.feature_expectations(mdp, policy[:1]), initial_policy=policy[:1])
    return of_solution(mdp, jax.tree.map(lambda leaf: jnp.repeat(leaf, len(policy), axis=0), solution))


def monte_carlo(problem: Problem, *, per_step: bool = False) -> Learned:
    """LPAL on the demonstrations' own expectations.

    `per_step` divides them by the demonstrations' length. They are then averages, where LPAL's flow constraints add up
    over time, so that they hardly count: not what eq. (6) says, but what the printed numbers look like.
    """
    mdp = problem.domain.mdp
    found = jnp.stack([jaxhom.monte_carlo_feature_expectations(mdp, shown) for shown in problem.demonstrations])
    options = {}
    if mdp.num_features > _MANY_FEATURES:
        all_time = 1.0 / (1.0 - float(mdp.discount))
        options = {"method": "interior_point", "tolerance": _MONTE_CARLO_SHARE * all_time / mdp.num_features}
    return of_solution(mdp, jaxhom.lpal(mdp, found / (problem.setting.length if per_step else 1), **options))


def nothing_fed(problem: Problem) -> Learned:
    """The control of LPAL: fed with zeros, once for all draws."""
    mdp = problem.domain.mdp
    solution = jaxhom.lpal(mdp, jnp.zeros((1, mdp.num_features)))
    return of_solution(mdp, jax.tree.map(lambda leaf: jnp.repeat(leaf, len(problem.draws), axis=0), solution))


def of_solution(mdp, solution) -> Learned:
    gap = jnp.maximum(solution.margin_bound - solution.margin, 0.0) * (1.0 - mdp.discount)
    return Learned(solution.policy, np.asarray(solution.status), np.asarray(gap))


CONTROLS: dict[str, Method] = {"uniform": uniform, "lpal_zeros": nothing_fed}
"""What is fed with nothing, beside every sweep with LPAL."""
TABLE1: dict[str, Method] = {
    "expert": expert,
    **CONTROLS,
    "full_policy": full_policy,
    "soft_local_homomorphism": apprentice(soft),
    "monte_carlo": monte_carlo,
    "maximum_entropy": apprentice(maximum_entropy),
    "euclidean_knn": apprentice(euclidean_knn),
    "regression": apprentice(regression),
    "manhattan_knn": apprentice(manhattan_knn),
}
"""The columns of Table I, under the names of its file, and the controls."""
THRESHOLD: dict[str, Method] = {"expert": expert, "soft_local_homomorphism": soft, "manhattan_knn": manhattan_knn}
FIGURE1: dict[str, Method] = {
    "expert": expert,
    **CONTROLS,
    "lpal_full_policy": full_policy,
    "soft_local_homomorphism": soft,
    "soft_local_homomorphism_printed": functools.partial(soft, anchored=False),
    "soft_local_homomorphism_mutual": functools.partial(soft, mutual=True),
    "manhattan_knn": manhattan_knn,
    "lpal_soft_local_homomorphism": apprentice(soft),
    "lpal_manhattan_knn": apprentice(manhattan_knn),
}
"""The curves of Figure 1; Algorithm 1 also with the program as printed, and asking for similarity both ways."""
ENOUGH: dict[str, Method] = {**THRESHOLD, **CONTROLS, "maximum_entropy": maximum_entropy, "monte_carlo": monte_carlo}
NORMALISATION: dict[str, Method] = {
    **CONTROLS,
    "monte_carlo": monte_carlo,
    "monte_carlo_per_step": functools.partial(monte_carlo, per_step=True),
}
