"""Whether demonstrations can have happened in a model: steps of probability 0 are found and counted, on the host.

Demonstrations of another map, or whose states are numbered from 1, mostly lie within the model's range, and turn into
a bad policy without a sign. What gives them away is the dynamics: T(s_t, a_t, s_{t+1}) = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxhom import checks
from jaxhom.models.mdp import MDP
from jaxhom.models.names import described

if TYPE_CHECKING:
    from jaxtyping import Int

OPTIONS = ("refuse", "warn", "ignore")


class ImpossibleStepsWarning(UserWarning):
    """Demonstrations have steps that the model gives probability 0."""


class Steps(NamedTuple):
    """P steps whose successor is known: where they are and s, a, s'."""

    trajectory: Int[np.ndarray, " P"]
    time: Int[np.ndarray, " P"]
    state: Int[np.ndarray, " P"]
    action: Int[np.ndarray, " P"]
    successor: Int[np.ndarray, " P"]


def report_impossible(mdp: MDP, demonstrations: Any, impossible: str) -> None:
    """Raises `ValueError` ("refuse") or warns ("warn") if steps have probability 0, saying how many and the first."""
    if impossible == "ignore":
        return
    steps = known_steps(demonstrations)
    bad = ~mdp.dynamics.leads(steps.state, steps.action, steps.successor)
    if not bad.any():
        return
    trajectory, time, *step = (int(column[bad.argmax()]) for column in steps)
    names = mdp.state_names, mdp.action_names, mdp.state_names
    state, action, successor = (described(number, of) for number, of in zip(step, names, strict=True))
    message = (
        f"{bad.sum()} of {len(bad)} steps have probability 0 in this model; the first is trajectory {trajectory}, "
        f"step {time}: state {state}, action {action}, then state {successor}. "
        "Do the demonstrations belong to another model, or count states or actions from 1?"
    )
    if impossible == "refuse":
        raise ValueError(message)
    checks.warn(message, ImpossibleStepsWarning)


def known_steps(demonstrations: Any) -> Steps:
    """The steps that are followed by one that the mask shows too, or by a final state that is known."""
    horizon = demonstrations.horizon
    fields = demonstrations.states, demonstrations.actions, demonstrations.mask
    states, actions, mask = (np.asarray(array).reshape(-1, horizon) for array in fields)
    follows = np.full(states.shape, -1, np.int64)
    follows[:, :-1] = np.where(mask[:, 1:], states[:, 1:], -1)
    rows = np.flatnonzero(mask.any(axis=1))
    last = horizon - 1 - mask[rows, ::-1].argmax(axis=1)
    follows[rows, last] = np.asarray(demonstrations.final_states).ravel()[rows]
    trajectory, time = np.nonzero(mask & (follows >= 0))
    at = trajectory, time
    return Steps(trajectory, time, states[at], actions[at], follows[at])
