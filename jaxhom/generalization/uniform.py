"""The demonstrations alone: what the expert did where it was seen, and the uniform policy elsewhere."""

from __future__ import annotations

import numpy as np

from jaxhom import checks
from jaxhom.generalization.explainers import nothing_is_looked_for
from jaxhom.generalization.result import Generalization
from jaxhom.models.demonstrations import Demonstrations, empirical_policy
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.status import Status


@checks.eager_where_concrete
def uniform_elsewhere(mdp: MDP, demonstrations: Demonstrations) -> Generalization:
    """The uniform policy over the allowed actions on every state that was not demonstrated.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.

    Returns:
      `Generalization`, with radius -1 off the demonstrated states.

    Raises:
      ValueError: if a demonstration does not fit the model.

    Works under jit and vmap, where values are not checked and the result does not know how it was made. Counts have no
    derivative.

    Example:
      >>> import jaxhom
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1], [2, 2])])
      >>> general = jaxhom.uniform_elsewhere(jaxhom.gridworld(4), demonstrations)
      >>> general.policy[1].tolist(), general.policy[5].tolist()
      ([0.0, 0.0, 1.0, 0.0], [0.25, 0.25, 0.25, 0.25])

    Source: Boularias and Chaib-draa 2010, section VI, where it is called maximum entropy.
    """
    mdp = as_model(mdp)
    visited, policy = empirical_policy(mdp, demonstrations)
    xp = checks.arrays_of(visited)
    support = xp.asarray(visited, np.int32)
    return Generalization(
        policy=policy,
        visited=visited,
        radius=checks.to_device(support - 1),
        support=checks.to_device(support),
        undecided=checks.to_device(xp.zeros_like(support)),
        status=checks.to_device(Status.SOLVED, np.int32),
        explainer=None if checks.is_traced(visited) else nothing_is_looked_for,
        state_names=mdp.state_names,
        action_names=mdp.action_names,
    )


def maximum_entropy(mdp: MDP, demonstrations: Demonstrations) -> Generalization:
    """The former name of `uniform_elsewhere`, which warns: it has nothing to do with maximum-entropy inverse RL.

    Example:
      >>> import jaxhom, warnings
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1], [2, 2])])
      >>> with warnings.catch_warnings(record=True) as said:
      ...     warnings.simplefilter("always")
      ...     general = jaxhom.maximum_entropy(jaxhom.gridworld(4), demonstrations)
      >>> print(*(warning.category.__name__ for warning in said))
      DeprecationWarning
    """
    checks.warn(
        "maximum_entropy is now called uniform_elsewhere: it is no maximum-entropy inverse reinforcement learning",
        DeprecationWarning,
    )
    return uniform_elsewhere(mdp, demonstrations)
