"""The methods: from a problem's demonstrations to one policy per draw.

A method is a function of a `Problem`. Those of Table I end in LPAL, which gets the feature expectations of a
generalized policy, of the expert's complete policy, or of the demonstrations themselves (Monte Carlo). Those of
Figure 1 come with LPAL and without.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

import jaxhom
from bench.problems import Problem, build_domain
from jaxhom import Status
from jaxhom.generalization import class_similarity
from jaxhom.local_models import local_model_classes

_SIMILARITY_TOLERANCE = 1e-4
_MONTE_CARLO_TOLERANCE = 1e-7  # of LPAL's margin per step: with many regions margins are small
_MANY_FEATURES = 8  # from here on Monte Carlo's LPAL takes the interior-point method


@dataclasses.dataclass(frozen=True, eq=False)
class Learned:
    """Policies [B, S, A]; per draw, [B], how the solver ended and its certificate (see `rows.Row`)."""

    policy: jnp.ndarray
    status: np.ndarray | None = None
    certificate: np.ndarray | None = None


Method = Callable[[Problem], Learned]


def expert(problem: Problem) -> Learned:
    """The expert's own policies."""
    plan, mdp = problem.expert, problem.domain.bare
    value = jaxhom.policy_value(mdp, plan.policy, problem.reward)
    loss = (plan.upper_bound(mdp) - value) @ mdp.initial * (1.0 - mdp.discount)
    return Learned(plan.policy, np.full(len(loss), Status.SOLVED), np.asarray(loss))


def soft(problem: Problem, *, anchored: bool = True, mutual: bool = False) -> Learned:
    """Algorithm 1, with the setting's distance and threshold."""
    setting = problem.setting
    states = None if problem.domain.terminal is None else ~problem.domain.terminal
    policies, status = [], []
    for model, demonstrations in zip(problem.models, problem.demonstrations, strict=True):
        similarity = _similarity(setting, model, anchored)
        options = {"distance": setting.distance, "threshold": setting.threshold, "tolerance": _SIMILARITY_TOLERANCE}
        options |= {"anchored": anchored, "mutual": mutual, "states": states, "similarity": similarity}
        policies.append(jaxhom.soft_local_homomorphism(model, demonstrations, **options).policy)
        status.append(Status.SOLVED)
    return Learned(jnp.stack(policies), np.array(status), np.full(len(policies), _SIMILARITY_TOLERANCE))


def _similarity(setting, model, anchored):
    """Decisions that all draws share, unless each has a model of its own."""
    if setting.samples:
        return class_similarity(model, setting.distance, setting.threshold, anchored, _SIMILARITY_TOLERANCE)
    return _shared_similarity(setting.domain, setting.distance, setting.threshold, anchored)


@functools.lru_cache(maxsize=32)
def _shared_similarity(domain: str, distance: int, threshold: float, anchored: bool):
    mdp, classes = _shared_classes(domain, distance)
    return class_similarity(mdp, distance, threshold, anchored, _SIMILARITY_TOLERANCE, classes)


@functools.lru_cache(maxsize=8)
def _shared_classes(domain: str, distance: int):
    mdp = build_domain(domain, 1 if domain.startswith("grid") else 0).bare
    return mdp, local_model_classes(mdp, distance=distance)


def generalize(function: Callable) -> Method:
    """A method that applies `function(model, demonstrations, coordinates)` draw by draw."""

    def method(problem: Problem) -> Learned:
        pairs = zip(problem.models, problem.demonstrations, strict=True)
        found = [function(model, shown, problem.domain.coordinates) for model, shown in pairs]
        return Learned(jnp.stack([general.policy for general in found]))

    return method


maximum_entropy = generalize(lambda mdp, shown, _: jaxhom.maximum_entropy(mdp, shown))
manhattan_knn = generalize(lambda mdp, shown, _: jaxhom.nearest_neighbors(mdp, shown))
euclidean_knn = generalize(
    lambda mdp, shown, coordinates: jaxhom.nearest_neighbors(mdp, shown, metric="euclidean", coordinates=coordinates)
)
regression = generalize(jaxhom.occupancy_regression)


