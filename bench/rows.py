"""Raw rows: one per setting, method and draw, in an append-only CSV file that survives being stopped anywhere.

Every row carries what made it: seed, commit, versions, dtype, seconds, solver status and certificate. A batch of rows
is written in one piece and flushed to the disk; a line that a kill cut short is dropped when the file is next opened.
If a row is computed again, the later one counts.
"""

import csv
import dataclasses
import io
import os
import pathlib
from collections.abc import Iterable


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


class RowFile:
    """The rows of one sweep.

    Raises:
      ValueError: if the file is not one of this module's.
    """

    def __init__(self, path: pathlib.Path):
        self.path = pathlib.Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole, header = _whole_lines(self.path), ",".join(COLUMNS) + "\n"
        if not whole:
            self.path.write_text(header)
        elif not whole.startswith(header):
            raise ValueError(f"{self.path} has other columns than this version writes: move it away to start anew")
        else:
            os.truncate(self.path, len(whole.encode()))

    def append(self, rows: Iterable[Row]) -> None:
        """Writes rows in one piece, and has the disk hold them before it returns."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([[_to_text(name, getattr(row, name)) for name in COLUMNS] for row in rows])
        with self.path.open("a", newline="") as file:
            file.write(text.getvalue())
            file.flush()
            os.fsync(file.fileno())

    def read(self) -> list[Row]:
        """The rows, the latest of each key."""
        return read_rows(self.path)


def read_rows(path: pathlib.Path) -> list[Row]:
    """The rows of a file, the latest of each key, without changing it; a line cut short is left out."""
    rows = {}
    for line in csv.DictReader(io.StringIO(_whole_lines(pathlib.Path(path)), newline="")):
        kinds = ((field.name, _READ[field.type], field.type is str) for field in _FIELDS)
        row = Row(**{name: read(line[name]) if line[name] or is_text else None for name, read, is_text in kinds})
        rows[row.key] = row
    return list(rows.values())


def _whole_lines(path: pathlib.Path) -> str:
    """What a file holds up to its last line break."""
    text = path.read_bytes().decode() if path.exists() else ""
    return text[: text.rfind("\n") + 1]


def _to_text(name: str, value) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return repr(value) if name in KEY else format(value, ".10g")  # keys are to come back as they were
    return " ".join(str(value).split())  # one line
