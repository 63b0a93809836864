"""The global soft homomorphism: one map from all states to the demonstrated ones, or to those of another model.

LP (8) of Boularias and Chaib-draa 2010, which the paper gave up for its size, and eq. (7), of which it is a case;
`global_lp` states both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.generalization import evidence, votes_in_program
from jaxhom.generalization.explainers import LEAST_SHARE, ByGlobalMap
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem, HostProblem, centred, restricted_to_list
from jaxhom.generalization.global_map import Effort, GlobalMap, map_in_program, map_on_host, require_effort
from jaxhom.generalization.model_map import SoftHomomorphism, map_to_model
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model, check_labels
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.similarity.local_models import restricted_model
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float, Num


@overload
def soft_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | Num[ArrayLike, "S A"] | None = None,
    target_labels: None = None,
    label_weight: Float[ArrayLike, ""] = 1.0,
    anchored: bool = True,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> Generalization: ...


@overload
def soft_homomorphism(
    mdp: MDP,
    demonstrations: MDP,
    *,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | Num[ArrayLike, "S A"] | None = None,
    target_labels: Num[ArrayLike, "T A L"] | Num[ArrayLike, "T L"] | Num[ArrayLike, "T A"] | None = None,
    label_weight: Float[ArrayLike, ""] = 1.0,
    anchored: bool = True,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> SoftHomomorphism: ...


@checks.eager_where_concrete
def soft_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations | MDP,
    *,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | Num[ArrayLike, "S A"] | None = None,
    target_labels: Num[ArrayLike, "T A L"] | Num[ArrayLike, "T L"] | Num[ArrayLike, "T A"] | None = None,
    label_weight: Float[ArrayLike, ""] = 1.0,
    anchored: bool = True,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> Generalization | SoftHomomorphism:
    """Maps all states of a model to the demonstrated ones, and averages their policies; or to those of another model.

    f has the least error e in keeping transitions, rows that sum to 1, and one row for each state s:

        |sum_s'' T(s,a,s'') f(s'',k) - sum_l f(s,l) T'(l,a,k)| <= e,    |l(s,a) - sum_k f(s,k) l'(k,a)| <= e.

    Args:
      mdp: the model, or the source.
      demonstrations: the expert's trajectories, visiting E states that do not absorb: T' is the model restricted to
        these. Or the target, a model (or what has one as `.mdp`) of S' states with as many actions and of the same
        type: T' is its transitions.
      labels: what the map has to keep besides transitions, [S, A, L], or [S, L] for labels of the state, which count
        for every action; [S, A], a reward say, is one label of every action. Labels in [0, 1] weigh like
        probabilities. Where an action is not allowed they count as given, and as 0 where not finite.
      target_labels: those of the target, likewise [S', A, L], [S', L] or [S', A]; None with demonstrations, where the
        states' own labels are meant.
      label_weight: scalar, not negative, that all labels are multiplied by.
      anchored: map each demonstrated state to itself; False is the program as printed. Of demonstrations alone.
      tolerance: gap between the bounds on the optimal error to settle for.
      max_iterations: of PDHG; each costs a few products with [S, A, E] numbers.
      progress: show a progress bar.

    Returns:
      With demonstrations `Generalization`, with `error_lower` and `error_upper`, and a `status` that says why where
      these are further apart than the tolerance. pi(s, .) = sum_k f(s, k) pi(k, .) off the demonstrated states, over
      the actions allowed there; their `radius` is 1, and `support` counts the states with f(s, k) > 1e-3. Where nothing
      is left of it, or only absorbing states were demonstrated (there is no map then, and the error is infinite), the
      policy is uniform, with radius -1 and support 0.
      With a target `SoftHomomorphism`: the map, the same bounds and status, and `pull_back(policy)`. Which actions are
      refused is kept there like a label, 1 where a state lacks the action and 0 elsewhere, as between local models;
      with demonstrations it is not.

    Raises:
      ValueError: if a demonstration, a target or labels do not fit the model, the tolerance is not positive, or an
        option is traced.

    Works under jit and vmap, whatever is traced but the options. E, of demonstrations, is then the number of all states
    or of all recorded steps, if fewer, whatever was visited. Values are not checked there, `progress` shows nothing,
    the result does not know how it was made, and what is not finite ends the iterations at once, with bounds that are
    not either. No derivatives.

    Example:
      >>> import jaxhom
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [2, 2, 1])])
      >>> general = jaxhom.soft_homomorphism(jaxhom.gridworld(3), demonstrations, tolerance=1e-2)
      >>> jaxhom.Status(int(general.status)).name, bool(general.error_upper - general.error_lower <= 1e-2)
      ('SOLVED', True)
      >>> import jax
      >>> learn = jax.jit(lambda shown: jaxhom.soft_homomorphism(jaxhom.gridworld(3), shown, tolerance=1e-2))
      >>> again = learn(demonstrations)
      >>> bool(again.error_lower <= general.error_upper), bool(general.error_lower <= again.error_upper)
      (True, True)

      Two states that change places, both as the one that stays; labels that tell them apart cannot be kept:

      >>> swap = jaxhom.MDP.from_dense([[[0, 1]], [[1, 0]]], discount=0.9)
      >>> stay = jaxhom.MDP.from_dense([[[1]]], discount=0.9)
      >>> found = jaxhom.soft_homomorphism(swap, stay)
      >>> found.map.tolist(), bool(found.error_upper < 1e-3)
      ([[1.0], [1.0]], True)
      >>> found = jaxhom.soft_homomorphism(swap, stay, labels=[[0], [3]], target_labels=[[1]])
      >>> round(float(found.error_upper), 2)
      2.0

    Source: Boularias and Chaib-draa 2010, eqs. (7) and (8), of which the paper gave up the second for its size; soft
    homomorphisms are Sorg and Singh's (2009).
    """
    checks.refuse_traced(anchored=anchored)
    anchored = checks.require_switch("anchored", anchored)
    effort = require_effort(tolerance, max_iterations, progress)
    mdp = as_model(mdp)
    if not isinstance(demonstrations, Demonstrations):
        return map_to_model(mdp, as_model(demonstrations), labels, target_labels, label_weight, effort)
    if target_labels is not None:
        raise ValueError("target_labels are those of a target model: demonstrated states have theirs among the labels")
    kept = None if labels is None else centred(check_labels(mdp, labels, label_weight))[0]
    start = uniform_elsewhere(mdp, demonstrations)
    if checks.is_traced(mdp, demonstrations, kept):
        experts = votes_in_program.padded_experts(mdp, demonstrations, start.visited)
        found = _map_in_program(mdp, experts, kept, anchored, effort)
        votes = votes_in_program.sum_of_policies(found.mapping, start.policy, experts)
        return _generalization(mdp, start, found, votes)
    experts = np.flatnonzero(deciding_states(mdp, start.visited))
    found = _map_on_host(mdp, experts, kept, anchored, effort)
    explainer = ByGlobalMap(mdp, experts, found.mapping, float(found.lower), float(found.upper), anchored)
    votes = found.mapping @ np.asarray(start.policy)[experts]
    return _generalization(mdp, start, found, votes).replace(explainer=explainer)


def _generalization(mdp: MDP, start: Generalization, found: GlobalMap, votes) -> Generalization:
    """The expert's policies averaged by the map [S, A] as a policy; uniform where nothing is left of them."""
    policy, is_found = evidence.policy_of_votes(mdp, votes)
    xp, chosen = checks.arrays_of(start, policy), (found.mapping > LEAST_SHARE).sum(axis=1)
    visited = xp.asarray(start.visited)
    return start.replace(
        policy=checks.to_device(xp.where(visited[:, None], xp.asarray(start.policy), policy), mdp.dtype),
        radius=checks.to_device(xp.where(visited, 0, xp.where(is_found, 1, -1)), jnp.int32),
        support=checks.to_device(xp.where(visited, 1, xp.where(is_found, chosen, 0)), jnp.int32),
        error_lower=checks.to_device(found.lower, mdp.dtype),
        error_upper=checks.to_device(found.upper, mdp.dtype),
        status=checks.to_device(found.status, jnp.int32),
        explainer=None,
    )


