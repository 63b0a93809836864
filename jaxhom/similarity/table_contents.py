"""What the contents of a table of similarities are about: by what one for another model, or none at all, is told."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.similarity.relations import RELATIONS

if TYPE_CHECKING:
    from jaxtyping import Num, UInt8

    from jaxhom.models.mdp import MDP

HEADING = ("transitions", "relation", "distance", "anchored", "labels")
"""What a table is about, labels only where there are any."""
_NAMES = (
    *HEADING[:-1],
    "class_of_state",
    "representative",
    "class_key",
    "pairs",
    "lower",
    "upper",
    "iterations",
    "status",
    "tried",
)


def heading(
    mdp: MDP, relation: Any, distance: int, anchored: bool, labels: Num[np.ndarray, "S A L"] | None
) -> dict[str, np.ndarray]:
    """What a table is about, as plain arrays: a digest of the model's `transitions`, and the options.

    Raises:
      ValueError: if the relation is a function.
    """
    if callable(relation):
        raise ValueError("the relation is a function, which cannot be written down: only relations with a name can")
    values = {"relation": relation, "distance": distance, "anchored": anchored, "labels": labels}
    named = {name: np.asarray(value) for name, value in values.items() if value is not None}
    return {"transitions": transitions_digest(mdp), **named}


def options_in(contents: Mapping[str, np.ndarray], mdp: MDP) -> dict[str, Any]:
    """The options of a table that is to know what another one did; `ValueError` where these are not its contents."""
    missing = [name for name in _NAMES if name not in contents]
    if missing:
        raise ValueError(f"array {missing[0]!r} is missing (there are {', '.join(sorted(contents)) or 'none'})")
    if not np.array_equal(contents["transitions"], transitions_digest(mdp)):
        raise ValueError("these are similarities of another model: transitions, allowed actions or number types differ")
    relation, distance, anchored = (contents[name] for name in ("relation", "distance", "anchored"))
    if relation.shape != () or str(relation) not in RELATIONS:
        raise ValueError(f"relation must be one of {RELATIONS}, got {checks.in_one_line(relation.tolist())}")
    if anchored.shape != () or anchored.dtype != bool:
        raise ValueError(f"anchored must be true or false, got {checks.in_one_line(anchored.tolist())}")
    return {
        "relation": str(relation),
        "distance": checks.require_count("distance", distance.tolist()),
        "anchored": bool(anchored),
        "labels": contents.get("labels"),
    }


def identity(mdp: MDP, relation: str, distance: int, anchored: bool, labels: Num[np.ndarray, "S A L"] | None) -> bytes:
    """A digest of all that errors depend on, by which the tables of different processes are told apart."""
    digest = hashlib.sha256(repr((relation, distance, anchored)).encode() + transitions_digest(mdp).tobytes())
    digest.update(b"" if labels is None else np.ascontiguousarray(labels))
    return digest.digest()


def transitions_digest(mdp: MDP) -> UInt8[np.ndarray, " 32"]:
    """A digest of all that local models are made of; the same on every machine."""
    digest = hashlib.sha256()
    for part in (mdp.next_state, mdp.probability, mdp.allowed):
        array = np.asarray(part)
        array = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(array if array.dtype.kind != "f" else array + 0.0)  # no two kinds of zero
    return np.frombuffer(digest.digest(), np.uint8)
