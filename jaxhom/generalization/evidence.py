"""What a demonstrated state may say to other states; on the host.

Two rules, whatever the method that carries the expert's policy over:

* What was done in an absorbing state is no evidence: an episode's end is no decision, and every local model maps onto
  such a state with error 0. So it makes no difference whether demonstrations stop at the goal or walk on in it.
* Votes for actions that a state lacks do not count. A demonstrated state whose votes all are for such actions has no
  vote there.
"""

import numpy as np

from jaxhom.models.mdp import MDP, absorbing_states, uniform_policy


def deciding(mdp: MDP, visited) -> np.ndarray:
    """bool [S]: the demonstrated states in which there was something to decide."""
    return np.asarray(visited) & ~np.asarray(absorbing_states(mdp))


def has_vote(mdp: MDP, policy, states: np.ndarray, experts: np.ndarray) -> np.ndarray:
    """bool [P]: whether the expert's `policy` [S, A] in `experts` [P] takes actions that `states` [P] have."""
    if not mdp.restricts_actions:
        return np.ones(len(states), bool)
    return ((np.asarray(policy)[experts] > 0) & np.asarray(mdp.allowed)[states]).any(axis=-1)


def allowed_part(mdp: MDP, states, votes: np.ndarray) -> np.ndarray:
    """Votes [P, A] for `states` [P], without those for actions that these lack."""
    return np.where(np.asarray(mdp.allowed)[states], votes, 0) if mdp.restricts_actions else votes


def policy_of_votes(mdp: MDP, votes) -> tuple[np.ndarray, np.ndarray]:
    """Votes [S, A] as rows that sum to 1, and bool [S]: where any counted; elsewhere the row is uniform."""
    votes = allowed_part(mdp, slice(None), np.asarray(votes))
    total = votes.sum(axis=1, keepdims=True)
    is_found = total > 0
    return np.where(is_found, votes / np.where(is_found, total, 1), uniform_policy(mdp)), is_found[:, 0]
