"""Columns of tables that other libraries save: Arrow and Parquet by `pyarrow`, HDF5 by `h5py`, imported when needed.

Only the columns that are asked for are read. What cannot be read is one `FileError`; a library that is missing is an
`ImportError` that names it.
"""

from __future__ import annotations

import importlib
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError


class Columns(NamedTuple):
    """Columns that were read, [T, ...] by name, and the names of all that there are."""

    columns: dict[str, np.ndarray]
    names: list[str]


def arrow_columns(paths: Sequence[pathlib.Path], is_wanted: Callable[[str], bool]) -> Columns:
    """Of Arrow files, streams as `datasets` saves them or with a footer, one after the other."""
    pyarrow, tables = _library("pyarrow", paths[0]), []
    for path in paths:
        try:
            with pyarrow.memory_map(str(path)) as file:
                has_footer = file.read(6) == b"ARROW1"
                file.seek(0)
                reader = pyarrow.ipc.open_file(file) if has_footer else pyarrow.ipc.open_stream(file)
                tables.append(reader.read_all())
        except FileNotFoundError:
            raise FileError(f"{path}: no such file") from None
        except (pyarrow.ArrowException, OSError) as error:
            raise FileError(f"{path}: not a readable Arrow file ({checks.first_line(error)})") from None
    return _columns(pyarrow.concat_tables(tables), is_wanted)


def parquet_columns(path: pathlib.Path, is_wanted: Callable[[str], bool]) -> Columns:
    """Of a Parquet file."""
    pyarrow = _library("pyarrow", path)
    try:
        table = _library("pyarrow.parquet", path).read_table(str(path))
    except (pyarrow.ArrowException, OSError) as error:
        raise FileError(f"{path}: not a readable Parquet file ({checks.first_line(error)})") from None
    return _columns(table, is_wanted)


def hdf5_columns(path: pathlib.Path, is_wanted: Callable[[str], bool]) -> Columns | list[dict[str, Any]]:
    """Of an HDF5 file with a data set per column, as D4RL's; or its episodes, a group each, as Minari's."""
    h5py = _library("h5py", path)
    try:
        with h5py.File(path) as file:
            episodes = [name for name in file if re.fullmatch(r"episode_\d+", name)]
            if episodes:
                ordered = sorted(episodes, key=lambda name: int(name.rpartition("_")[2]))
                return [_group(file[name], is_wanted) for name in ordered]
            return Columns(_group(file, is_wanted), list(file))
    except OSError as error:
        raise FileError(f"{path}: not a readable HDF5 file ({checks.first_line(error)})") from None


def _group(group: Any, is_wanted: Callable[[str], bool]) -> dict[str, Any]:
    """The fields of a group; a field may be a group in turn, such as observations of several parts."""
    return {
        name: _group(field, lambda _: True) if hasattr(field, "items") else _values(field)
        for name, field in group.items()
        if is_wanted(name)
    }


def _values(dataset: Any) -> Any:
    """What a data set of an HDF5 file holds; texts are kept there as bytes."""
    is_text = importlib.import_module("h5py").check_string_dtype(dataset.dtype) is not None
    return dataset.asstr("utf-8", "replace")[()] if is_text else dataset[()]


def _columns(table: Any, is_wanted: Callable[[str], bool]) -> Columns:
    names = table.column_names
    return Columns({name: table.column(name).to_numpy() for name in names if is_wanted(name)}, names)


def _library(name: str, path: pathlib.Path) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        needed = name.partition(".")[0]
        raise ImportError(f"{path}: {needed} is needed to read it: pip install 'jaxhom[files]'") from None
