"""Flows from where mass stays together: sweeps over the states that it can reach, not over all of them.

From one state on, or few, the mass of a walk is a cloud that moves through the model: a thousand states wide where the
model has a million. With m_t = gamma^t (P^T)^t source, the flow is

    (I - gamma P^T)^-1 source  =  m_0 + m_1 + m_2 + ...

A block of steps runs in a window, the states that are so many steps or fewer away from the mass. Between two blocks the
states that hold the least are let go, and with them, at most, what `error` allows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_STEPS = 32  # per block; 16 and 64 take as long on grids of 512 x 512


def flow_of_moving_mass(
    transition: scipy.sparse.csr_array,
    discount: float,
    source: Float[np.ndarray, " S"],
    error: float,
    most_states: int,
    report: Callable[[float, float], None] | None = None,
) -> Float[np.ndarray, " S"] | None:
    """(I - gamma P^T)^-1 source, off by at most a share `error` of sum |source| / (1 - gamma), in the norm of sums.

    Args:
      transition: [S, S], P.
      discount: gamma, below 1.
      source: [S].
      error: the share, half of it for what is let go and half for the steps that are left out.
      most_states: that a window may have.
      report: told before each block how much mass there is and how much may be left out.

    Returns:
      [S]; None where the mass spreads to more states than that.
    """
    flow, number = np.zeros(len(source)), np.full(len(source), -1)
    (states,) = np.nonzero(source)
    mass, left_out = source[states], 0.5 * error * np.abs(source).sum()
    kept_back = 0.5 * error * (1.0 - discount**_STEPS)  # share that each block may let go
    while (size := np.abs(mass).sum()) > left_out:
        if report:
            report(size, left_out)
        window = _window(transition, states, number, most_states)
        if window is None:
            return None
        inside = _restricted(transition, window, number)
        number[window] = -1
        mass, total = np.append(mass, np.zeros(len(window) - len(mass))), np.zeros(len(window))
        for _ in range(_STEPS):
            total += mass
            mass = discount * (inside @ mass)
        flow[window] += total
        order = np.argsort(np.abs(mass))
        among_least = np.cumsum(np.abs(mass[order]))
        kept = order[among_least > kept_back * among_least[-1]]
        states, mass = window[kept], mass[kept]
    flow[states] += mass
    return flow


def _window(transition, states, number: Int[np.ndarray, " S"], most_states: int) -> Int[np.ndarray, " W"] | None:
    """The states at most `_STEPS` steps away, the nearest first, numbered in `number`; None, without numbers, if there
    are too many."""
    layers, count = [states], len(states)
    number[states] = np.arange(count)
    for _ in range(_STEPS):
        following = transition[layers[-1]].indices
        layer = np.unique(following[number[following] < 0])
        if not len(layer):
            break
        number[layer] = count + np.arange(len(layer))
        layers.append(layer)
        count += len(layer)
        if count > most_states:
            break
    window = np.concatenate(layers)
    if count > most_states:
        number[window] = -1
        return None
    return window


def _restricted(transition, window: Int[np.ndarray, " W"], number: Int[np.ndarray, " S"]) -> scipy.sparse.csr_array:
    """[W, W], P^T between states of the window. What leaves it does so after the block's last step."""
    rows = transition[window]
    column = number[rows.indices]
    is_inside = column >= 0
    row = np.repeat(np.arange(len(window)), np.diff(rows.indptr))[is_inside]
    entries = (rows.data[is_inside], (column[is_inside], row))
    return scipy.sparse.csr_array(entries, shape=(len(window), len(window)))
