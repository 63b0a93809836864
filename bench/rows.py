"""Raw rows: one per setting, method and draw, in an append-only CSV file that survives being stopped anywhere.

Every row carries what made it: seed, commit, versions, dtype, seconds, solver status and certificate. A batch of rows
is written in one piece and flushed to the disk; a line that a kill cut short is dropped when the file is next written
to (`jaxhom.sweeps.line_files`). If a row is computed again, the later one counts.
"""

import csv
import dataclasses
import io
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from jaxhom.sweeps.cases import Case
from jaxhom.sweeps.line_files import LineFile


@dataclasses.dataclass(frozen=True)
class Row:
    """One draw of one setting and method.

    Attributes:
      domain to samples: see `settings.Setting`.
      method: name. draw: number of the reward and demonstrations. seed: of the sweep.
      reward_per_step, steps, off_roads, finished: exact; see `jaxhom.Evaluation`. Empty where they do not apply.
      expert_reward: the expert's reward per step in the same draw.
      sampled_reward, sampled_error: reward per step of 1000 trials, and its standard error.
      loss_bound: no policy is better by more, in discounted reward per step.
      status: how the solver ended, "none" where there is none (maximum entropy, say). certificate: LPAL's gap per step;
        for Algorithm 1 by how much the errors of accepted pairs may exceed epsilon; without a solver `loss_bound`.
      seconds: per draw, compilation included. batch: draws that were solved together.
      error: why there are no numbers.
    """

    domain: str
    regions: int
    demonstrations: int
    length: int
    trial: int
    distance: int
    threshold: float
    samples: int
    method: str
    draw: int
    seed: int
    reward_per_step: float | None = None
    expert_reward: float | None = None
    steps: float | None = None
    off_roads: float | None = None
    finished: float | None = None
    sampled_reward: float | None = None
    sampled_error: float | None = None
    loss_bound: float | None = None
    status: str = ""
    certificate: float | None = None
    seconds: float | None = None
    batch: int | None = None
    dtype: str = ""
    commit: str = ""
    versions: str = ""
    error: str = ""

    @property
    def key(self) -> tuple:
        """What tells rows apart."""
        return tuple(getattr(self, name) for name in KEY)


_FIELDS = dataclasses.fields(Row)
COLUMNS = tuple(field.name for field in _FIELDS)
KEY = tuple(field.name for field in _FIELDS if field.default is dataclasses.MISSING)
_READ = {str: str, int: int, float: float, int | None: int, float | None: float}


class RowFile(LineFile):
    """The rows of one sweep, which `jaxhom.sweeps` can write to.

    Raises:
      ValueError: if the file is not one of this module's, or another run is writing to it.
    """

    def __init__(self, path: pathlib.Path):
        super().__init__(path)
        with self.writing():
            whole, header = self.parts()[0], ",".join(COLUMNS) + "\n"
            if not whole:
                self.write(header)

    def check_rest(self, rest: str) -> None:
        """Raises ValueError if the file has other columns."""
        whole, header = self.parts()[0], ",".join(COLUMNS) + "\n"
        if not (whole or rest).startswith(header[: len(whole or rest)]):
            raise ValueError(f"{self.path} has other columns than this version writes: move it away to start anew")

    def append(self, rows: Iterable[Row]) -> None:
        """Writes rows in one piece, and has the disk hold them before it returns."""
        with self.writing():
            self._write_rows(rows)

    def _write_rows(self, rows: Iterable[Row]) -> None:
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([[_to_text(name, getattr(row, name)) for name in COLUMNS] for row in rows])
        self.write(text.getvalue())

    def read(self) -> list[Row]:
        """The rows, the latest of each key."""
        return read_rows(self.path)

    def key(self, case: Case) -> tuple:
        """What `done` knows a case by."""
        return tuple(case.columns[name] for name in KEY)

    def done(self, retry: bool) -> set[tuple]:
        """The cases that there is nothing more to do about."""
        return {row.key for row in self.read() if not (retry and row.error)}

    def add(self, finished: Sequence[tuple[Case, Mapping[str, Any]]]) -> None:
        """Writes rows: cases, and what was found."""
        known = [{**case.columns, **found} for case, found in finished]
        self._write_rows(Row(**{name: row[name] for name in COLUMNS if row.get(name) is not None}) for row in known)


def read_rows(path: pathlib.Path) -> list[Row]:
    """The rows of a file, the latest of each key, without changing it; a line cut short is left out."""
    rows = {}
    for line in csv.DictReader(io.StringIO(LineFile(path).parts()[0], newline="")):
        kinds = ((field.name, _READ[field.type], field.type is str) for field in _FIELDS)
        row = Row(**{name: read(line[name]) if line[name] or is_text else None for name, read, is_text in kinds})
        rows[row.key] = row
    return list(rows.values())


def _to_text(name: str, value) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return repr(value) if name in KEY else format(value, ".10g")  # keys are to come back as they were
    return " ".join(str(value).split())  # one line
