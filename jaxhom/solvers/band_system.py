"""Normal matrices of linear programs over occupancies, assembled and factorised inside a compiled program, by lanes.

    [ F D F^T          F D Phi         0 ] [ y ]   [ right        ]
    [ Phi^T D F^T   Phi^T D Phi + D'   b ] [ w ] = [ others right ],     D = diag(d) > 0, D' = diag(d') > 0.
    [ 0                  b^T           0 ] [ f ]   [ free right   ]

F [n, P] is sparse and F F^T a narrow band (`block_tridiagonal`), Phi [P, K] are features. All that a matrix of the band
has is linear in d: which entries of d make up which number is the same for all programs and found once, on the host
(`Gathered`). Then a block at a time, in a `scan`: the block left of the diagonal, the inverse of the diagonal block's
factor, and the block of the border. Lanes come first, the batch axis of the matrix products. No call of LAPACK, none
of the host: the same program runs on a GPU. `normal_equations` is the plain version.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom import checks
from jaxhom.solvers.block_tridiagonal import Blocks, order_in_blocks
from jaxhom.solvers.inverse_factor import inverse_factor_in_loops
from jaxhom.solvers.normal_equations import REGULARISATION
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

_UNIT = 16  # sizes of blocks are multiples of it
_MIN_BLOCK = 32  # smaller ones are more steps, not less work
_BUCKETS = 3  # of rows by their lengths: a row of the largest grids' matrices is 1 to 30 terms long


class Gathered(Record):
    """A sparse matrix [n, m] for products with vectors [L, m]: rows of similar lengths padded to one.

    Attributes:
      parts: (index [r, W], weight [r, W]) of some rows. place: [n], where the parts, one after the other, have a row.
    """

    parts: tuple[tuple[Int[Array, "r W"], Float[Array, "r W"]], ...]
    place: Int[Array, " n"]

    @classmethod
    def of(cls, matrix: scipy.sparse.sparray) -> Gathered:
        """On the host."""
        matrix = scipy.sparse.csr_array(matrix)
        lengths = np.diff(matrix.indptr)
        order = np.argsort(lengths, kind="stable")
        parts = []
        for rows in _buckets(lengths[order]):
            some = order[rows]
            width = max(1, int(lengths[some].max(initial=0)))
            slot = np.arange(width)
            there = slot < lengths[some, None]
            at = np.where(there, matrix.indptr[some, None] + slot, 0)
            weight = np.where(there, matrix.data[at], 0.0) if matrix.nnz else np.zeros(at.shape)
            index = np.where(there, matrix.indices[at], 0) if matrix.nnz else at
            parts.append((checks.to_device(index, jnp.int32), checks.to_device(weight, float)))
        return cls(parts=tuple(parts), place=checks.to_device(np.argsort(order), jnp.int32))

    def __matmul__(self, vectors: Float[Array, "L m"]) -> Float[Array, "L n"]:
        sums = [(vectors[:, index] * weight).sum(axis=-1) for index, weight in self.parts]
        return (jnp.concatenate(sums, axis=1) if len(sums) > 1 else sums[0])[:, self.place]

    def compact(self, vectors: Float[Array, "L m"]) -> Float[Array, "L n"]:
        """The product in the order of the parts, between a 0 and a 1 that placements may point to."""
        sums = [(vectors[:, index] * weight).sum(axis=-1) for index, weight in self.parts]
        ends = jnp.zeros((len(vectors), 1)), jnp.ones((len(vectors), 1))
        return jnp.concatenate([ends[0], *sums, ends[1]], axis=1)


def _buckets(lengths: np.ndarray) -> list[slice]:
    """Slices of ascending lengths that waste little when each is padded to its largest."""
    cuts = {0, len(lengths)}
    for _ in range(_BUCKETS - 1):
        options = np.flatnonzero(np.diff(lengths)) + 1
        if not options.size:
            break
        cuts.add(int(min(options, key=lambda cut: _padded(lengths, cuts | {int(cut)}))))
    ends = sorted(cuts)
    return [slice(first, last) for first, last in itertools.pairwise(ends)]


def _padded(lengths: np.ndarray, cuts: set[int]) -> int:
    ends = sorted(cuts)
    return sum((last - first) * int(lengths[last - 1]) for first, last in itertools.pairwise(ends))


class Factor(Record):
    """What solves use, of L lanes. The band is B blocks of size c.

    Attributes:
      left: [B, L, c, c], blocks left of the diagonal. inverse: [B, L, c, c], inverse factors of the diagonal blocks.
      half: [B, L, c, K], the border. corner: [L, K, K], the inverse factor of what is left of the corner.
      behind: [L, K], the corner's solution for b. free: [L], b . behind.
    """

    left: Float[Array, "B L c c"]
    inverse: Float[Array, "B L c c"]
    half: Float[Array, "B L c K"]
    corner: Float[Array, "L K K"]
    behind: Float[Array, "L K"]
    free: Float[Array, " L"]


class BandSystem(Record):
    """F, Phi and b of all programs over a model, rows of F in the order of the blocks, filled up to whole ones.

    Attributes:
      core: F [B c, P]. core_transpose: F^T. features: Phi by groups of columns that share them [G, K].
      group: [P], of each column. members: [G, P] of 0 and 1.
      band: the entries of F D F^T. diagonal, left: [B, c, c], which of them stands where (0: none).
      crossing: the entries of F D Phi. border: [B, c, K], likewise.
      free_column: b [K].
    """

    core: Gathered
    core_transpose: Gathered
    features: Float[Array, "G K"]
    group: Int[Array, " P"]
    members: Gathered
    band: Gathered
    diagonal: Int[Array, "B c c"]
    left: Int[Array, "B c c"]
    crossing: Gathered
    border: Int[Array, "B c K"]
    free_column: Float[Array, " K"]

    def products(self, z: Float[Array, "L P+K"]) -> tuple[Float[Array, "L n"], Float[Array, "L K"]]:
        """F z, and Phi^T z - slack, for z with the slack behind it."""
        x, slack = self._cut(z)
        return self.core @ x, (self.members @ x) @ self.features - slack

    def transposed(self, y: Float[Array, "L n"], w: Float[Array, "L K"]) -> Float[Array, "L P+K"]:
        """F^T y + Phi w, and -w behind it."""
        return jnp.concatenate([self.core_transpose @ y + (w @ self.features.T)[:, self.group], -w], axis=1)

    def _cut(self, z):
        pairs = len(self.group)
        return z[:, :pairs], z[:, pairs:]

    def factor(self, d: Float[Array, "L P+K"]) -> Factor:
        """NaN where a matrix is not positive definite in floating point."""
        x, slack = self._cut(d)
        corner = self._corner(self.members @ x, slack)
        corner, (left, inverse, half) = self._eliminate(self.band.compact(x), self.crossing.compact(x), corner)
        corner = inverse_factor_in_loops(_regular(corner))
        behind = _apply_transposed(corner, _apply(corner, jnp.broadcast_to(self.free_column, slack.shape)))
        free = behind @ self.free_column
        return Factor(left=left, inverse=inverse, half=half, corner=corner, behind=behind, free=free)

    def _corner(self, d: Float[Array, "L G"], slack: Float[Array, "L K"]) -> Float[Array, "L K K"]:
        identity = jnp.eye(slack.shape[1])
        dense = (self.features.T * d[:, None, :]) @ self.features
        return dense + slack[:, :, None] * identity

    def _eliminate(self, band, crossing, corner):
        """The corner without the band's share, and the blocks of the factor."""
        lanes, size, width = len(band), self.diagonal.shape[-1], self.border.shape[-1]

        def block(carry, places):
            corner, inverse, half = carry
            diagonal, left, border = places
            left = band[:, left] @ inverse.mT
            taken = left @ jnp.concatenate([left.mT, half], axis=-1)
            inverse = inverse_factor_in_loops(_regular(band[:, diagonal]) - taken[..., :size])
            half = inverse @ (crossing[:, border] - taken[..., size:])
            return (corner - half.mT @ half, inverse, half), (left, inverse, half)

        start = (corner, jnp.zeros((lanes, size, size)), jnp.zeros((lanes, size, width)))
        (corner, _, _), blocks = jax.lax.scan(block, start, (self.diagonal, self.left, self.border))
        return corner, blocks

    def solve(
        self, factor: Factor, right: Float[Array, "L n"], others: Float[Array, "L K"], free: Float[Array, " L"]
    ) -> tuple[Float[Array, "L n"], Float[Array, "L K"], Float[Array, " L"]]:
        """(y, w, f), by the factor alone: without refinement."""
        lanes, count, size = len(right), *self.diagonal.shape[:2]
        blocks = jnp.moveaxis(right.reshape(lanes, count, size), 1, 0)

        def down(known, block):
            left, inverse, right = block
            known = _apply(inverse, right - _apply(left, known))
            return known, known

        nothing = jnp.zeros((lanes, size))
        _, parts = jax.lax.scan(down, nothing, (factor.left, factor.inverse, blocks))
        others = others - jnp.einsum("blck,blc->lk", factor.half, parts)
        w = _apply_transposed(factor.corner, _apply(factor.corner, others))
        f = (w @ self.free_column - free) / factor.free
        w = w - f[:, None] * factor.behind
        parts = parts - jnp.einsum("blck,lk->blc", factor.half, w)

        def up(taken, block):
            left, inverse, part = block
            known = _apply_transposed(inverse, part - taken)
            return _apply_transposed(left, known), known

        _, parts = jax.lax.scan(up, nothing, (factor.left, factor.inverse, parts), reverse=True)
        return jnp.moveaxis(parts, 0, 1).reshape(lanes, -1), w, f


