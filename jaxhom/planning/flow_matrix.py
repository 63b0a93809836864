"""The Bellman flow of a model as a sparse matrix on the host: the constraints of linear programs over occupancies."""

from __future__ import annotations

import numpy as np
import scipy

from jaxhom.models.mdp import MDP


def flow_matrix(mdp: MDP) -> scipy.sparse.csr_array:
    """F [S, S A] of the Bellman flow F x = alpha: (F x)(s) = sum_a x(s, a) - gamma sum_{s', a} x(s', a) T(s', a, s).

    The columns of pairs that are not allowed are empty: programs leave their variables out.
    """
    num_states, num_actions, slots = mdp.next_state.shape
    pair = np.arange(num_states * num_actions)
    probability = np.asarray(mdp.probability, float).ravel()
    entries = (probability, (np.asarray(mdp.next_state).ravel(), np.repeat(pair, slots)))
    inflow = scipy.sparse.csr_array(entries, shape=(num_states, len(pair)))
    allowed = np.asarray(mdp.allowed, float).ravel()
    outflow = scipy.sparse.csr_array((allowed, (pair // num_actions, pair)), shape=inflow.shape)
    flow = outflow - float(mdp.discount) * inflow
    flow.eliminate_zeros()
    return flow
