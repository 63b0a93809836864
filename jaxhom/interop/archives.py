"""Archives of plain arrays, `.npz` files: written as a whole or not at all, and read without pickles.

Whatever is wrong with a file is one `FileError` that names it and the array.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Collection, Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np

from jaxhom import checks

FORMAT_VERSION = 1


class FileError(ValueError):
    """A file that cannot be read as what it should be; the message is one line that names it."""


@contextlib.contextmanager
def errors_of(path: str | os.PathLike) -> Iterator[None]:
    """Within it whatever is wrong with a file's contents, a `ValueError`, becomes a `FileError` that names the file."""
    try:
        yield
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None


@contextlib.contextmanager
def whole_file(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """A file to write bytes to that is `path` once all is written: an interrupted write leaves no half of it there.

    Raises:
      OSError: if the file cannot be written.
    """
    partial = f"{os.fspath(path)}.{secrets.token_hex(4)}.partial"  # others may be writing it too
    try:
        with open(partial, "wb") as file:
            yield file
        os.replace(partial, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.remove(partial)
        if isinstance(error, OSError) and error.filename == partial:
            error.filename = os.fspath(path)
        raise


def write_archive(path: str | os.PathLike, arrays: Mapping[str, np.ndarray], *, is_compressed: bool = True) -> None:
    """Writes arrays by name; a million random numbers take a second longer if compressed, and are hardly smaller.

    Raises:
      OSError: if the file cannot be written.
    """
    with whole_file(path) as file:
        named: dict[str, Any] = {"format_version": FORMAT_VERSION, **arrays}
        (np.savez_compressed if is_compressed else np.savez)(file, **named)


def read_archive(path: str | os.PathLike, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """All arrays of an archive, or those of the given names that it holds; `FileError` where there is none."""
    arrays = {}
    with _archive(path) as archive:
        for name in archive.files:
            if names is None or name in names or name == "format_version":
                arrays[name] = _array(path, archive, name)
    _require_version(path, arrays.pop("format_version", np.asarray(FORMAT_VERSION)))
    return arrays


def names_of_arrays(path: str | os.PathLike) -> list[str]:
    """The names of all arrays in an archive.

    Raises:
      FileError: as `load_arrays`.
    """
    with _archive(path) as archive:
        return list(archive.files)


def require_arrays(path: str | os.PathLike, arrays: Mapping[str, np.ndarray], *names: str) -> None:
    """Raises `FileError`, saying what there is, if one of the named arrays is not among those of an archive."""
    for name in names:
        if name not in arrays:
            present = ", ".join(sorted(arrays)) or "nothing"
            raise FileError(f"{path}: array {name!r} is missing (it holds {present})")


@contextlib.contextmanager
def _archive(path: str | os.PathLike) -> Iterator[np.lib.npyio.NpzFile]:
    """An archive that is open within the block; what is wrong with it is a `FileError`."""
    try:
        with open(path, "rb") as file:
            archive = np.load(file, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise FileError(f"{path}: one array, not an .npz archive of named arrays")
            yield archive
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except FileError:
        raise
    except Exception as error:  # of damaged headers NumPy and the standard library raise what they come upon
        raise FileError(f"{path}: not a readable .npz archive ({readable_reason(error)})") from None


def readable_reason(error: Exception) -> str:
    """Why NumPy does not read a file; what is no file of NumPy's at all it takes for a pickle, and names a remedy."""
    return "it is no file of NumPy's" if "pickle" in str(error) else checks.first_line(error)


def _array(path: str | os.PathLike, archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        array = archive[name]
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        remedy = "a pickle can run any code, so it is not opened: save plain arrays"
        raise FileError(f"{path}: {name!r} holds pickled Python objects; {remedy}") from None
    if not isinstance(array, np.ndarray):
        raise FileError(f"{path}: {name!r} is not a NumPy array")
    return array


def _require_version(path: str | os.PathLike, version: np.ndarray) -> None:
    if version.shape != () or version.dtype.kind not in "iu" or version < 1:
        raise FileError(f"{path}: format_version must be a whole number from 1 on, got {version.tolist()}")
    if version > FORMAT_VERSION:
        raise FileError(f"{path}: written in format {version}, this release reads up to {FORMAT_VERSION}")