def _apply(matrix, vector):
    return jnp.einsum("lij,lj->li", matrix, vector)


def _apply_transposed(matrix, vector):
    return jnp.einsum("lij,li->lj", matrix, vector)


def _regular(matrix):
    return matrix * (1.0 + REGULARISATION * jnp.eye(matrix.shape[-1]))


def band_system(
    core: scipy.sparse.sparray,
    features: Float[np.ndarray, "G K"],
    group: Int[np.ndarray, " P"],
    free_column: Float[np.ndarray, " K"],
) -> tuple[BandSystem, Blocks]:
    """The system of a model, and the order of its rows: row r of `core` stands at `blocks.place[r]`. On the host.

    Args:
      core: F [n, P]. features: [G, K], group: [P], so that Phi[p] = features[group[p]]. free_column: b [K].
    """
    core = scipy.sparse.csr_array(core)
    blocks = _round(order_in_blocks(abs(core) @ abs(core).T, _MIN_BLOCK))
    ordered = _filled(core[blocks.order], blocks)
    members = scipy.sparse.csr_array(
        (np.ones(len(group)), (group, np.arange(len(group)))), shape=(len(features), len(group))
    )
    phi = scipy.sparse.csr_array(features)[group]
    band, diagonal, left = _band(ordered, blocks)
    crossing, border = _crossing(ordered, phi, blocks)
    system = BandSystem(
        core=Gathered.of(ordered),
        core_transpose=Gathered.of(ordered.T),
        features=checks.to_device(features, float),
        group=checks.to_device(group, jnp.int32),
        members=Gathered.of(members),
        band=band,
        diagonal=diagonal,
        left=left,
        crossing=crossing,
        border=border,
        free_column=checks.to_device(free_column, float),
    )
    return system, blocks