def apprentice(name: str, method: Method) -> Method:
    """LPAL on the feature expectations of a method's policies, started from them."""

    def learn(problem: Problem) -> Learned:
        mdp = problem.domain.mdp
        policy = problem.once(name, lambda: method(problem)).policy
        # `jaxhom.feature_expectations`, compiled once per domain and not once per number of features.
        expectations = jnp.einsum("bsa,sak->bk", jaxhom.occupancy(problem.domain.bare, policy), mdp.features)
        return _of_solution(mdp, jaxhom.lpal(mdp, expectations, initial_policy=policy))

    return learn


def full_policy(problem: Problem) -> Learned:
    """LPAL on the expert's complete policy; solved once where all draws share it."""
    if problem.domain.weights is None:
        return apprentice("expert", expert)(problem)
    mdp, policy = problem.domain.mdp, problem.expert.policy
    expectations = jaxhom.feature_expectations(mdp, policy[:1])
    learned = _of_solution(mdp, jaxhom.lpal(mdp, expectations, initial_policy=policy[:1]))
    copies = len(policy)
    return Learned(
        jnp.broadcast_to(learned.policy, policy.shape),
        np.repeat(learned.status, copies),
        np.repeat(learned.certificate, copies),
    )


def monte_carlo(problem: Problem) -> Learned:
    """LPAL on the demonstrations' own averages."""
    mdp = problem.domain.mdp
    means = [jaxhom.monte_carlo_feature_expectations(mdp, shown) for shown in problem.demonstrations]
    options = {"method": "columns"}
    if mdp.num_features > _MANY_FEATURES:
        tolerance = _MONTE_CARLO_TOLERANCE / (1.0 - float(mdp.discount))
        options = {"method": "interior_point", "tolerance": tolerance}
    return _of_solution(mdp, jaxhom.lpal(mdp, jnp.stack(means), **options))


def _of_solution(mdp, solution) -> Learned:
    gap = jnp.maximum(solution.margin_bound - solution.margin, 0.0) * (1.0 - mdp.discount)
    return Learned(solution.policy, np.asarray(solution.status), np.asarray(gap))


def _plain(name: str, method: Method) -> Method:
    return lambda problem: problem.once(name, lambda: method(problem))


TABLE1: dict[str, Method] = {
    "expert": expert,
    "full_policy": full_policy,
    "soft_local_homomorphism": apprentice("soft", soft),
    "monte_carlo": monte_carlo,
    "maximum_entropy": apprentice("maximum_entropy", maximum_entropy),
    "euclidean_knn": apprentice("euclidean_knn", euclidean_knn),
    "regression": apprentice("regression", regression),
    "manhattan_knn": apprentice("manhattan_knn", manhattan_knn),
}
"""The columns of Table I, under the names of its file."""

FIGURE1: dict[str, Method] = {
    "expert": expert,
    "lpal_full_policy": full_policy,
    "soft_local_homomorphism": _plain("soft", soft),
    "soft_local_homomorphism_printed": functools.partial(soft, anchored=False),
    "soft_local_homomorphism_mutual": functools.partial(soft, mutual=True),
    "manhattan_knn": _plain("manhattan_knn", manhattan_knn),
    "lpal_soft_local_homomorphism": apprentice("soft", soft),
    "lpal_manhattan_knn": apprentice("manhattan_knn", manhattan_knn),
}
"""The curves of Figure 1; Algorithm 1 also with the program as printed, and asking for similarity both ways."""

THRESHOLD: dict[str, Method] = {
    "expert": expert,
    "soft_local_homomorphism": soft,
    "soft_local_homomorphism_mutual": functools.partial(soft, mutual=True),
    "manhattan_knn": manhattan_knn,
}

NOISE: dict[str, Method] = {"expert": expert, "soft_local_homomorphism": soft, "manhattan_knn": manhattan_knn}

ENOUGH: dict[str, Method] = {
    "expert": expert,
    "soft_local_homomorphism": soft,
    "manhattan_knn": manhattan_knn,
    "maximum_entropy": maximum_entropy,
    "monte_carlo": monte_carlo,
}
