"""Methods that compare relations between local models, voters, weights and labels, and the choice among them.

Names are those of `default_candidates`: a relation and its threshold, and what else differs from Algorithm 1. With
labels they end in "labels". `ACROSS` learns on a racetrack from demonstrations on another.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxhom
from bench.methods import (
    Learned,
    Method,
    expert,
    manhattan_knn,
    maximum_entropy,
    nothing_fed,
    shared_table,
    soft,
    uniform,
)
from bench.problems import Problem, build_domain, draw_problem
from bench.settings import track
from jaxhom.generalization.choice import default_candidates

_POOL = 30  # trajectories that are drawn on the first track
_LABELS = ", labels"

_RELATIONS: dict[str, dict[str, Any]] = {
    f"{relation} {threshold:g}": {"relation": relation, "threshold": threshold}
    for relation in jaxhom.similarity.relations.RELATIONS
    for threshold in ((0.0,) if relation == "isomorphic" else (0.0, 0.1, 0.2))
}
_EVERYBODY: dict[str, dict[str, Any]] = {
    f"{relation} all, weighted": {"relation": relation, "threshold": 1.0, "voters": "all", "weights": "similarity"}
    for relation in ("homomorphism", "random_walk")
}
_VOTERS: dict[str, dict[str, Any]] = {
    "homomorphism 0, 3 voters": {"voters": 3},
    "homomorphism 0, all": {"voters": "all"},
    "isomorphic 0, all": {"relation": "isomorphic", "voters": "all"},
    "lax 0, all": {"relation": "lax", "voters": "all"},
    "homomorphism 0.2, weighted": {"threshold": 0.2, "weights": "similarity"},
    **_EVERYBODY,
}


def related(problem: Problem, *, is_labelled: bool = False, **options) -> Learned:
    """Algorithm 1 with other options, and with the labels of the domain."""
    return soft(problem, **options, **({"labels": problem.domain.labels} if is_labelled else {}))


def chosen(problem: Problem, *, caution: float, is_labelled: bool = False) -> Learned:
    """The choice among the default candidates, with the labels of the domain; tables are shared by draws."""
    domain, name = problem.domain, problem.setting.domain
    labels = domain.labels if is_labelled else None
    candidates = default_candidates(domain.bare, is_labelled)
    for key, one in candidates.items():
        if isinstance(one, Mapping):
            candidates[key] = {**one, "table": shared_table(name, 1, is_labelled, relation=one["relation"])}
    states = None if domain.terminal is None else ~np.asarray(domain.terminal)
    pairs = zip(problem.models, problem.demonstrations, strict=True)
    options = {"labels": labels, "states": states, "caution": caution}
    found = [jaxhom.choose_generalization(*pair, candidates, **options).best for pair in pairs]
    return Learned(jnp.stack([one.policy for one in found]), np.array([int(one.status) for one in found]))


def smallest_label(problem: Problem) -> Learned:
    """The control of labels: in every state, demonstrated or not, the exit with the smallest label."""
    label = np.where(problem.domain.mdp.allowed, problem.domain.labels[..., 0], np.inf)
    policy = np.eye(label.shape[1])[label.argmin(axis=1)]
    return Learned(jnp.broadcast_to(policy, (len(problem.draws), *policy.shape)))


def across(problem: Problem, *, method: str = "votes", **options) -> Learned:
    """Learns track (b) from demonstrations on track (a): all that are similar vote, wherever they are."""
    source = track("track_a", problem.setting.demonstrations, _POOL)
    shown = draw_problem(source, problem.draws, 0).demonstrations
    union, table = _union(options.get("relation", "homomorphism"))
    here = union.states(1)
    states = np.zeros(union.mdp.num_states, bool)
    states[here] = ~np.asarray(problem.domain.terminal)
    policies, status = [], []
    for demonstrations in shown:
        placed = union.place(0, demonstrations)
        if method == "k-NN":
            found = jaxhom.nearest_neighbors(union.mdp, placed)
        else:
            kind = {"table": table, "states": states, "voters": "all"}
            found = jaxhom.soft_local_homomorphism(union.mdp, placed, **kind, **options)
        policies.append(found.policy[here])
        status.append(int(found.status))
    return Learned(jnp.stack(policies), np.array(status))


@functools.lru_cache(maxsize=8)
def _union(relation: str) -> tuple[Any, jaxhom.SimilarityTable]:
    tracks = [build_domain(name, 0).bare for name in ("track_a", "track_b")]
    union = jaxhom.disjoint_union(tracks)
    return union, jaxhom.SimilarityTable(union, relation=relation)


def _methods(chosen_ones: Mapping[str, Mapping[str, Any]], **more) -> dict[str, Method]:
    suffix = _LABELS if more.get("is_labelled") else ""
    return {name + suffix: functools.partial(related, **options, **more) for name, options in chosen_ones.items()}


def _choices(**options) -> dict[str, Method]:
    """The choice that has to beat earlier candidates by two standard errors, and that of the highest score."""
    careful, bold = (functools.partial(chosen, caution=caution, **options) for caution in (2.0, 0.0))
    return {"chosen": careful, "chosen, highest score": bold}


_CONTROLS: dict[str, Method] = {"expert": expert, "uniform elsewhere": maximum_entropy, "k-NN": manhattan_knn}
WITHOUT_LABELS: dict[str, Method] = {**_CONTROLS, **_methods(_RELATIONS), **_methods(_VOTERS), **_choices()}
"""On models without labels."""
WITH_LABELS: dict[str, Method] = {
    **_CONTROLS,
    "smallest label": smallest_label,
    **_methods(_RELATIONS),
    **_methods(_VOTERS),
    **_methods(_RELATIONS, is_labelled=True),
    **_methods(_VOTERS, is_labelled=True),
    **_choices(is_labelled=True),
}
"""On models with labels, with and without them."""
CANDIDATES = {
    "relations": [*_CONTROLS, *_RELATIONS],
    "roads": [*_CONTROLS, *(name + _LABELS for name in (*_RELATIONS, *_EVERYBODY))],
}
"""What is chosen from, but for the expert; by sweep."""
ACROSS: dict[str, Method] = {
    "expert": expert,
    "uniform": uniform,
    "k-NN": functools.partial(across, method="k-NN"),
    "LPAL, zeros": nothing_fed,
    **{name: functools.partial(across, **options) for name, options in _RELATIONS.items()},
}
"""From one model to another."""
