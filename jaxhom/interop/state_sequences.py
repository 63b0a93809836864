"""Demonstrations from states alone: which action led from each state to the next, where the model tells.

Between s and s' lies one of the actions with T(s, a, s') > 0. Where there is one, it was taken. Where there are
several, the step is ambiguous, also if they do the same: which of them the expert chose, nobody has seen, and a guess
would count as evidence. Such a step is hidden: its time passes, and no learner sees an action there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.import_reports import ImportReport, require_some, with_report
from jaxhom.interop.numbering import numberings
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.models.names import described
from jaxhom.models.padded_rows import rows_and_places

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

AMBIGUOUS = ("hide", "likeliest", "refuse")
_UNCLEAR = 'several actions could have been each of its steps (ambiguous="likeliest" takes the likeliest)'
_MOST_SLOTS = 10_000_000  # of successors that are looked through at once


def demonstrations_from_states(
    mdp: MDP, sequences: Iterable[Any], *, ambiguous: str = "hide"
) -> tuple[Demonstrations, ImportReport]:
    """Finds the actions of trajectories that were recorded as states alone.

    Args:
      mdp: the model.
      sequences: M sequences of states, H + 1 each: indices, or names that the model has for them.
      ambiguous: what happens to a step that several actions could have been. "hide": the learner does not see it, the
        times of the others stay, and the Monte Carlo mean leaves its features out. "likeliest": the action of largest
        T(s, a, s') is taken where that is a single one; other steps are hidden. "refuse": an error.

    Returns:
      The demonstrations, with hidden steps out of their `mask`; trajectories end before hidden steps at their end. The
      report lists all ambiguous steps, and as dropped the sequences of which no step remains.

    Raises:
      ValueError: naming the sequence and the step, if a state does not exist, no action leads from one to the next, or
        a step is ambiguous and that is refused; or if nothing remains.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(3, noise=0.0).mdp  # three by three fields
      >>> demonstrations, report = demonstrations_from_states(grid, [[3, 4, 1, 1, 2]])
      >>> demonstrations.states.tolist(), demonstrations.mask.tolist(), demonstrations.final_states.tolist()
      ([[3, 4, 1, 1]], [[True, True, True, True]], [2])
    """
    if not isinstance(ambiguous, str) or ambiguous not in AMBIGUOUS:
        raise ValueError(f"ambiguous must be one of {', '.join(AMBIGUOUS)}, got {checks.in_one_line(ambiguous)}")
    mdp = as_model(mdp)
    try:
        given = list(sequences)
    except TypeError:
        raise ValueError(f"sequences must be sequences of states, got {type(sequences).__name__}") from None
    numbering, _ = numberings(mdp)
    states = [numbering.indices(f"sequence {i}", sequence) for i, sequence in enumerate(given)]
    return inferred_actions(mdp, states, range(len(states)), ambiguous)


def inferred_actions(
    mdp: MDP, sequences: Sequence[Int[np.ndarray, " H"]], names: Sequence[int | str], ambiguous: str
) -> tuple[Demonstrations, ImportReport]:
    """`demonstrations_from_states` of checked states, [H + 1] each; `names` is what the report calls the sequences."""
    require_some(len(sequences), ())
    lengths = np.array([max(len(states) - 1, 0) for states in sequences], np.int64)
    before = np.concatenate([np.zeros(0, np.int64), *(states[:-1] for states in sequences)])
    after = np.concatenate([np.zeros(0, np.int64), *(states[1:] for states in sequences)])
    sequence, step = rows_and_places(lengths)
    pairs, kind = np.unique(before * mdp.num_states + after, return_inverse=True)
    chance = _chances(mdp, *np.divmod(pairs, mdp.num_states))

    def where(i: int) -> str:
        return f"sequence {names[sequence[i]]}, step {step[i]}"

    count = (chance > 0).sum(axis=1)
    impossible = np.flatnonzero(count[kind] == 0)
    if len(impossible):
        i = impossible[0]
        raise ValueError(f"{where(i)}: no action leads from {_between(mdp, before[i], after[i])}")
    unclear = np.flatnonzero(count[kind] > 1)
    several = [tuple(np.flatnonzero(row).tolist()) for row in chance > 0]
    if len(unclear) and ambiguous == "refuse":
        i = unclear[0]
        which = ", ".join(map(str, several[kind[i]]))
        raise ValueError(f"{where(i)}: actions {which} lead from {_between(mdp, before[i], after[i])}")
    # Ties up to rounding: tables are often computed.
    nearly = chance >= chance.max(axis=1, keepdims=True, initial=0.0) * (1 - 16 * np.finfo(mdp.dtype).eps)
    is_clear = nearly.sum(axis=1) == 1 if ambiguous == "likeliest" else count == 1
    cuts = np.cumsum(lengths)[:-1]
    actions = np.split(chance.argmax(axis=1)[kind], cuts)
    demonstrations, report = _hidden(sequences, actions, np.split(is_clear[kind], cuts), names)
    told = tuple((names[sequence[i]], int(step[i]), several[kind[i]]) for i in unclear)
    return demonstrations, dataclasses.replace(report, ambiguous=told)


def _between(mdp: MDP, state: int, successor: int) -> str:
    return f"state {described(state, mdp.state_names)} to state {described(successor, mdp.state_names)}"


def _chances(mdp: MDP, states: np.ndarray, successors: np.ndarray) -> Float[np.ndarray, "P A"]:
    """T(s, a, s') of all actions, for P pairs of states."""
    probability = np.asarray(mdp.probability)
    if mdp.is_dense:
        return probability[states, :, successors]
    next_state = np.asarray(mdp.next_state)
    chance = np.zeros((len(states), mdp.num_actions), probability.dtype)
    size = max(1, _MOST_SLOTS // next_state[0].size)
    for start in range(0, len(states), size):
        part = slice(start, start + size)
        leads = next_state[states[part]] == successors[part, None, None]
        chance[part] = np.where(leads, probability[states[part]], 0).sum(axis=-1)
    return chance


def _hidden(
    sequences: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    is_clear: Sequence[Bool[np.ndarray, " H"]],
    names: Sequence[int | str],
) -> tuple[Demonstrations, ImportReport]:
    """The demonstrations, with a mask that is True where an action is clear, and the report."""
    kept, shown, dropped = [], [], []
    for name, states, taken, clear in zip(names, sequences, actions, is_clear, strict=True):
        if not clear.any():
            dropped.append((name, "it has no step" if not len(clear) else _UNCLEAR))
            continue
        length = len(clear) - int(clear[::-1].argmax())
        kept.append((states[: length + 1], taken[:length]))
        shown.append(clear[:length])
    demonstrations, report = with_report(kept, dropped, len(kept))
    mask = np.array(demonstrations.mask)
    mask[mask] = np.concatenate(shown)
    taken = np.where(mask, demonstrations.actions, 0)
    demonstrations = demonstrations.replace(actions=checks.to_device(taken), mask=checks.to_device(mask))
    return demonstrations, dataclasses.replace(report, steps=int(mask.sum()))
