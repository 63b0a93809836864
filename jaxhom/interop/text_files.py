"""Text files as people keep them: plain or compressed by gzip, in UTF-8, with a byte order mark or without.

Whether a file is compressed is told by its first bytes, whatever its name. What is no text is one `FileError`.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import zlib
from collections.abc import Iterator, Mapping
from typing import TextIO

from jaxhom.interop.archives import FileError

_GZIP = b"\x1f\x8b"


@contextlib.contextmanager
def open_text(path: str | os.PathLike, *, newline: str | None = None) -> Iterator[TextIO]:
    """A text file to read from, decompressed where it is compressed; its errors are of one kind inside the block.

    Args:
      path: the file.
      newline: as of `open`; "" for the module `csv`.

    Raises:
      FileError: naming the file, if it is missing, truncated, damaged or no text in UTF-8; in the block, too, where
        the damage is reached only there.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "walks.csv.gz")
      >>> _ = path.write_bytes(gzip.compress(b"state,action"))
      >>> with open_text(path) as file:
      ...     file.read()
      'state,action'
    """
    try:
        with contextlib.ExitStack() as stack:
            raw = stack.enter_context(open(path, "rb"))
            is_compressed = raw.peek(len(_GZIP)).startswith(_GZIP)
            file = stack.enter_context(gzip.open(raw)) if is_compressed else raw
            if b"\0" in file.peek(1):
                raise FileError(f"{path}: not a text file in UTF-8 (it holds zero bytes)")
            yield stack.enter_context(io.TextIOWrapper(file, encoding="utf-8-sig", newline=newline))
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not a text file in UTF-8 ({error.reason})") from None
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise FileError(f"{path}: its compressed contents are damaged or cut off") from None
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from None


def require_letters(path: str | os.PathLike, line: int, text: str, letters: Mapping[str, object]) -> None:
    """Raises unless one line of a map is made of the letters."""
    for column, letter in enumerate(text, start=1):
        if letter not in letters:
            raise FileError(f"{path} line {line}, column {column}: no letter {letter!r} among {''.join(letters)}")


def without_gz(path: str | os.PathLike) -> str:
    """The path without the `.gz` that says that it is compressed: `walks.csv` of `walks.csv.gz`."""
    path = os.fspath(path)
    return path[:-3] if path.lower().endswith(".gz") else path
