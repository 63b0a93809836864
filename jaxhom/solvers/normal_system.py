"""Linear systems of interior-point steps over occupancies, for a batch of programs, inside a compiled program.

    [ A D A^T   b ] [ y ]   [ right      ]
    [ b^T       0 ] [ f ] = [ free right ],     D = diag(d), d > 0, another one in each lane; b one column.

The first rows of A, its core, are flow constraints: they link a state to its successors alone, so their part of A D A^T
is as sparse as the model's graph, on a grid a band about twice as wide as the grid. The other rows (one per feature)
are a dense border of it, or stand in the band, whichever is less work. A D A^T is linear in d: which products of entries
of A add up to which of its entries is found once, on the host (`prepare`).

Rows are in an order of their own, filled up to whole blocks: `place` says where each went.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from jaxhom.solvers.block_factor import BlockFactor, factor_blocks, solve_blocks
from jaxhom.solvers.block_tridiagonal import Blocks, order_in_blocks
from jaxhom.solvers.gathered_sums import GatheredSums
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

_REGULARISATION = 1e-14  # share of each diagonal entry of what is factorised
_REFINEMENTS = 2  # per solve, at most: as d spreads, the factorisation alone loses digits
_ACCURATE = 1e-8  # share of the right-hand side that may be missing
_MIN_BLOCK = 32  # smaller ones are more turns of a loop, not less work
_DENSE = 0.2  # share of entries from which on dense products are taken to be faster
_PRODUCTS = 3.0  # of matrices of a block's size per block, all in all
_MOST_VALUES = 2**25  # of other rows, repeated where they are needed: 256 MB
_FEW = 4  # entries in a column of the other rows, on average: more, and dense products with them are faster


class SparseRows(Record):
    """Some rows of A and their transpose."""

    matrix: GatheredSums
    transpose: GatheredSums

    @classmethod
    def of(cls, matrix: scipy.sparse.sparray) -> SparseRows:
        return cls(matrix=GatheredSums.of(matrix), transpose=GatheredSums.of(matrix.T))

    def times(self, z):
        return self.matrix.times(z)

    def transpose_times(self, y):
        return self.transpose.times(y)


class DenseRows(Record):
    """Some rows of A as a dense matrix [rows, groups], for columns that are the same within a group.

    Attributes:
      values: [rows, groups].
      sums: adds up the columns of each group. spread: int32 [m], the group of each column. None where each is its own.
    """

    values: Float[Array, "rows groups"]
    sums: GatheredSums | None
    spread: Int[Array, " m"] | None

    @classmethod
    def of(cls, matrix: scipy.sparse.sparray) -> DenseRows:
        columns = scipy.sparse.csc_array(matrix)
        group, representative = _groups(columns)
        if len(representative) == columns.shape[1]:
            return cls(values=columns.toarray(), sums=None, spread=None)
        member = scipy.sparse.csr_array((np.ones(len(group)), (group, np.arange(len(group)))))
        values = columns[:, representative].toarray()
        return cls(values=values, sums=GatheredSums.of(member), spread=group.astype(np.int32))

    def group_sums(self, z):
        return z if self.sums is None else self.sums.times(z)

    def times(self, z):
        return self.group_sums(z) @ self.values.T

    def transpose_times(self, y):
        of_groups = y @ self.values
        return of_groups if self.spread is None else of_groups[:, self.spread]


class Entries(Record):
    """Some entries of A D A^T, part by part, as sums over d and their places in dense arrays.

    Attributes:
      sums: d [m] -> values [parts * width].
      target: int32 [parts, width], place within the part's array; the array's size on padding.
    """

    sums: GatheredSums
    target: Int[Array, "parts width"]

    @classmethod
    def of(cls, part, target, column, value, num_parts: int, size: int, num_columns: int) -> Entries:
        """Of products `value` that belong to `target` of `part` and are to be multiplied by d of `column`."""
        key, entry = np.unique(part.astype(np.int64) * size + target, return_inverse=True)
        first = np.searchsorted(key, np.arange(num_parts + 1, dtype=np.int64) * size)
        width = max(1, int(np.diff(first).max()))
        of_part = np.repeat(np.arange(num_parts), np.diff(first))
        slot = of_part * width + np.arange(len(key)) - first[of_part]
        targets = np.full(num_parts * width, size, np.int32)
        targets[slot] = key % size
        sums = scipy.sparse.coo_array((value, (slot[entry], column)), shape=(num_parts * width, num_columns))
        return cls(sums=GatheredSums.of(sums), target=targets.reshape(num_parts, width))

    def values(self, d: Float[Array, "lanes m"]) -> Float[Array, "parts lanes width"]:
        """The entries of each part."""
        return jnp.swapaxes(self.sums.times(d).reshape(len(d), *self.target.shape), 0, 1)


def _scattered(values: Float[Array, "lanes width"], target: Int[Array, " width"], size: int):
    """A part's array [lanes, size]."""
    zeros = jnp.zeros((len(values), size), values.dtype)
    return zeros.at[:, target].set(values, mode="drop", unique_indices=True, indices_are_sorted=True)


