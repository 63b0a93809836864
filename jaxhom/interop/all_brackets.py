"""Brackets of all ordered pairs of classes, in a folder: more than memory holds, made by several processes or in turns.

    about.npz             what they are brackets of: transitions, relation, distance, anchored and labels as in
                          `save_similarity`; tolerance, method and max_iterations; shard_size; class_of_state [S] and
                          representative [C], classes numbered by their first states
    brackets-000000.npy   pairs 0, 1, ... of them, as many as shard_size: structured, lower, upper, iterations, status
    brackets-000001.npy   the next ones; pair i is from class i // C to class i mod C

A shard is there once it is whole. Those that are there are not made again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.interop.archives import FileError, read_archive, readable_reason, require_arrays, whole_file, write_archive
from jaxhom.models.inputs import as_model, check_states
from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import LocalSimilarity
from jaxhom.similarity.table import SimilarityTable
from jaxhom.similarity.table_contents import HEADING, transitions_digest

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Int

_ABOUT = "about.npz"


def save_all_brackets(
    folder: str | os.PathLike,
    table: SimilarityTable,
    *,
    tolerance: float = 1e-4,
    method: str = "auto",
    max_iterations: int = 100_000,
    shard_size: int = 2**16,
    part: tuple[int, int] = (0, 1),
    progress: bool = False,
) -> None:
    """Brackets the errors of all ordered pairs of classes of local models, and writes them a shard at a time.

    Interrupted or killed, it loses the shards that are under way; called again, it goes on after those that are there.

    Args:
      folder: made if it is missing. What is in it has to be of the same model, options and shard_size.
      table: of the model. What it knows is used; it does not grow, so memory holds one shard.
      tolerance: as in `local_similarity`.
      method: likewise.
      max_iterations: likewise.
      shard_size: pairs of a file.
      part: (k, n): only every n-th shard from the k-th on, so that n processes or jobs, wherever they run, share a
        folder and do all once; `(jax.process_index(), jax.process_count())`, say.
      progress: show progress bars.

    Raises:
      ValueError: if an option is out of range, the table's relation is a function, or the table is itself shared by
        processes.
      FileError: if the folder holds brackets of something else.
      OSError: if it cannot be written to.

    Outside jit, vmap and grad only.

    Example:
      >>> import tempfile, jaxhom
      >>> folder, grid = tempfile.mkdtemp(), jaxhom.gridworld(4)
      >>> save_all_brackets(folder, jaxhom.SimilarityTable(grid), shard_size=50)
      >>> found = load_all_brackets(folder, grid)
      >>> found.num_classes, found.num_shards, found.missing()
      (9, 2, [])
      >>> found.brackets([0, 5], [3, 6]).lower.round(2).tolist()  # two corners; a cell in the middle and its neighbour
      [0.7, 0.0]
    """
    checks.require_count("shard_size", shard_size)
    number, count = _validated_part(part)
    if table.across_processes and jax.process_count() > 1:
        raise ValueError("the table is shared by processes: give each a table of its own, and a part of the shards")
    asked: dict[str, Any] = {"tolerance": tolerance, "method": method, "max_iterations": max_iterations}
    nothing = np.zeros(0, int)
    table.brackets(nothing, nothing, **asked)  # checks them before anything is written
    os.makedirs(folder, exist_ok=True)
    found = _begin(folder, table, {**asked, "shard_size": shard_size})
    todo = [shard for shard in found.missing() if shard % count == number]
    for shard in tqdm(todo, desc="shards", unit="shard", leave=False, disable=not progress):
        sources, targets = found.representative[found.pairs_of(shard)].T
        bounds = dict(table.brackets(sources, targets, **asked, keep=False, progress=progress))
        rows = np.empty(len(sources), found.row_type)
        for name, leaf in bounds.items():
            rows[name] = leaf
        with whole_file(found.path_of(shard)) as file:
            np.save(file, rows, allow_pickle=False)


class AllBrackets:
    """Brackets of all ordered pairs of classes, in a folder; see `load_all_brackets`.

    Attributes:
      num_classes: C.
      class_of_state: int [S], classes numbered by their first states.
      representative: int [C], these.
      num_shards: how many files there are when all are there.
    """

    def __init__(self, folder: str | os.PathLike, mdp: MDP):
        self._folder, self._mdp = os.fspath(folder), as_model(mdp)
        path = os.path.join(self._folder, _ABOUT)
        about = read_archive(path)
        require_arrays(path, about, "transitions", "class_of_state", "representative", "shard_size")
        if not np.array_equal(about["transitions"], transitions_digest(self._mdp)):
            raise FileError(f"{path}: brackets of another model: transitions, allowed actions or number types differ")
        try:
            states = self._mdp.num_states
            self.representative = checks.require_integers("representative", about["representative"], upper=states)
            self.num_classes = len(self.representative)
            own = checks.require_integers("class_of_state", about["class_of_state"], upper=self.num_classes)
            checks.require_shape("class_of_state", own, f"({states},)", own.shape == (states,))
            self.class_of_state, self._size = own, checks.require_count("shard_size", about["shard_size"].tolist())
        except (TypeError, ValueError) as error:
            raise FileError(f"{path}: {error}") from None
        self.num_shards = -(-(self.num_classes**2) // self._size)
        kinds = {"lower": self._mdp.dtype, "upper": self._mdp.dtype, "iterations": np.int32, "status": np.int32}
        self.row_type = np.dtype(list(kinds.items()))

    def __repr__(self) -> str:
        there = self.num_shards - len(self.missing())
        return f"AllBrackets({self.num_classes} classes; {there} of {self.num_shards} shards)"

    def missing(self) -> list[int]:
        """The numbers of the shards that are not there yet."""
        names = set(os.listdir(self._folder))
        return [shard for shard in range(self.num_shards) if os.path.basename(self.path_of(shard)) not in names]

    def brackets(self, sources: Int[ArrayLike, " P"], targets: Int[ArrayLike, " P"]) -> LocalSimilarity:
        """Brackets of the errors from states [P] to states [P]; of the shards only what is asked for is read.

        Raises:
          ValueError: if a state is out of range.
          FileError: if a shard is not there, or damaged.
        """
        source = self.class_of_state[check_states(self._mdp, sources, "sources")]
        target = self.class_of_state[check_states(self._mdp, targets, "targets")]
        checks.require_shape("targets", target, str(source.shape), len(source) == len(target))
        shard, row = np.divmod(source * self.num_classes + target, self._size)
        result = np.empty(len(shard), self.row_type)
        for number in np.unique(shard).tolist():
            of_shard = shard == number
            result[of_shard] = self._rows(number)[row[of_shard]]
        return _bounds_of(result)

    def shards(self) -> Iterator[tuple[Int[np.ndarray, "Q 2"], LocalSimilarity]]:
        """The pairs of classes of one shard after the other, and their brackets.

        Raises:
          FileError: when it comes to one that is not there, or damaged.
        """
        for shard in range(self.num_shards):
            yield self.pairs_of(shard), _bounds_of(self._rows(shard))

    def pairs_of(self, shard: int) -> Int[np.ndarray, "Q 2"]:
        """The pairs of classes of a shard."""
        end = min((shard + 1) * self._size, self.num_classes**2)
        return np.stack(np.divmod(np.arange(shard * self._size, end), self.num_classes), axis=1)

    def path_of(self, shard: int) -> str:
        """The file of a shard."""
        return os.path.join(self._folder, f"brackets-{shard:06d}.npy")

    def _rows(self, shard: int) -> np.ndarray:
        path = self.path_of(shard)
        try:
            rows = np.load(path, mmap_mode="r", allow_pickle=False)
        except FileNotFoundError:
            raise FileError(f"{path}: not made yet; save_all_brackets goes on with what is missing") from None
        except (OSError, ValueError, EOFError) as error:
            raise FileError(f"{path}: not a readable .npy file ({readable_reason(error)})") from None
        expected = len(self.pairs_of(shard))
        if not isinstance(rows, np.ndarray) or rows.dtype != self.row_type or rows.shape != (expected,):
            raise FileError(f"{path}: not the brackets of {expected} pairs as {self.row_type}")
        return rows


def load_all_brackets(folder: str | os.PathLike, mdp: MDP) -> AllBrackets:
    """Opens what `save_all_brackets` has written so far.

    Args:
      folder: with shards in it, all of them or not.
      mdp: the model that they are of.

    Returns:
      `AllBrackets`, which reads what it is asked for.

    Raises:
      FileError: if nothing of the kind is there, or it is of another model.

    Outside jit, vmap and grad only.

    Example: see `save_all_brackets`.
    """
    return AllBrackets(folder, mdp)


def _validated_part(part: tuple[int, int]) -> tuple[int, int]:
    """(k, n) with 0 <= k < n."""
    if not isinstance(part, tuple | list) or len(part) != 2:
        raise ValueError(f"part must be (k, n), got {checks.in_one_line(part)}")
    number, count = checks.require_count("part[0]", part[0], least=0), checks.require_count("part[1]", part[1])
    if number >= count:
        raise ValueError(f"part must be (k, n) with k below n, got {tuple(part)}")
    return number, count


def _begin(folder: str | os.PathLike, table: SimilarityTable, options: dict) -> AllBrackets:
    """Writes down what the brackets are of, or compares it with what is written there."""
    label = table.classes()
    _, first, where = np.unique(label, return_index=True, return_inverse=True)
    order = np.argsort(first)  # the numbers of a table depend on what it was asked before
    about = {name: array for name, array in table.contents().items() if name in HEADING}
    about |= {name: np.asarray(value) for name, value in options.items()}
    about |= {"class_of_state": np.argsort(order)[where], "representative": first[order]}
    path = os.path.join(folder, _ABOUT)
    if not os.path.exists(path):
        write_archive(path, about)
    there = read_archive(path)
    for name in sorted(about.keys() | there.keys()):
        if not np.array_equal(about.get(name, np.nan), there.get(name, np.nan)):
            raise FileError(f"{path}: brackets of something else: another {name}; take another folder")
    return AllBrackets(folder, table.mdp)


def _bounds_of(rows: np.ndarray) -> LocalSimilarity:
    return LocalSimilarity(**{name: np.array(rows[name]) for name in rows.dtype.names or ()})
