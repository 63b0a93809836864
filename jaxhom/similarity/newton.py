"""The Newton system of the interior-point method for LP (9): put together, factorised, solved.

Eliminating slacks and multipliers from the linearised central path (`interior_point`) leaves

    [ N   -E^T  -c ] [ df     ]
    [ E    0     0 ] [ lambda ]  =  ...,    N = K^T (D+ + D-) K + D_f,   c = K^T (D+ - D-) 1,   g = sum(D+ + D-),
    [ c^T  0    -g ] [ de     ]

D = y / s being diagonal. N has the size of the free part of f and is put together from contractions of the two models,
never from K; the border is eliminated by a Schur complement. An anchored centre has no free row and takes no part.
Everything that is as large as f or y has the lanes last; matrices have them first.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.solvers.inverse_factor import inverse_factor


def factorise(problem: HomomorphismProblem, is_row, free, d_plus, d_minus, d_f) -> Callable:
    """Factorises the systems of all lanes.

    Args:
      problem: the LPs.
      is_row: bool [n, A, m + L, lanes], the entries of K f that exist.
      free: bool [n, m, lanes], those of f that can move.
      d_plus, d_minus: [n, A, m + L, lanes], y+ / s+ and y- / s-; 0 where there is no row. d_f: [n, m, lanes], z / f.

    Returns:
      A function of what y+ s+, y- s- and z f are to become, divided by s+, s- and f. It returns df [n, m, lanes],
      K df, de [lanes], and the new y+, y- and z.
    """
    first = 1 if problem.anchored else 0
    moving = jnp.moveaxis(free[first:], -1, 0)  # [lanes, n', m]
    lanes, count, m = moving.shape
    size = count * m
    models = [jnp.moveaxis(model, -1, 0) for model in (problem.source, problem.target, d_plus + d_minus)]
    if problem.source_labels is None:
        normal = jax.vmap(normal_matrix, (0, 0, 0, None))(*models, first)
    else:
        labels = (jnp.moveaxis(label, -1, 0) for label in (problem.source_labels, problem.target_labels))
        normal = jax.vmap(normal_matrix, (0, 0, 0, None, 0, 0))(*models, first, *labels)
    is_free = moving.reshape(lanes, size)
    diagonal = jnp.where(is_free, jnp.moveaxis(d_f[first:], -1, 0).reshape(lanes, size), 1.0)
    normal = jnp.where(is_free[:, :, None] & is_free[:, None], normal, 0.0)
    normal += jnp.where(jnp.eye(size, dtype=bool), diagonal[:, None], 0.0)
    factor = jax.vmap(inverse_factor)(normal)  # W, N^-1 = W^T W
    coupling = jnp.where(free, problem.adjoint(d_plus - d_minus), 0.0)[first:]
    coupling = jnp.einsum("bij,bj->bi", factor, jnp.moveaxis(coupling, -1, 0).reshape(lanes, size))
    rows = (factor.reshape(lanes, size, count, m) * moving[:, None]).sum(axis=-1)  # W E^T, [lanes, n' m, n']
    border = jnp.einsum("bxi,bxj->bij", rows, rows)
    has_row = moving.any(axis=2)
    border += jnp.where(jnp.eye(count, dtype=bool) & ~has_row[:, None], 1.0, 0.0)
    border_factor = jax.vmap(inverse_factor)(border)

    def solve_border(right):
        return jnp.einsum("bji,bjk,bk->bi", border_factor, border_factor, right)

    beside = jnp.einsum("bxi,bx->bi", rows, coupling)
    beside_solved = solve_border(beside)
    corner = (coupling**2).sum(axis=1) - (d_plus + d_minus).sum(axis=(0, 1, 2)) - (beside * beside_solved).sum(axis=1)

    def direction(r_plus, r_minus, r_f):
        r_plus, r_minus = jnp.where(is_row, r_plus, 0.0), jnp.where(is_row, r_minus, 0.0)
        pull = jnp.where(free, r_f - problem.adjoint(r_plus - r_minus), 0.0)[first:]
        base = jnp.einsum("bij,bj->bi", factor, jnp.moveaxis(pull, -1, 0).reshape(lanes, size))
        right = -jnp.einsum("bxi,bx->bi", rows, base)
        rest = 1.0 - (r_plus + r_minus).sum(axis=(0, 1, 2)) - (coupling * base).sum(axis=1)
        de = (rest - (beside_solved * right).sum(axis=1)) / corner
        multipliers = solve_border(right - beside * de[:, None])
        base += coupling * de[:, None] + jnp.einsum("bxi,bi->bx", rows, multipliers)
        df = jnp.einsum("bij,bi->bj", factor, base).reshape(lanes, count, m)
        df = jnp.concatenate([jnp.zeros((first, m, lanes), df.dtype), jnp.moveaxis(df, 0, -1)])
        change = problem.forward(df)
        new_plus = jnp.where(is_row, r_plus - d_plus * (de - change), 0.0)
        new_minus = jnp.where(is_row, r_minus - d_minus * (de + change), 0.0)
        return df, change, de, new_plus, new_minus, jnp.where(free, r_f - d_f * df, 0.0)

    return direction


def normal_matrix(source, target, weight, first: int = 0, source_labels=None, target_labels=None) -> jax.Array:
    """K^T diag(weight) K over the rows of f from `first` on, as a matrix over (row, column) of f.

    Args:
      source: [n, A, n]. target: [m, A, m]. weight: [n, A, m + L], L = 0 without labels.
      first: how many rows of f are left out.
      source_labels: [n, A, L]. target_labels: [m, A, L].
    """
    m, num_actions = target.shape[:2]
    into, own = source[:, :, first:], weight[first:]
    n = into.shape[2]
    # sum_ia w(i,a,k) T(i,a,j) T(i,a,p), for each column k: [k, j, p].
    flat = into.reshape(len(into) * num_actions, n)
    scaled = weight[:, :, :m].reshape(len(flat), m).T[:, None] * flat.T
    same_column = (scaled.reshape(m * n, len(flat)) @ flat).reshape(m, n, n)
    # sum_ak w(j,a,k) T'(l,a,k) T'(q,a,k), for each row j: [j, l, q].
    flat = target.reshape(m, -1)
    scaled = own[:, :, :m].reshape(n, 1, num_actions * m) * flat
    same_row = (scaled.reshape(n * m, num_actions * m) @ flat.T).reshape(n, m, m)
    if source_labels is not None:
        # A row (j, a) of labels meets f(j, l) with l(j,a) - l'(l,a), and no other row of f.
        apart = (source_labels[first:, None] - target_labels).reshape(n, m, num_actions * source_labels.shape[2])
        same_row += (own[:, :, m:].reshape(n, 1, apart.shape[2]) * apart) @ apart.transpose(0, 2, 1)
    # Row (p, a, k) of K meets f(j, k) with T(p,a,j) and f(p, q) with -T'(q,a,k): [k, (j, p), q].
    scaled = own[:, :, :m].transpose(2, 0, 1)[:, None] * into[first:].transpose(2, 0, 1)
    cross = scaled.reshape(m, n * n, num_actions) @ target.transpose(2, 1, 0)
    cross = cross.reshape(m, n, n, m).transpose(1, 0, 2, 3)  # [j, k, p, q]
    matrix = jnp.where(jnp.eye(m, dtype=bool)[:, None], same_column.transpose(1, 0, 2)[..., None], 0.0)
    matrix += jnp.where(jnp.eye(n, dtype=bool)[:, None, :, None], same_row[:, :, None], 0.0)
    return (matrix - cross - cross.transpose(2, 3, 0, 1)).reshape(n * m, n * m)