class System(Record):
    """A and b, and what a program needs to factorise A D A^T in batches.

    Attributes:
      core, others: the rows of A; `others` may be none.
      free: [nb n + q], the column b.
      band: entries within each block row: [diagonal | left | border], lower triangle; None where the core is dense.
      border: [nb, n, V, q], values of the other rows, and the groups' sums to multiply them by; or None.
      corner: entries of the others' own part; None where they are dense.
      filling: [nb, n], 1 on the places that are no row.
    """

    core: SparseRows | DenseRows
    others: SparseRows | DenseRows | None
    free: Float[Array, " rows"]
    band: Entries | None
    border: tuple[GatheredSums, Float[Array, "nb n V q"]] | None
    corner: Entries | None
    filling: Float[Array, "nb n"]
    num_border: int = dataclasses.field(metadata={"static": True})

    @property
    def num_rows(self) -> int:
        return len(self.free)

    @property
    def num_columns(self) -> int:
        rows = self.core
        return len(rows.transpose.index[0][0]) if isinstance(rows, SparseRows) else rows.values.shape[1]

    @property
    def factor_size(self) -> int:
        """Numbers of a factor, per lane."""
        count, size = self.filling.shape
        return count * size * (2 * size + self.num_border) + self.num_border**2

    @property
    def work(self) -> float:
        """Multiplications of a factorisation, to compare methods by."""
        count, size = self.filling.shape
        border = count * size * self.num_border * (2 * size + self.num_border) + self.num_border**3 / 3
        return float(count) * size**3 + border

    def times(self, z: Float[Array, "lanes m"]) -> Float[Array, "lanes rows"]:
        """A z."""
        of_core = self.core.times(z)
        return of_core if self.others is None else jnp.concatenate([of_core, self.others.times(z)], axis=1)

    def transpose_times(self, y: Float[Array, "lanes rows"]) -> Float[Array, "lanes m"]:
        """A^T y."""
        if self.others is None:
            return self.core.transpose_times(y)
        num_core = self.num_rows - self.num_border
        return self.core.transpose_times(y[:, :num_core]) + self.others.transpose_times(y[:, num_core:])


class Factor(Record):
    """A factorised system.

    Attributes:
      blocks: the factor of A D A^T. d: [lanes, m].
      behind_free: [lanes, rows], (A D A^T)^-1 b. free_block: [lanes], b^T times that.
    """

    blocks: BlockFactor
    d: Float[Array, "lanes m"]
    behind_free: Float[Array, "lanes rows"]
    free_block: Float[Array, " lanes"]


def factor(system: System, d: Float[Array, "lanes m"]) -> Factor:
    """Factorises; NaN in the lanes where rounding makes A D A^T indefinite."""
    blocks = _factorised(system, d)
    free = jnp.broadcast_to(system.free, (len(d), system.num_rows))
    behind = _solve_normal(system, blocks, free)
    return Factor(blocks=blocks, d=d, behind_free=behind, free_block=behind @ system.free)


def solve(
    system: System, factor: Factor, right: Float[Array, "lanes rows"], free_right: Float[Array, " lanes"]
) -> tuple[Float[Array, "lanes rows"], Float[Array, " lanes"]]:
    """(y, f), with iterative refinement in the lanes that need it."""

    def once(right, free_right):
        y = _solve_normal(system, factor.blocks, right)
        f = (y @ system.free - free_right) / factor.free_block
        return y - factor.behind_free * f[:, None], f

    def missing(y, f):
        product = system.times(factor.d * system.transpose_times(y)) + f[:, None] * system.free
        return right - product, free_right - y @ system.free

    scale = jnp.maximum(jnp.abs(right).max(axis=1), jnp.abs(free_right))

    def is_inaccurate(left_over):
        most = jnp.maximum(jnp.abs(left_over[0]).max(axis=1), jnp.abs(left_over[1]))
        return most > _ACCURATE * scale  # not a lane of NaN

    def refine(carry):
        y, f, left_over, count = carry
        open_ = is_inaccurate(left_over)
        more_y, more_f = once(*left_over)
        y, f = jnp.where(open_[:, None], y + more_y, y), jnp.where(open_, f + more_f, f)
        return y, f, missing(y, f), count + 1

    def keep_going(carry):
        return is_inaccurate(carry[2]).any() & (carry[3] < _REFINEMENTS)

    y, f = once(right, free_right)
    y, f, *_ = jax.lax.while_loop(keep_going, refine, (y, f, missing(y, f), 0))
    return y, f


