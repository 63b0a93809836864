"""The certificate of an answer (x, w) to LPAL, whoever found it.

The policy is read off x (eq. 5; where the state hardly occurs, a best response to w). A sparse LU factorisation of
SciPy, none of our solvers, gives its occupancy and its margin min_k V_k(pi) - Vhat_k; planning for w gives the bound.
Only on models whose factors would fill up (random successors) GMRES stands in, its residual checked.
"""

import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

import jaxhom
from bench.lpal_program import Model

_NO_OCCUPANCY = (1e-9, 1e-14)  # shares of all time that count as none: the better of two readings of x
_GMRES = 1e-12
_MAX_RESIDUAL = 1e-11
_PLANNING_SHARE = 0.002  # of the gap asked, that planning may add to the bound


def policy_solve(model: Model, policy: np.ndarray, right: np.ndarray, transpose: bool) -> np.ndarray:
    """Solves (I - discount P) z = right for the P of a policy [S, A], or the transposed system."""
    system = scipy.sparse.eye_array(model.num_states) - model.discount * model.policy_matrix(policy)
    system = (system.T if transpose else system).tocsc()
    if model.is_dense:
        return np.linalg.solve(system.toarray(), right)
    if model.is_scattered:
        found = np.zeros_like(right)
        for _ in range(2):  # the second refines
            residual = right - system @ found
            found = found + scipy.sparse.linalg.gmres(system, residual, rtol=_GMRES, restart=50, maxiter=20)[0]
        if np.abs(right - system @ found).max() <= _MAX_RESIDUAL * np.abs(right).max():
            return found
    factors = scipy.sparse.linalg.splu(system, permc_spec="MMD_AT_PLUS_A")
    found = factors.solve(right)
    return found + factors.solve(right - system @ found)


def margin(model: Model, policy: np.ndarray, expectations: np.ndarray) -> float:
    """min_k V_k(policy) - Vhat_k of one policy [S, A], by an exact solve."""
    occupancy = policy_solve(model, policy, model.initial, transpose=True)
    x = (np.maximum(occupancy, 0.0)[:, None] * policy).ravel()
    return float((model.features.T @ x - expectations).min())


def policy_of(x: np.ndarray, fallback: np.ndarray, negligible: float = _NO_OCCUPANCY[0]) -> np.ndarray:
    """pi(s, a) = x(s, a) / sum_a' x(s, a'), [S, A]; `fallback` where the state hardly occurs."""
    x = np.maximum(x, 0.0)
    total = x.sum(axis=-1, keepdims=True)
    occurs = total > negligible * total.sum()
    return np.where(occurs, x / np.where(occurs, total, 1.0), fallback)


def bounds(mdp: jaxhom.MDP, w: np.ndarray, expectations: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Upper bounds [B] on the best margins, and policies [B, S, A] that are optimal for the weights w [B, K]."""
    w = np.maximum(w, 0.0)
    w = w / w.sum(axis=1, keepdims=True)
    reward = jnp.einsum("sak,bk->bsa", mdp.features, w)
    plan = jaxhom.optimal_policy(mdp, reward, tolerance=_PLANNING_SHARE * gap * (1.0 - float(mdp.discount)))
    best = np.asarray(plan.upper_bound(mdp) @ mdp.initial)
    return best - (w * expectations).sum(axis=1), np.asarray(plan.policy)


def certified_gap(mdp: jaxhom.MDP, model: Model, x: list, w: list, expectations: np.ndarray, gap: float) -> np.ndarray:
    """Bound minus margin, [B], of answers x (each [S, A]) and w (each [K]); infinite where there is no answer."""
    found = np.full(len(x), np.inf)
    for lane, (point, weights) in enumerate(zip(x, w, strict=True)):
        if point is None or not _is_answer(point, weights):
            continue
        bound, policy = bounds(mdp, weights[None], expectations[lane][None], gap)
        readings = [policy_of(point, policy[0], negligible) for negligible in _NO_OCCUPANCY]
        found[lane] = bound[0] - max(margin(model, reading, expectations[lane]) for reading in readings)
    return found


def _is_answer(x: np.ndarray, w: np.ndarray) -> bool:
    return bool(np.isfinite(x).all() and np.isfinite(w).all() and (x > 0).any() and (w > 0).any())
