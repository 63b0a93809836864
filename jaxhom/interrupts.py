"""Ctrl-C and closed pipes, for the command line: one line, exit code 130, whatever was going on.

`python -m jaxhom` imports the package, JAX included, before it runs anything of `__main__`, and threads may be inside
compiled programs when it ends. So the signal is taken over as the first thing of all, a further Ctrl-C changes nothing,
and an interrupted process leaves without tearing the interpreter down under those threads.
"""

import contextlib
import os
import signal
import sys
from typing import Any, NoReturn, TextIO

INTERRUPTED = 130
_AGAIN = 3.0  # seconds after which an interruption that somebody swallowed is raised again
_SOON = 0.02  # seconds until what could not be raised is raised again
_happened = False


def watch_while_loading() -> None:
    """Ends the process with one line at Ctrl-C, if it is `python -m jaxhom` and its libraries are being loaded."""
    is_module = sys.argv[:1] == ["-m"] and "-m" in sys.orig_argv  # as long as it is looked for
    is_loading = is_module and sys.orig_argv[sys.orig_argv.index("-m") + 1 :][:1] == ["jaxhom"]
    if is_loading and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave_at_once)


def watch() -> None:
    """Raises `KeyboardInterrupt` at the first Ctrl-C, and again some seconds later until `rest`; ignores the others.

    A parent that ignores the signal (`nohup`, a job in the background) has decided that there is nothing to watch.
    """
    global _happened
    _happened = False
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        sys.unraisablehook = _unraisable
        signal.signal(signal.SIGINT, _raise_once)


def is_interruption(error: BaseException) -> bool:
    """Whether an exception is Ctrl-C's, or what became of it on its way through compiled programs and callbacks."""
    return _happened or isinstance(error, KeyboardInterrupt)


def rest() -> None:
    """No further interruptions: somebody is dealing with the first."""
    if hasattr(signal, "setitimer") and signal.getsignal(signal.SIGALRM) is _raise_again:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def say(*details: object) -> int:
    """Says in one line of stderr that the process was interrupted; the exit code for it."""
    rest()
    print("; ".join(["jaxhom: interrupted", *map(str, details)]), file=sys.stderr)
    return INTERRUPTED


def leave(code: int) -> NoReturn:
    """Ends the process; at once if it was interrupted."""
    if signal.getsignal(signal.SIGINT) is _raise_once:  # everything is done and told
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    if code == INTERRUPTED:
        os._exit(code)
    sys.exit(code)


class UntilClosed:
    """A text stream that is written to until nobody reads it any more (`| head`), and never complains."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes, or does nothing."""
        with contextlib.suppress(BrokenPipeError):
            return self._stream.write(text)
        return self._to_nowhere(len(text))

    def flush(self) -> None:
        """Likewise."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._to_nowhere(0)

    def _to_nowhere(self, written: int) -> int:
        # What is left in the buffer would raise once more when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _leave_at_once(*_) -> None:
    os.write(2, b"jaxhom: interrupted\n")
    os._exit(INTERRUPTED)


def _raise_once(*_) -> None:
    global _happened
    _happened = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "setitimer"):  # not on Windows
        signal.signal(signal.SIGALRM, _raise_again)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
    raise KeyboardInterrupt


def _raise_again(*_) -> None:
    raise KeyboardInterrupt


def _unraisable(unraisable) -> None:
    """An interruption that came while an object was deleted cannot be raised there: soon again, and not a word."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
    elif hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, _SOON, _AGAIN)
