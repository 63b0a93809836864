"""Maps of the Gymnasium environments whose states are the cells of a grid, for pictures and for distances.

    FrozenLake      holes are walls on the map (no action is taken in them), the goal is the finish
    CliffWalking    the cliff likewise: a step onto it leads back to the start

Their tables hold no geometry; it is in attributes that only these two have.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxhom.domains.tile_map import TileMap
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    import gymnasium

_UP, _DOWN, _LEFT, _RIGHT = (-1, 0), (1, 0), (0, -1), (0, 1)
_LAKE_LETTERS = {b"S": "S", b"F": ".", b"H": "#", b"G": "F"}


def tile_map(env: gymnasium.Env, mdp: MDP) -> TileMap | None:
    """The map of an environment's model.

    Args:
      env: the environment, wrapped or not.
      mdp: its model.

    Returns:
      The map; None for environments that have none, and for models with a state that is no cell (`end_state=True`).
    """
    inner = getattr(env, "unwrapped", env)
    layout = _LAYOUTS.get(type(inner).__name__)
    if layout is None:
        return None
    rows, moves = layout(inner)
    fits = sum(map(len, rows)) == mdp.num_states and len(moves) == mdp.num_actions
    return TileMap.from_rows(mdp, rows, moves) if fits else None


def _frozen_lake(env):
    rows = ["".join(_LAKE_LETTERS.get(letter, ".") for letter in row) for row in np.asarray(env.desc, dtype="S1")]
    return rows, (_LEFT, _DOWN, _RIGHT, _UP)


def _cliff_walking(env):
    height, width = env.shape
    letters = np.full((height, width), ".")
    letters[np.asarray(env._cliff, bool)] = "#"
    letters[np.unravel_index(env.start_state_index, env.shape)] = "S"
    letters[height - 1, width - 1] = "F"
    return ["".join(row) for row in letters], (_UP, _RIGHT, _DOWN, _LEFT)


_LAYOUTS = {"FrozenLakeEnv": _frozen_lake, "CliffWalkingEnv": _cliff_walking}