def _solve_normal(system: System, blocks: BlockFactor, right):
    num_core = system.num_rows - system.num_border
    return jnp.concatenate(solve_blocks(blocks, right[:, :num_core], right[:, num_core:]), axis=1)


def _factorised(system: System, d) -> BlockFactor:
    """The factor of A D A^T."""
    (count, size), q, lanes = system.filling.shape, system.num_border, len(d)

    if isinstance(system.core, DenseRows):
        scaled = system.core.values * d[:, None]
        border = scaled @ system.others.values.T if q else jnp.zeros((lanes, size, 0), d.dtype)
        rows = (scaled @ system.core.values.T)[None], border[None]

        def block(row):
            return _regularised(row[0]), None, row[1]

    else:
        rows = [system.filling, system.band.values(d), system.band.target]
        if system.border is not None:
            sums, values = system.border
            weights = sums.times(d).reshape(lanes, *values.shape[:3])
            rows += [jnp.swapaxes(weights, 0, 1), values]
        shapes = [(size, size), *[(size, size)] * (count > 1), *[(size, q)] * (system.border is None)]

        def block(row):
            filling, values, target, *others = row
            diagonal, *parts = _cut(_scattered(values, target, sum(a * b for a, b in shapes)), shapes)
            left = parts[0] if count > 1 else None
            border = jnp.einsum("lnv,nvq->lnq", *others) if others else parts[-1]
            return _regularised(_mirrored(diagonal), filling), left, border

    return factor_blocks(block, rows, _corner(system, d))


def _corner(system: System, d):
    """The other rows' part of A D A^T, [lanes, q, q]."""
    q = system.num_border
    if system.corner is not None:
        corner = _scattered(system.corner.values(d)[0], system.corner.target[0], q * q)
        return _regularised(_mirrored(corner.reshape(len(d), q, q)))
    if q:
        values = system.others.values
        return _regularised((values * system.others.group_sums(d)[:, None]) @ values.T)
    return jnp.zeros((len(d), 0, 0), d.dtype)


def _cut(flat, shapes):
    """Arrays of the given shapes one after the other out of [lanes, numbers]."""
    ends = np.cumsum([a * b for a, b in shapes])[:-1]
    return [part.reshape(len(flat), *shape) for part, shape in zip(jnp.split(flat, ends, axis=1), shapes, strict=True)]


def _mirrored(lower):
    """The symmetric matrices of the given lower triangles."""
    return lower + jnp.swapaxes(jnp.tril(lower, -1), 1, 2)


def _regularised(matrix, filling=0.0):
    more = _REGULARISATION * jnp.diagonal(matrix, axis1=1, axis2=2) + filling
    return matrix + more[:, :, None] * jnp.eye(matrix.shape[-1], dtype=matrix.dtype)


# -------------------------------------------------------------------------------------------------- made on the host


def prepare(
    matrix: scipy.sparse.sparray, free_column: Float[np.ndarray, " rows"], num_core: int
) -> tuple[System, Int[np.ndarray, " rows"]]:
    """Prepares the systems of A and b, on the host.

    Args:
      matrix: sparse A [rows, m], every row with an entry.
      free_column: b.
      num_core: rows before this number are flow constraints.

    Returns:
      The system, its leaves in NumPy, and the place of each row in it.
    """
    matrix = scipy.sparse.csr_array(matrix)
    core, others = matrix[:num_core], matrix[num_core:]
    blocks, in_band = _order(core, others, matrix)
    if in_band:
        core, others = matrix, matrix[:0]
    count, size, q = blocks.count, blocks.size, others.shape[0]
    place = np.concatenate([blocks.place, count * size + np.arange(q)])
    free, filling = np.zeros(count * size + q), np.ones(count * size)
    free[place] = free_column
    filling[blocks.place] = 0.0
    core = _placed(core, blocks.place, count * size)
    if count == 1 and core.nnz > _DENSE * core.shape[0] * core.shape[1]:
        dense = {"core": DenseRows(values=core.toarray(), sums=None, spread=None)}
        dense["others"] = DenseRows(values=others.toarray(), sums=None, spread=None) if q else None
        parts = dense | {"band": None, "border": None, "corner": None}
    else:
        parts = _sparse_parts(core, others, count, size)
    return System(**parts, free=free, filling=filling.reshape(count, size), num_border=q), place


