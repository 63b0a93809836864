"""Grid maps of the moving-AI benchmarks: cells as states, moves to their neighbours as actions.

    type octile
    height 3            . G     ground               S     swamp, which is ground here
    width 4             W       water, by itself     @ O T out of bounds, trees
    map
    ..@.

A move leads from ground to ground, or from water to water; a diagonal one cuts no corners: both cells beside it have to
be passable as well. Moves that lead elsewhere are no actions. The feature of a move is minus its length, -1 or
-sqrt(2): a non-negative weight on it prefers short ways.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from jaxhom.domains.tile_map import TileMap
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.imported_model import Entries, ImportedModel, counted, model_of_entries
from jaxhom.interop.text_files import open_text, require_letters

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Float

_NOTHING, _GROUND, _WATER = range(3)
_LETTERS = {**dict.fromkeys(".GS", _GROUND), "W": _WATER, **dict.fromkeys("@OT", _NOTHING)}
_MOVES = {
    "north": (-1, 0),
    "south": (1, 0),
    "west": (0, -1),
    "east": (0, 1),
    "northwest": (-1, -1),
    "northeast": (-1, 1),
    "southwest": (1, -1),
    "southeast": (1, 1),
}


def from_octile(path: str | os.PathLike, *, discount: Float[ArrayLike, ""] = 0.99, num_moves: int = 8) -> ImportedModel:
    """Reads a grid map (see the module's text).

    Args:
      path: the file, plain or compressed by gzip.
      discount: scalar, strictly between 0 and 1.
      num_moves: 8, or 4 for none that are diagonal.

    Returns:
      The model without a reward: its states are the passable cells, named (row, column) from (0, 0) on, which also are
      the coordinates; its one feature is minus the length of a move. `labels` has `swamp` and `water` where there are
      such cells, `domain` the map. Cells without a way out absorb.

    Raises:
      FileError: if the file is missing or no text, or naming the line, and the column, of what is malformed.
      ValueError: if `num_moves` is neither 4 nor 8.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "yard.map")
      >>> _ = path.write_text("type octile\\nheight 2\\nwidth 3\\nmap\\n..@\\n.T.\\n")
      >>> yard = from_octile(path)
      >>> yard.state_names
      ((0, 0), (0, 1), (1, 0), (1, 2))
      >>> [yard.action_names[move] for move in yard.mdp.allowed[0].nonzero()[0]]
      ['south', 'east']
    """
    if num_moves not in (4, 8):
        raise ValueError(f"num_moves must be 4 or 8, got {num_moves}")
    letters = _map(path)
    kind = np.vectorize(_LETTERS.__getitem__, otypes=[int])(letters)
    cells = np.argwhere(kind != _NOTHING)
    if not len(cells):
        raise FileError(f"{path}: no cell of its map is passable")
    moves = dict(list(_MOVES.items())[:num_moves])
    entries = _entries(kind, cells, list(moves.values()))
    length = np.linalg.norm(list(moves.values()), axis=1)
    at = letters[tuple(cells.T)]
    labels = {name: at == letter for name, letter in (("swamp", "S"), ("water", "W")) if (at == letter).any()}
    with errors_of(path):
        model = model_of_entries(
            entries,
            num_states=len(cells),
            num_actions=num_moves,
            discount=discount,
            features=np.broadcast_to(-length[:, None], (len(cells), num_moves, 1)),
            state_names=[*map(tuple, cells.tolist())],
            action_names=[*moves],
            coordinates=cells,
            labels=labels,
            remarks=[f"{counted(mask.sum(), 'cell')} of {name}" for name, mask in labels.items()],
        )
    rows = ["".join(row) for row in np.where(kind == _NOTHING, "@", ".").tolist()]
    return model.replace(domain=TileMap.from_rows(model.mdp, rows, list(moves.values())))


def _map(path: str | os.PathLike) -> np.ndarray:
    """The letters [R, C] of a file's map."""
    with open_text(path) as file:
        lines = [line.rstrip("\n") for line in file]
    size: dict[str, int] = {}
    first = next((number for number, line in enumerate(lines) if line.split()[:1] == ["map"]), None)
    if first is None:
        raise FileError(f"{path}: no line `map`, behind which the map begins")
    for number, line in enumerate(lines[:first], start=1):
        word, *rest = line.split() or [""]
        if word in ("height", "width") and len(rest) == 1 and rest[0].isdecimal() and int(rest[0]) > 0:
            size[word] = int(rest[0])
        elif word and word != "type":
            raise FileError(f"{path} line {number}: expected `type octile`, `height N` or `width N`, got {line!r}")
    for word in ("height", "width"):
        if word not in size:
            raise FileError(f"{path}: no line `{word} N` before its map")
    rows = lines[first + 1 :]
    while rows and not rows[-1].strip():
        rows.pop()
    if len(rows) != size["height"]:
        raise FileError(f"{path}: its map has {len(rows)} rows, but its height is {size['height']}")
    for number, row in enumerate(rows, start=first + 2):
        if len(row) != size["width"]:
            raise FileError(f"{path} line {number}: {len(row)} columns, but the width is {size['width']}")
        require_letters(path, number, row, _LETTERS)
    return np.array([list(row) for row in rows])


def _entries(kind: np.ndarray, cells: np.ndarray, moves: list[tuple[int, int]]) -> Entries:
    """The moves between cells of one kind."""
    number = np.full(kind.shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    kind, number = (np.pad(array, 1, constant_values=value) for array, value in ((kind, _NOTHING), (number, -1)))
    here = cells + 1
    mine = kind[tuple(here.T)]

    def fits(step: tuple[int, int]) -> Bool[np.ndarray, " S"]:
        return kind[tuple((here + step).T)] == mine

    state, action, next_state = [], [], []
    for n, (down, right) in enumerate(moves):
        (goes,) = np.nonzero(fits((down, right)) & fits((down, 0)) & fits((0, right)))
        state.append(goes)
        action.append(np.full(len(goes), n))
        next_state.append(number[tuple((here[goes] + (down, right)).T)])
    states = np.concatenate(state)
    return Entries(states, np.concatenate(action), np.concatenate(next_state), np.ones(len(states)))