def _map_on_host(mdp: MDP, experts: np.ndarray, kept, anchored: bool, effort: Effort) -> GlobalMap:
    """The map to the given states."""
    if not experts.size:
        return GlobalMap(np.zeros((mdp.num_states, 0)), np.inf, np.inf, Status.SOLVED)
    pinned = np.zeros((mdp.num_states, len(experts)), bool)
    if anchored:
        pinned[experts, np.arange(len(experts))] = True
    problem = HostProblem(
        mdp=mdp,
        target=restricted_model(mdp, experts).astype(mdp.dtype),
        pinned=pinned,
        exists=np.ones(len(experts), bool),
        labels=kept,
        target_labels=None if kept is None else kept[experts],
        rows=mdp.dynamics.host_matrix(np.asarray(mdp.probability)),
    )
    return map_on_host(problem, effort)


def _map_in_program(mdp: MDP, experts: jax.Array, kept, anchored: bool, effort: Effort) -> GlobalMap:
    """The map to a list of states [E] that is padded with S."""
    kept = None if kept is None else jnp.asarray(kept)
    problem = GlobalHomomorphismProblem(
        mdp=mdp,
        target=restricted_to_list(mdp, experts),
        pinned=anchored & (jnp.arange(mdp.num_states)[:, None] == experts),
        exists=experts < mdp.num_states,
        labels=kept,
        target_labels=None if kept is None else kept.at[experts].get(mode="fill", fill_value=0),
    )
    # T^E is rounded: by as much, at most, its optimal error differs from the model's.
    rounding = mdp.probability.shape[-1] * float(jnp.finfo(mdp.dtype).eps)
    return map_in_program(problem, effort, rounding)