def _order(core, others, matrix) -> tuple[Blocks, bool]:
    """The blocks, and whether the other rows stand in them."""
    blocks, q = order_in_blocks(abs(core) @ abs(core).T, _MIN_BLOCK), others.shape[0]
    if others.nnz > _FEW * others.shape[1] or not q:
        return blocks, not q
    together = order_in_blocks(abs(matrix) @ abs(matrix).T, _MIN_BLOCK)
    return (together, True) if together.work < blocks.work + _border_work(blocks, q) else (blocks, False)


def _border_work(blocks: Blocks, q: int) -> float:
    rows = blocks.count * blocks.size
    return rows * q * (2.0 * blocks.size + q) / _PRODUCTS + q**3


def _placed(rows, place, num_places: int):
    """Rows at their places."""
    rows = scipy.sparse.coo_array(rows)
    return scipy.sparse.csr_array((rows.data, (place[rows.row], rows.col)), shape=(num_places, rows.shape[1]))


def _sparse_parts(core, others, count: int, size: int) -> dict:
    """What a system with a sparse core is made of."""
    q, num_columns = others.shape[0], core.shape[1]
    parts = {"core": SparseRows.of(core), "others": None, "border": None, "corner": None}
    i, j, column, value = _products(core, core)
    keep = i >= j
    i, j, column, value = i[keep], j[keep], column[keep], value[keep]
    (part, row), (before, place) = divmod(i, size), divmod(j, size)
    bands = [(part, row * size + place + (part > before) * size * size, column, value)]
    length = size * size * (1 + (count > 1))
    if q and others.nnz > _FEW * num_columns:
        dense = DenseRows.of(others)
        border = _dense_border(core, dense)
        if border is not None:
            sums, values = border
            parts |= {"others": dense, "border": (sums, values.reshape(count, size, -1, q))}
    if q and parts["border"] is None:
        parts["others"] = SparseRows.of(others)
        i, k, column, value = _products(core, others)
        bands.append((i // size, length + i % size * q + k, column, value))
        i, k, column, value = _products(others, others)
        keep = i >= k
        target = (i * q + k)[keep]
        parts["corner"] = Entries.of(0 * target, target, column[keep], value[keep], 1, q * q, num_columns)
    joined = [np.concatenate(arrays) for arrays in zip(*bands, strict=True)]
    length += size * q * (parts["border"] is None)
    return parts | {"band": Entries.of(*joined, count, length, num_columns)}


def _products(left, right):
    """All products of an entry of `left` and one of `right` in the same column: their rows, the column, the value."""
    left, right = scipy.sparse.csc_array(left), scipy.sparse.csc_array(right)
    of_left, of_right = np.diff(left.indptr), np.diff(right.indptr)
    counts = of_left * of_right
    column = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    one, other = divmod(within, of_right[column])
    one, other = left.indptr[column] + one, right.indptr[column] + other
    return left.indices[one].astype(np.int64), right.indices[other], column, left.data[one] * right.data[other]


def _dense_border(core, others: DenseRows):
    """For each core row the sums over its groups of columns [rows * V], and the other rows' values there [rows, V, q].

    None where rows have so many groups that the values would be many.
    """
    num_rows, num_columns = core.shape
    group = np.arange(num_columns) if others.spread is None else others.spread
    entries = scipy.sparse.coo_array(core)
    key, entry = np.unique(entries.row * np.int64(num_columns) + group[entries.col], return_inverse=True)
    row = key // num_columns
    first = np.searchsorted(row, np.arange(num_rows + 1))
    width = int(np.diff(first).max())
    if num_rows * width * len(others.values) > _MOST_VALUES:
        return None
    slot = row * width + np.arange(len(key)) - first[row]
    sums = scipy.sparse.coo_array((entries.data, (slot[entry], entries.col)), shape=(num_rows * width, num_columns))
    values = np.zeros((num_rows * width, len(others.values)))
    values[slot] = others.values.T[key % num_columns]
    return GatheredSums.of(sums), values.reshape(num_rows, width, -1)


def _groups(columns: scipy.sparse.csc_array) -> tuple[np.ndarray, np.ndarray]:
    """The group of each column, and a column of each group: columns are in one if they are equal."""
    random = np.random.default_rng(0).standard_normal(columns.shape[0])
    _, representative, group = np.unique(columns.T @ random, return_index=True, return_inverse=True)
    different = columns - columns[:, representative[group]]
    different.eliminate_zeros()
    if different.nnz:  # two that are not equal have the same sum: unheard of
        return np.arange(columns.shape[1]), np.arange(columns.shape[1])
    return group, representative
