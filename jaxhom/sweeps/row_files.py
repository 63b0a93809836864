"""Rows as lines of JSON: columns may differ from case to case, and numbers come back as they were.

A line is an object: the columns of the case, those of its result, and

    error     why there is no result; null where there is one
    seconds   that `work` took, per case of its batch; null if its worker died
    time      when the row was written, in UTC
    host      name of the machine that did the work, x64: whether JAX computed in float64 there
    commit    of the checkout that `work` is in, with "+" if its Python files differ; "" outside a checkout
    versions  of what did the work
    case      the names of the case's columns

If a case was done again, its last line counts. NaN and infinities are written as Python and pandas read them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

from jaxhom.sweeps.cases import Case, Plain, key_of
from jaxhom.sweeps.line_files import LineFile

_END = ".jsonl"


class RowFile(LineFile):
    """The rows of a sweep.

    Raises:
      ValueError: if its name ends otherwise than in .jsonl, or what it holds are no rows.
    """

    def __init__(self, path: str | os.PathLike):
        super().__init__(path)
        if self.path.suffix != _END:
            raise ValueError(f"{self.path}: rows are lines of JSON, in files whose names end in {_END}")

    def rows(self) -> dict[str, dict[str, Any]]:
        """The last row of each case, by the case's key."""
        found = {}
        for number, line in enumerate(self.parts()[0].split("\n")[:-1], 1):
            try:
                row = json.loads(line)
                found[key_of({name: row[name] for name in row.pop("case")})] = row
            except (ValueError, TypeError, KeyError, AttributeError):
                raise ValueError(f"{self.path}, line {number} is no row of a sweep: {line[:80]!r}") from None
        return found

    def check_rest(self, rest: str) -> None:
        """Raises ValueError unless these are rows, and the rest the beginning of one."""
        self.rows()
        try:
            is_row = not rest or "case" in json.loads(rest)
        except (ValueError, TypeError):
            is_row = rest.startswith("{")
        if not is_row:
            raise ValueError(f"{self.path} ends in what is no row of a sweep: {rest[:80]!r}")

    def key(self, case: Case) -> str:
        """What `done` knows a case by."""
        return case.key

    def done(self, retry: bool) -> set[str]:
        """The cases that there is nothing more to do about."""
        return {key for key, row in self.rows().items() if not (retry and row.get("error") is not None)}

    def add(self, finished: Sequence[tuple[Case, Mapping[str, Plain]]]) -> None:
        """Writes rows: cases, and what was found."""
        lines = [{**case.columns, **found, "case": list(case.columns)} for case, found in finished]
        self.write("".join(json.dumps(line) + "\n" for line in lines))


def read(file: str | os.PathLike) -> list[dict[str, Any]]:
    """The rows of a sweep, the last one of each case; a line that a kill cut short is left out.

    `pandas.DataFrame(read(file))` is the table, and `pandas.read_json(file, lines=True)` the file as it stands.

    Args:
      file: as given to `run`; nobody need have stopped writing to it.

    Returns:
      Dicts of columns: the case's, the result's, and `error`, `seconds`, `time`, `host`, `x64`, `commit`, `versions`.

    Raises:
      ValueError: if the file is missing, or holds something else; it names the line.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile
      >>> from jaxhom import sweeps
      >>> file = pathlib.Path(tempfile.mkdtemp(), "squares.jsonl")
      >>> rows = sweeps.run(lambda case: {"square": case["x"] ** 2}, [{"x": 2}, {"x": 3}], file, progress=False)
      >>> [(row["x"], row["square"], row["error"]) for row in sweeps.read(file)]
      [(2, 4, None), (3, 9, None)]
    """
    rows = RowFile(file)
    if not rows.path.exists():
        raise ValueError(f"{rows.path} does not exist")
    return list(rows.rows().values())