def _round(blocks: Blocks) -> Blocks:
    return Blocks(order=blocks.order, place=blocks.place, size=-(-blocks.size // _UNIT) * _UNIT)


def _filled(matrix, blocks: Blocks) -> scipy.sparse.csr_array:
    """With empty rows up to whole blocks."""
    missing = blocks.count * blocks.size - matrix.shape[0]
    return scipy.sparse.vstack([matrix, scipy.sparse.csr_array((missing, matrix.shape[1]))], format="csr")


def _band(core, blocks: Blocks):
    """The entries of F D F^T on and below the diagonal, and their places in the blocks."""
    size, count, n = blocks.size, blocks.count, len(blocks.order)
    row, column, pair, weight = _joined(core, core)
    is_below = row >= column
    entries, sums = _entries(row[is_below], column[is_below], pair[is_below], weight[is_below], core.shape)
    diagonal, left = np.zeros((2, count, size, size), np.int32)
    number = 1 + np.asarray(sums.place)
    i, j = entries
    same = i // size == j // size
    diagonal[i[same] // size, i[same] % size, j[same] % size] = number[same]
    diagonal[i[same] // size, j[same] % size, i[same] % size] = number[same]
    left[i[~same] // size, i[~same] % size, j[~same] % size] = number[~same]
    filling = np.arange(n - (count - 1) * size, size)
    diagonal[-1, filling, filling] = len(number) + 1
    return sums, checks.to_device(diagonal), checks.to_device(left)


def _crossing(core, phi, blocks: Blocks):
    """The entries of F D Phi, and their places."""
    row, feature, pair, weight = _joined(core, phi.T.tocsr())
    (i, k), sums = _entries(row, feature, pair, weight, core.shape)
    border = np.zeros((blocks.count, blocks.size, phi.shape[1]), np.int32)
    border[i // blocks.size, i % blocks.size, k] = 1 + np.asarray(sums.place)
    return sums, checks.to_device(border)


def _joined(one, two):
    """All (row of one, row of two, column that both have, product of the entries)."""
    one, two = one.tocsc(), two.tocsc()
    sizes = np.diff(one.indptr), np.diff(two.indptr)
    counts = sizes[0] * sizes[1]
    pair = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    first = one.indptr[pair] + within // sizes[1][pair]
    second = two.indptr[pair] + within % sizes[1][pair]
    return one.indices[first], two.indices[second], pair, one.data[first] * two.data[second]


def _entries(row, column, pair, weight, shape) -> tuple[tuple[np.ndarray, np.ndarray], Gathered]:
    """The (row, column) that occur, and for each of them the sum over its pairs."""
    key = row.astype(np.int64) * max(shape) + column
    keys, number = np.unique(key, return_inverse=True)
    sums = scipy.sparse.csr_array((weight, (number, pair)), shape=(len(keys), shape[1]))
    return (keys // max(shape), keys % max(shape)), Gathered.of(sums)
