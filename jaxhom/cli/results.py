"""Where results go: a folder, or a single policy file. Whatever has been written stays whole if a run is interrupted.

OUTPUT/demonstrations.npz    the trajectories that were learned from
OUTPUT/generalization.npz    with LPAL: the policy that it started from; written before it starts
OUTPUT/policy.npz            the learned policy [S, A], with visited, radius, support and certificates
OUTPUT/report.json           everything that is printed, and the settings
OUTPUT/answers.csv           of `ask`: the expert's answers
OUTPUT/*.png                 pictures, if matplotlib is installed
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from jaxhom import interrupts
from jaxhom.interop.archives import whole_file
from jaxhom.interop.files import save_demonstrations, save_policy
from jaxhom.models.demonstrations import Demonstrations

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float
    from matplotlib.figure import Figure

_FILES = (".csv", ".json", ".npy", ".txt", ".png", ".svg", ".pdf", ".pkl", ".mat", ".h5", ".track", ".zip")


class Results:
    """What a run writes. A path that ends in .npz takes the policy alone.

    Args:
      path: folder, made if it is missing, or file.

    Raises:
      ValueError: if the name is that of another kind of file.
      OSError: if the folder cannot be made, or that of the file is missing.
    """

    def __init__(self, path: str):
        self.written: list[str] = []
        self._path = path
        self.is_folder = not path.lower().endswith(".npz")
        kind = os.path.splitext(path)[1].lower()
        if kind in _FILES and not os.path.isdir(path):
            raise ValueError(f"--output {path}: policies are written to .npz files, everything else into a folder")
        if self.is_folder:
            os.makedirs(path, exist_ok=True)
        elif not os.path.isdir(os.path.dirname(path) or "."):
            raise FileNotFoundError(2, "no such folder", os.path.dirname(path))

    def policy(self, policy: Float[ArrayLike, "S A"], *, is_final: bool, **arrays: Any) -> None:
        """Writes a policy and what is known of it; one that is not final makes way for the one that is."""
        name = "policy.npz" if is_final else "generalization.npz"
        path = os.path.join(self._path, name) if self.is_folder else self._path
        save_policy(path, policy, **arrays)
        self.note(path)

    def demonstrations(self, demonstrations: Demonstrations) -> None:
        """Writes what is learned from."""
        self._in_folder("demonstrations.npz", lambda path: save_demonstrations(path, demonstrations))

    def report(self, report: Mapping[str, Any]) -> None:
        """Writes what is known so far."""
        self._in_folder("report.json", lambda path: write_json(path, report))

    def picture(self, name: str, figure: Figure) -> None:
        """Writes a figure, and forgets it."""
        self._in_folder(f"{name}.png", lambda path: save_figure(path, figure))

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Around all that writes: says at the end what was written.

        Raises:
          KeyboardInterrupt: if it was interrupted, with the files as its message.
        """
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:
            if not interrupts.is_interruption(error):
                raise
            interrupts.rest()
            raise KeyboardInterrupt("written so far: " + (", ".join(self.written) or "nothing")) from None
        print("\nWritten: " + ", ".join(self.written))

    def _in_folder(self, name: str, write: Callable[[str], None]) -> None:
        if self.is_folder:
            path = os.path.join(self._path, name)
            write(path)
            self.note(path)

    def note(self, path: str) -> None:
        """Remembers a file that was written."""
        if path not in self.written:
            self.written.append(path)


def save_figure(path: str, figure: Figure) -> None:
    """Writes a figure in the format that the name asks for, and forgets it.

    Raises:
      ValueError: if there is no such format.
    """
    import matplotlib.pyplot as plt

    kind = os.path.splitext(path)[1].removeprefix(".").lower()
    try:
        with whole_file(path) as file:
            figure.savefig(file, dpi=120, format=kind or None)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    finally:
        plt.close(figure)


def write_json(path: str, content: Any) -> None:
    """Writes JSON; NaN and infinity, which JSON has no word for, as null."""
    text = json.dumps(_finite(content), indent=2, allow_nan=False) + "\n"
    with whole_file(path) as file:
        file.write(text.encode())


def _finite(value):
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
