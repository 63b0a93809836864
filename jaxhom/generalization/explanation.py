"""Why a state has the policy that it has: an `Explanation`, its numbers and its text.

`Generalization.explain(state)` makes one (see `explainers`); `str()` of it is for people.
"""

import dataclasses

import numpy as np

from jaxhom.models.names import Names, described
from jaxhom.similarity.brackets import LocalSimilarity
from jaxhom.similarity.maps import CertifiedMaps
from jaxhom.status import Record, Status, bracket

_MAX_VOTERS = 12  # of which the text shows a line each
_MAX_MAPS = 3  # that are written out
_MAX_ROWS = 10  # of a map
_MAX_TERMS = 4  # of a row
_MAX_ACTIONS = 6  # of a policy, where they have names
_LEAST_SHARE = 1e-4  # of a row, to count as more than the solver's tolerance


class Explanation(Record):
    """Which demonstrated states a state's policy came from, how far they are and why they had a say; NumPy.

    Attributes:
      state: the state that is explained.
      method: what generalized, with its options, in words.
      reason: what it did at this state, in words.
      radius: steps that it had to look; 0 on demonstrated states, -1 where nothing was found.
      policy: [A], the state's policy.
      voters: int [E], the demonstrated states whose policies it is made of, by number; the state itself if it was
        demonstrated, none where nothing was found.
      weights: [E], their shares: policy = weights @ voter_policies, unless `reason` says otherwise.
      voter_policies: [E, A], their policies.
      distances: float [E], how far each is: steps, or the Euclidean distance if that was the metric.
      forward: the map f of LP (9) from the state's local model (the source s) to that of each voter (the target s'),
        with certified bounds on the optimal error; None where the method compares no models.
      backward: if similarity had to be mutual, the maps from the voters' models to the state's.
      errors: bounds on the error to each voter, [E], where models are compared without a map; None otherwise.
      renamings: int [E, A], which of the voter's actions stands for each action of the state, where they were renamed;
        `forward` then is the map to the renamed model. None where every action stands for itself.
      state_names: what the model calls its states, and action_names its actions, in the text; None without names.
    """

    state: int = dataclasses.field(metadata={"static": True})
    method: str = dataclasses.field(metadata={"static": True})
    reason: str = dataclasses.field(metadata={"static": True})
    radius: int = dataclasses.field(metadata={"static": True})
    policy: np.ndarray
    voters: np.ndarray
    weights: np.ndarray
    voter_policies: np.ndarray
    distances: np.ndarray
    forward: CertifiedMaps | None = None
    backward: CertifiedMaps | None = None
    errors: LocalSimilarity | None = None
    renamings: np.ndarray | None = None
    state_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})
    action_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})

    @property
    def lower(self) -> np.ndarray | None:
        """[E], lower <= e <= upper for the error e to each voter; None where the method compares no models."""
        return None if self._bounds is None else self._bounds.lower

    @property
    def upper(self) -> np.ndarray | None:
        """[E], see `lower`."""
        return None if self._bounds is None else self._bounds.upper

    @property
    def _bounds(self) -> CertifiedMaps | LocalSimilarity | None:
        return self.errors if self.forward is None else self.forward

    @property
    def maps(self) -> np.ndarray | None:
        """[E, n, m], see `CertifiedMaps.maps`; None as `forward`."""
        return None if self.forward is None else self.forward.maps

    def __str__(self) -> str:
        lines = [
            f"State {self._name(self.state)}: {self.reason}",
            f"Policy {self._row(self.policy)}, by {self.method}.",
        ]
        if len(self.voters):
            lines += ["", *self._table()]
        if self.forward is not None:
            lines += ["", *self._maps()]
        return "\n".join(lines)

    def _name(self, state: int) -> str:
        return described(state, self.state_names)

    def _row(self, policy: np.ndarray) -> str:
        """A policy's probabilities; with names, of the actions that it takes."""
        if self.action_names is None:
            return _numbers(policy)
        taken = np.argsort(-policy, kind="stable")[: np.count_nonzero(policy)]
        parts = [f"{self.action_names[a]} {policy[a]:.3g}" for a in taken[:_MAX_ACTIONS]]
        return ", ".join(parts + ["..."] * (len(taken) > _MAX_ACTIONS))

    def _renaming(self, order: np.ndarray) -> str:
        """`2 -> 0, 0 -> 2`: which of the voter's actions become which; none that keep their names."""
        names = range(len(order)) if self.action_names is None else self.action_names
        return ", ".join(f"{names[its]} -> {names[own]}" for own, its in enumerate(order) if its != own) or "none"

    def _table(self) -> list[str]:
        """A line per voter, those with the largest shares."""
        order = np.argsort(-self.weights, kind="stable")[:_MAX_VOTERS]
        columns = {
            "voter": [self._name(self.voters[e]) for e in order],
            "distance": [f"{self.distances[e]:.4g}" for e in order],
            "share": [f"{self.weights[e]:.4g}" for e in order],
            "its policy": [self._row(self.voter_policies[e]) for e in order],
        }
        if self._bounds is not None:
            of = "error e" if self.forward is None else "error e of its map"
            columns[of] = [_bracket(self._bounds, e) for e in order]
        if self.renamings is not None:
            columns["its actions renamed"] = [self._renaming(self.renamings[e]) for e in order]
        if self.backward is not None:
            columns["and of the map back"] = [_bracket(self.backward, e) for e in order]
        width = {name: max(map(len, [name, *cells])) for name, cells in columns.items()}
        rows = [columns, *zip(*columns.values(), strict=True)]
        lines = ["  ".join(f"{cell:<{width[name]}}" for name, cell in zip(columns, row, strict=True)) for row in rows]
        rest = len(self.voters) - len(order)
        return [line.rstrip() for line in lines] + [f"... and {rest} more"] * (rest > 0)

    def _maps(self) -> list[str]:
        """The first maps, row by row."""
        lines = [f"Map f from the local model of {self._name(self.state)} (source) to that of the voter (target):"]
        for e in range(min(len(self.voters), _MAX_MAPS)):
            lines.append(f"  voter {self._name(self.voters[e])}: " + "; ".join(self._map(self.forward, e)))
        rest = len(self.voters) - _MAX_MAPS
        return lines + [f"  ... and {rest} more"] * (rest > 0)

    def _map(self, found: CertifiedMaps, pair: int) -> list[str]:
        """`7 -> 12`, or `7 -> 0.5 12 + 0.4 13 + 2 more`, for each state of the source."""
        real = found.sources[pair] >= 0
        states = found.sources[pair][real]
        rows = []
        for state, shares in zip(states[:_MAX_ROWS], found.maps[pair], strict=False):
            order = np.argsort(-shares, kind="stable")[: max((shares >= _LEAST_SHARE).sum(), 1)]
            if shares[order[0]] > 1.0 - _LEAST_SHARE:
                rows.append(f"{self._name(state)} -> {self._name(found.targets[pair, order[0]])}")
                continue
            terms = [f"{shares[k]:.2g} {self._name(found.targets[pair, k])}" for k in order[:_MAX_TERMS]]
            rest = len(order) - len(terms)
            rows.append(f"{self._name(state)} -> " + " + ".join(terms + [f"{rest} more"] * (rest > 0)))
        rest = len(states) - len(rows)
        return rows + [f"{rest} more states"] * (rest > 0)


def _numbers(row: np.ndarray) -> str:
    return np.array2string(row, formatter={"float": lambda x: f"{x:.3g}"}, threshold=12, separator=", ")


def _bracket(found: CertifiedMaps | LocalSimilarity, pair: int) -> str:
    mark = "" if found.status[pair] == Status.SOLVED else " (stopped early)"
    return bracket(found.lower[pair], found.upper[pair]) + mark
