"""The file of `--table`: what was solved about pairs of local models, kept from one run to the next."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

from jaxhom import interrupts
from jaxhom.interop.similarity_files import load_similarity, save_similarity
from jaxhom.models.mdp import MDP
from jaxhom.similarity.given_table import table_for
from jaxhom.similarity.table import SimilarityTable


def open_table(path: str | None, mdp: MDP, **options: Any) -> SimilarityTable:
    """The table in a file, or a new one if there is none yet.

    Raises:
      ValueError: if the file holds no table, or one for another model or other options.
    """
    if path is None or not os.path.exists(path):
        return SimilarityTable(mdp, **options)
    table = load_similarity(path, mdp)
    try:
        return table_for(table, mdp, **options)
    except ValueError as error:
        raise ValueError(f"--table {path}: {error}") from None


@contextlib.contextmanager
def kept_table(path: str, table: SimilarityTable) -> Iterator[None]:
    """Around what fills a table: writes it at the end, however that comes.

    Raises:
      OSError: if the file cannot be written; before anything is solved if it is a new one.
    """
    if not os.path.exists(path):
        save_similarity(path, table)
    try:
        yield
        save_similarity(path, table)
    except BaseException:  # Ctrl-C, be it while the file was being written
        interrupts.rest()
        save_similarity(path, table)
        raise
