"""Text files that are only ever appended to, whole lines at a time, by one process, and survive being stopped anywhere.

What `write` was given is on the disk when it returns, or not in the file at all. A line that a kill cut short is
dropped when the file is next written to. The lock is the system's: it ends with the process that holds it.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
from collections.abc import Iterator

try:
    import fcntl
except ImportError:  # Windows, where two runs on one file are not kept apart
    fcntl = None  # type: ignore[assignment]


_HELD: set[int] = set()  # descriptors of locks


def _let_go() -> None:
    """In a process that was forked off, by a pool say: it would hold the locks, and may outlive its parent."""
    for descriptor in _HELD:
        os.close(descriptor)
    _HELD.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


class LineFile:
    """A file of lines, which need not exist yet."""

    def __init__(self, path: str | os.PathLike):
        self.path = pathlib.Path(path)

    def parts(self) -> tuple[str, str]:
        """What the file holds up to its last line break, and the rest, a line that was cut short.

        Raises:
          ValueError: if it is no text.
        """
        try:
            held = self.path.read_bytes() if self.path.exists() else b""
            end = held.rfind(b"\n") + 1
            return held[:end].decode(), held[end:].decode(errors="replace")
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"{self.path} cannot be read as text: {error}") from None

    def check_rest(self, rest: str) -> None:
        """Raises ValueError if what is about to be dropped is no line of ours that was cut short."""

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Within it this process alone appends; a line that was cut short is gone.

        Raises:
          ValueError: if another run is writing to the file, or nobody can.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise ValueError(f"{self.path} cannot be written to: {error.strerror}") from None
        try:
            _HELD.add(self._descriptor)
            self._lock()
            whole, rest = self.parts()
            self.check_rest(rest)
            os.ftruncate(self._descriptor, len(whole.encode()))
            yield
        finally:
            _HELD.discard(self._descriptor)
            os.close(self._descriptor)

    def write(self, text: str) -> None:
        """Writes whole lines in one piece, and has the disk hold them before it returns; within `writing` only."""
        before, left = os.fstat(self._descriptor).st_size, memoryview(text.encode())
        try:
            while left:
                left = left[os.write(self._descriptor, left) :]
        except BaseException:  # a full disk, Ctrl-C
            os.ftruncate(self._descriptor, before)
            raise
        os.fsync(self._descriptor)

    def _lock(self) -> None:
        if fcntl is not None:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(f"{self.path}: another run is writing to it; wait for it, or stop it") from None
