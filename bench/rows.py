"""Raw rows: one per setting, method and draw, in an append-only CSV file that survives being stopped anywhere.

Every row carries what made it: seed, commit, versions, dtype, seconds, solver status and certificate. A batch of rows
is written in one piece and flushed to the disk; a line that a kill cut short is dropped when the file is next opened.
If a row is computed again, the later one counts.
"""

import csv
import dataclasses
import functools
import io
import os
import pathlib
import platform
import subprocess
from collections.abc import Iterable
from importlib import metadata

import jaxhom

ROOT = pathlib.Path(__file__).resolve().parent.parent


@dataclasses.dataclass(frozen=True)
class Row:
    """One draw of one setting and method.

    Attributes:
      domain: "grid16", "track_a" and the like. regions: K of a gridworld, 0 on tracks.
      demonstrations, length: number of trajectories and their steps. trial: steps of a trial at most.
      distance, threshold: d and epsilon of Algorithm 1. samples: transitions per state and action from which the
        learner's model was estimated; 0 for the true model.
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


KEY = tuple(field.name for field in dataclasses.fields(Row))[: 1 + list(Row.__annotations__).index("seed")]
COLUMNS = tuple(field.name for field in dataclasses.fields(Row))
_TYPES = {field.name: field.type for field in dataclasses.fields(Row)}


class RowFile:
    """The rows of one sweep.

    Raises:
      ValueError: if the file is not one of this module's.
    """

    def __init__(self, path: pathlib.Path):
        self.path = pathlib.Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists() or not _drop_partial_line(self.path):
            self._write([COLUMNS])
        self._check_header()

    def append(self, rows: Iterable[Row]) -> None:
        """Writes rows in one piece, and has the disk hold them before it returns."""
        self._write([[_to_text(name, getattr(row, name)) for name in COLUMNS] for row in rows])

    def read(self) -> list[Row]:
        """The rows, the latest of each key."""
        return read_rows(self.path)

    def _check_header(self) -> None:
        with self.path.open(newline="") as file:
            header = next(csv.reader(file))
        if tuple(header) != COLUMNS:
            raise ValueError(f"{self.path} has other columns than this version writes: move it away to start anew")

    def _write(self, lines: Iterable[Iterable[str]]) -> None:
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows(lines)
        with self.path.open("a", newline="") as file:
            file.write(text.getvalue())
            file.flush()
            os.fsync(file.fileno())


def read_rows(path: pathlib.Path) -> list[Row]:
    """The rows of a file, the latest of each key, without changing it; a line cut short is left out."""
    text = pathlib.Path(path).read_text()
    lines = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))
    rows = (Row(**{name: _from_text(_TYPES[name], text) for name, text in line.items()}) for line in lines)
    return list({row.key: row for row in rows}.values())


@functools.cache
def provenance() -> dict[str, str]:
    """The columns `commit` and `versions`."""
    packages = ("jax", "jaxlib", "numpy", "scipy")
    versions = [f"jaxhom {jaxhom.__version__}"] + [f"{name} {metadata.version(name)}" for name in packages]
    versions.append(f"python {platform.python_version()} {platform.machine()}")
    return {"commit": _commit(), "versions": "; ".join(versions)}


def _commit() -> str:
    """The commit of the checkout, with "+" if the code differs from it; empty outside a checkout."""

    def git(*arguments):
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", "jaxhom", "bench", ":!bench/results")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _drop_partial_line(path: pathlib.Path) -> bool:
    """Cuts off what follows the last line break; returns whether anything is left."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)
    return whole > 0


def _to_text(name: str, value) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return repr(value) if name in KEY else format(value, ".10g")  # keys are to come back as they were
    return " ".join(str(value).split())  # one line


def _from_text(kind, text: str):
    if kind is str:
        return text
    if kind is int:
        return int(text)
    if kind is float:
        return float(text)
    return None if text == "" else (int(text) if kind == int | None else float(text))
