"""Tables of similarities in `.npz` files: what was solved once, another process goes on from.

transitions      uint8 [32], a digest of the model: a table for another one is refused
relation         its name; distance, anchored and labels [S, A, L] (optional), as in `SimilarityTable`
class_of_state   integers [S], -1 where a state was not met
representative   integers [C], the state whose local model stands for each class; class_key, what it is told by
pairs            integers [Q, 2], of classes
lower, upper     [Q], bounds on their errors; iterations and status, how they were found
tried            integers [Q, 4], iterations that left a pair open: of decisions, and of brackets by each method
renamed_pairs    integers [R, 2], of the relation "lax", and renaming [R], which permutation was chosen
"""

from __future__ import annotations

import os

from jaxhom.interop.archives import errors_of, read_archive, write_archive
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.similarity.table import SimilarityTable


def save_similarity(path: str | os.PathLike, table: SimilarityTable) -> None:
    """Writes all that a table knows of errors; maps, which are made for explanations, are not among it.

    Args:
      path: the file; what was there is replaced once all is written.
      table: also one whose work was interrupted. Of one that processes share, let one of them write.

    Raises:
      ValueError: if the table's relation is a function.
      OSError: if the file cannot be written.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path, grid = pathlib.Path(tempfile.mkdtemp(), "table.npz"), jaxhom.gridworld(4)
      >>> save_similarity(path, jaxhom.SimilarityTable(grid).complete(threshold=0.2))
      >>> load_similarity(path, grid).complete(threshold=0.2).num_solved
      0
    """
    write_archive(path, table.contents(), is_compressed=False)


def load_similarity(path: str | os.PathLike, mdp: MDP, *, across_processes: bool = False) -> SimilarityTable:
    """Reads a table that `save_similarity` wrote; it solves nothing again, and decides as the other did.

    Args:
      path: the file.
      mdp: the model that the table was made for; rewards, features and discount do not matter.
      across_processes: as in `SimilarityTable`; all processes have to read the same.

    Raises:
      FileError: if the file is missing, damaged, of another kind or of another model.

    Outside jit, vmap and grad only.

    Example: see `save_similarity`.
    """
    model = as_model(mdp)
    with errors_of(path):
        return SimilarityTable.restored(model, read_archive(path), across_processes=across_processes)
