"""Files of models, by their suffix: the one table of readers, which the command line uses as well."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.cassandra import from_cassandra
from jaxhom.interop.files import load_arrays, load_mdp
from jaxhom.interop.gridworld_files import from_gridworld
from jaxhom.interop.imported_model import ImportedModel
from jaxhom.interop.networks import from_edges
from jaxhom.interop.octile import from_octile
from jaxhom.interop.prism import from_prism
from jaxhom.interop.tables import from_table
from jaxhom.interop.text_files import without_gz
from jaxhom.models.inputs import check_coordinates
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

DISCOUNT = 0.99  # of files that cannot have one, as the domains of the library

_WITHOUT_DISCOUNT: dict[str, Callable[..., ImportedModel]] = {
    ".tra": from_prism,
    ".csv": from_table,
    ".tsv": from_table,
    ".map": from_octile,
    ".gw": from_gridworld,
    ".graphml": from_edges,
    ".edgelist": from_edges,
    ".edges": from_edges,
}


def read_model(path: str | os.PathLike, *, discount: Float[ArrayLike, ""] | None = None) -> ImportedModel:
    """Reads a model by the suffix of its file; `.gz` may follow those of texts.

        .npz                          `load_mdp`, with the reward and what else lies beside the model
        .pomdp .mdp                   `from_cassandra`, in capitals or not
        .tra                          `from_prism`
        .csv .tsv                     `from_table`
        .map                          `from_octile`
        .gw                           `from_gridworld`
        .graphml .edgelist .edges     `from_edges`

    Racetracks are domains: `jaxhom.racetrack` reads `.track` files.

    Args:
      path: the file.
      discount: scalar, strictly between 0 and 1, where the file has none; 0.99 if None, for those that cannot have one.

    Raises:
      FileError: if there is no reader for the suffix, and as the readers.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "walk.csv")
      >>> _ = path.write_text("state,action,next\\n0,on,1\\n1,on,0\\n")
      >>> read_model(path, discount=0.9).action_names
      ('on',)
    """
    kind = os.path.splitext(without_gz(path))[1].lower()
    if kind == ".npz":
        return _archive(path, discount)
    if kind in (".pomdp", ".mdp"):
        return from_cassandra(path, discount=discount)
    if kind in _WITHOUT_DISCOUNT:
        return _WITHOUT_DISCOUNT[kind](path, discount=DISCOUNT if discount is None else discount)
    raise FileError(f"{path}: models are {', '.join(suffixes())} files, or .track maps")


def suffixes() -> list[str]:
    """All that `read_model` knows."""
    return [".npz", ".pomdp", ".mdp", *_WITHOUT_DISCOUNT]


def _archive(path: str | os.PathLike, discount: Any) -> ImportedModel:
    mdp = load_mdp(path, discount=discount)
    arrays = load_arrays(path, "reward", "coordinates", "terminal")
    with errors_of(path):
        known: dict[str, Any] = {name: _CHECKS[name](mdp, array) for name, array in arrays.items()}
        return ImportedModel(mdp=mdp, **known)


def _reward(mdp: MDP, reward: np.ndarray) -> Any:
    states, actions = mdp.num_states, mdp.num_actions
    good = reward.shape in ((states,), (states, actions))
    checks.require_shape("reward", reward, f"({states}, {actions}) or ({states},)", good)
    reward = checks.require_floats_in(mdp.dtype, "reward", reward)
    return checks.to_device(np.broadcast_to(reward.reshape(states, -1), (states, actions)))


def _terminal(mdp: MDP, terminal: np.ndarray) -> np.ndarray:
    checks.require_shape("terminal", terminal, f"({mdp.num_states},)", terminal.shape == (mdp.num_states,))
    if terminal.dtype != bool:
        raise ValueError(f"terminal must be bool, got dtype {terminal.dtype}")
    starts = np.asarray(mdp.initial) > 0
    checks.require_all("terminal", terminal, ~(terminal & starts), "must be False where episodes start")
    return terminal


_CHECKS: dict[str, Callable] = {"reward": _reward, "coordinates": check_coordinates, "terminal": _terminal}
