"""Demonstrations from wherever they are kept: one door to files, saved data sets, tables and objects of many kinds.

What a file is, its first bytes say, or else the end of its name. Nothing is ever unpickled: a pickle can run any code
on the machine that reads it. What other libraries save is read by `saved_tables`.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of, names_of_arrays
from jaxhom.interop.column_names import KNOWN, fields_by_role, find_columns, is_keyed, listed, plain
from jaxhom.interop.csv_steps import demonstrations_from_csv
from jaxhom.interop.files import DEMONSTRATIONS, load_arrays, load_demonstrations
from jaxhom.interop.flat_steps import demonstrations_of_table
from jaxhom.interop.import_reports import ImportReport
from jaxhom.interop.saved_tables import Columns, arrow_columns, hdf5_columns, parquet_columns
from jaxhom.interop.trajectories import read_episodes
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP

_OLD = ("obs", "acts", "indices")  # of `imitation`'s archives of old
_PICKLED = (
    "a pickle, which can run any code when it is read, so it is not opened: where you trust it, load it yourself and "
    "pass what it holds to demonstrations_from"
)


def demonstrations_from(
    source: Any,
    *,
    mdp: MDP | None = None,
    columns: Mapping[str, str] | None = None,
    to_states: Callable[[Any], Any] | None = None,
    ambiguous: str = "hide",
) -> tuple[Demonstrations, ImportReport]:
    """Reads trajectories from a file, a folder or an object.

    Files and folders:

    * text with a step a line, see `demonstrations_from_csv`;
    * `.npz` archives: this library's (`save_demonstrations`), `imitation`'s of old, Stable-Baselines' of experts, and
      others with a step or an episode a row;
    * folders of `imitation` and of Hugging Face's `datasets` (`save_to_disk`), `.arrow` and `.parquet` files (these
      need `pyarrow`); folders of Minari and HDF5 files, D4RL's among them (these need `h5py`).

    Objects: episodes (see `demonstrations_from_episodes`), `datasets` and dictionaries of their splits, of which
    "train" is read, and tables: a data frame, a dictionary as D4RL's, `imitation`'s transitions, a buffer of
    Stable-Baselines3. A table has a row per step, or per episode, and its columns go by their usual names, as in
    `demonstrations_from_csv`; fields may be texts of what they mean, `"[0, 3, 1]"`. Without a column of actions, a
    table with a row per step is one of states alone.

    Args:
      source: a path or an object.
      mdp: a model in which every state and action must exist; by its names for them, if it has some.
      columns: what a column is called that goes by none of the usual names, by its role: `{"state": "position"}`.
      to_states: as in `demonstrations_from_episodes`.
      ambiguous: of states alone, as in `demonstrations_from_states`.

    Returns:
      The demonstrations and the report.

    Raises:
      FileError: naming the file, if it cannot be read, is a pickle, or holds no trajectories.
      ValueError: as `demonstrations_from_episodes`; naming the column or the rows of a table that cannot be used.
      ImportError: if an optional library is missing.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> d4rl = {"observations": [0, 1, 4, 0], "actions": [1, 1, 0, 1], "rewards": [0, 0, 1, 0]}
      >>> d4rl |= {"terminals": [False, False, True, False], "timeouts": [False, False, False, True]}
      >>> demonstrations, report = demonstrations_from(d4rl)
      >>> print(report)
      2 episodes, 4 steps; 0 final observations
      not read: rewards
    """
    options = {"mdp": mdp, "columns": columns, "to_states": to_states, "ambiguous": ambiguous}
    if not isinstance(source, str | os.PathLike):
        return _from_object(source, options)
    with errors_of(source):
        try:
            return _from_path(pathlib.Path(source), options)
        except FileNotFoundError:
            raise FileError(f"{source}: no such file") from None
        except OSError as error:
            raise FileError(f"{source}: {error.strerror or error}") from None


def _from_object(source: Any, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    """What an object holds: a table by its columns, and whatever else episode by episode."""
    if isinstance(source, Mapping) and source and all(hasattr(split, "column_names") for split in source.values()):
        source = source[_split(list(source))]
    if hasattr(source, "column_names") and not isinstance(source, Mapping):  # a data set of `datasets`
        source = {name: list(source[name]) for name in source.column_names}
    has_episodes = isinstance(source, list | tuple) or callable(getattr(source, "iterate_episodes", None))
    if not has_episodes and "state" in fields_by_role(source, options["columns"]):
        return _from_table(source, list(source) if is_keyed(source) else (), options)
    only = {name: options[name] for name in ("mdp", "columns", "to_states")}
    return read_episodes(source, **only)


def _from_table(table: Any, names: Iterable[object], options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    """The demonstrations of a table, and what else it has among the given names as not read."""
    demonstrations, report = demonstrations_of_table(table, **options)
    texts = list(map(str, names))
    used = find_columns(texts, options["columns"]).values()
    unread = tuple(name for place, name in enumerate(texts) if place not in used)
    return demonstrations, dataclasses.replace(report, unread=unread)


def _split(names: list[str]) -> str:
    """The split of a data set that is read: the only one, or "train"."""
    if "train" in names or len(names) == 1:
        return names[0] if len(names) == 1 else "train"
    raise ValueError(f"several splits, {listed(names)}, and none is called 'train': pass one of them")


def _from_path(path: pathlib.Path, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    if path.is_dir():
        return _from_folder(path, options)
    with open(path, "rb") as file:
        begin = file.read(8)
    kind = path.suffix.lower()
    if kind in _PICKLES or (begin[:1] == b"\x80" and begin[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05")):
        raise FileError(f"{path}: {_PICKLED}")
    for magic, (kinds, read) in _READERS.items():
        if begin.startswith(magic) or kind in kinds:
            return read(path, options)
    return demonstrations_from_csv(path, **options)


def _from_folder(path: pathlib.Path, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    """A data set that `datasets` saved, `imitation`'s among them, a dictionary of several, or Minari's."""
    if (path / "dataset_dict.json").is_file():
        splits = _json(path / "dataset_dict.json").get("splits")
        if not isinstance(splits, list) or not splits:
            raise FileError(f"{path / 'dataset_dict.json'}: names no splits")
        path = path / _split(list(map(str, splits)))
        if not path.is_dir():
            raise FileError(f"{path}: no such folder")
    if (path / "state.json").is_file():
        files = _json(path / "state.json").get("_data_files")
        try:
            paths = [path / file["filename"] for file in files or ()]
        except (TypeError, KeyError):
            paths = []
        if not paths:
            raise FileError(f"{path / 'state.json'}: names no data files")
        return _from_columns(arrow_columns(paths, _is_wanted(options)), options)
    for recording in (path / "data" / "main_data.hdf5", path / "main_data.hdf5"):
        if recording.is_file():
            return _of_hdf5(recording, options)
    raise FileError(f"{path}: a folder, but not one that imitation, datasets or Minari (in HDF5) saves a data set in")


def _json(path: pathlib.Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        raise FileError(f"{path}: not a readable JSON file") from None
    return content if isinstance(content, dict) else {}


def _from_archive(path: pathlib.Path, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    """An .npz archive: this library's, `imitation`'s of old, or a table."""
    names = names_of_arrays(path)
    roles = find_columns(names, options["columns"])
    needed = {"state"} if options["mdp"] is not None else {"state", "action"}
    if {"states", "actions"} <= set(names) <= {*DEMONSTRATIONS, "format_version"} or not needed <= set(roles):
        return _own(load_demonstrations(path), options["mdp"])
    if set(_OLD) <= set(names):
        arrays = load_arrays(path, *_OLD)
        demonstrations, report = _cut_at_indices(arrays, options)
        return demonstrations, dataclasses.replace(report, unread=tuple(n for n in names if n not in _OLD))
    arrays = load_arrays(path, *(names[place] for place in roles.values()))
    return _from_table(arrays, names, options)


def _own(demonstrations: Demonstrations, mdp: MDP | None) -> tuple[Demonstrations, ImportReport]:
    """Demonstrations that this library wrote, and the report of them."""
    if mdp is not None:
        demonstrations.validate(mdp, "ignore")
    steps, known = np.asarray(demonstrations.mask).sum(), np.asarray(demonstrations.final_states) >= 0
    report = ImportReport(len(demonstrations), int(steps), int(known.sum()), dropped=())
    return demonstrations, report


def _cut_at_indices(arrays: dict[str, np.ndarray], options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    """`imitation`'s archives of old: all actions in a row, and all observations, of which episodes have one more.

    Whether a time limit ended an episode stands in pickled `infos`, so none counts as terminated.
    """
    states, actions, indices = (arrays[name] for name in _OLD)
    indices = checks.require_integers("indices", indices, 2**31)
    count = indices.size + 1
    if indices.ndim != 1 or states.ndim < 1 or actions.ndim < 1 or len(states) != len(actions) + count:
        shapes = f"{states.shape}, {actions.shape} and {indices.shape}"
        raise ValueError(f"observations, actions and indices must be as many as {count} episodes need, got {shapes}")
    ends = np.append(indices, len(actions))
    if (np.diff(ends, prepend=0) < 0).any():
        raise ValueError(f"indices must ascend up to the number of actions, {len(actions)}")
    episodes = zip(np.split(states, indices + np.arange(1, count)), np.split(actions, indices), strict=True)
    return read_episodes(
        [{"state": states, "action": actions} for states, actions in episodes],
        mdp=options["mdp"],
        to_states=options["to_states"],
    )


def _from_columns(read: Columns | list[dict[str, Any]], options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    """What another library saved: columns, or episodes."""
    if isinstance(read, Columns):
        return _from_table(read.columns, read.names, options)
    return _from_object(read, options)


def _is_wanted(options: dict[str, Any]) -> Callable[[str], bool]:
    """Whether a column of a given name has a role; `infos` are those of `imitation`, which tell a time limit."""
    given = {"infos", *map(plain, (options["columns"] or {}).values())}
    return lambda name: plain(name) in KNOWN | given


def _of_arrow(path: pathlib.Path, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    return _from_columns(arrow_columns([path], _is_wanted(options)), options)


def _of_parquet(path: pathlib.Path, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    return _from_columns(parquet_columns(path, _is_wanted(options)), options)


def _of_hdf5(path: pathlib.Path, options: dict[str, Any]) -> tuple[Demonstrations, ImportReport]:
    return _from_columns(hdf5_columns(path, _is_wanted(options)), options)


_Reader = Callable[[pathlib.Path, dict[str, Any]], tuple[Demonstrations, ImportReport]]
# By their first bytes, and by the ends of their names, so that damaged files are called by their kind.
_READERS: Mapping[bytes, tuple[tuple[str, ...], _Reader]] = {
    b"PK\x03\x04": ((".npz",), _from_archive),
    b"\x93NUMPY": ((".npy",), _from_archive),
    b"PAR1": ((".parquet",), _of_parquet),
    b"ARROW1": ((".arrow", ".feather"), _of_arrow),
    b"\xff\xff\xff\xff": ((), _of_arrow),
    b"\x89HDF\r\n\x1a\n": ((".hdf5", ".h5"), _of_hdf5),
}
_PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".joblib")
