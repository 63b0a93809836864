"""What a demonstrated state may say to other states; on the host, and inside programs where anything is traced.

Two rules, whatever the method that carries the expert's policy over:

* What was done in an absorbing state is no evidence (`jaxhom.models.mdp.deciding_states`).
* Votes for actions that a state lacks do not count. A demonstrated state whose votes all are for such actions has no
  vote there.
"""

import numpy as np

from jaxhom import checks
from jaxhom.models.mdp import MDP, uniform_policy


def has_vote(mdp: MDP, policy, states, experts):
    """bool [P]: whether the expert's `policy` [S, A] in `experts` [P] takes actions that `states` [P] have.

    Indices of shapes that broadcast, [S, 1] and [E], give every pair of them.
    """
    if not mdp.restricts_actions:
        return np.ones(np.broadcast_shapes(np.shape(states), np.shape(experts)), bool)
    xp = checks.arrays_of(mdp.allowed, policy, states, experts)
    return ((xp.asarray(policy)[experts] > 0) & xp.asarray(mdp.allowed)[states]).any(axis=-1)


def allowed_part(mdp: MDP, states, votes):
    """Votes [P, A] for `states` [P], without those for actions that these lack."""
    xp = checks.arrays_of(mdp.allowed, votes)
    return xp.where(xp.asarray(mdp.allowed)[states], votes, 0) if mdp.restricts_actions else votes


def policy_of_votes(mdp: MDP, votes):
    """Votes [S, A] as rows that sum to 1, and bool [S]: where any counted; elsewhere the row is uniform."""
    uniform = uniform_policy(mdp)
    xp = checks.arrays_of(votes, uniform)
    votes = allowed_part(mdp, slice(None), xp.asarray(votes))
    total = votes.sum(axis=1, keepdims=True)
    is_found = total > 0
    return xp.where(is_found, votes / xp.where(is_found, total, 1), uniform), is_found[:, 0]
