"""Pairs of models that LP (9) is asked about, as arrays on the host; a model in many pairs is there once."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.similarity.homomorphism_lp import HomomorphismProblem

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class ModelPairs(NamedTuple):
    """P pairs of models; `bracket_errors` says what the arrays are.

    Attributes:
      source: [S, n, A, n]. target: [S', m, A, m].
      source_size: int [S]. target_size: int [S'].
      source_labels: [S, n, A, L]. target_labels: [S', m, A, L]. Or both None.
      anchored: whether the centre is mapped to the centre.
      pairs: int [P, 2], the numbers of the two models of each.
    """

    source: Float[np.ndarray, "S n A n"]
    target: Float[np.ndarray, "T m A m"]
    source_size: Int[np.ndarray, " S"]
    target_size: Int[np.ndarray, " T"]
    source_labels: Float[np.ndarray, "S n A L"] | None
    target_labels: Float[np.ndarray, "T m A L"] | None
    anchored: bool
    pairs: Int[np.ndarray, "P 2"]

    @classmethod
    def of(
        cls,
        source: np.ndarray,
        target: np.ndarray,
        *,
        source_size: np.ndarray | None = None,
        target_size: np.ndarray | None = None,
        source_labels: np.ndarray | None = None,
        target_labels: np.ndarray | None = None,
        anchored: bool = True,
        pairs: np.ndarray | None = None,
    ) -> ModelPairs:
        """With what may be left out: all states are real, and models of the same number are a pair."""

        def sizes(given, models):
            return np.full(len(models), models.shape[1]) if given is None else given

        if pairs is None:
            pairs = np.repeat(np.arange(len(source))[:, None], 2, axis=1)
        given = (sizes(source_size, source), sizes(target_size, target), source_labels, target_labels)
        return cls(source, target, *given, anchored, pairs)

    @property
    def dtype(self) -> np.dtype:
        """Of the models."""
        return self.source.dtype

    @property
    def num_labels(self) -> int:
        """L."""
        return 0 if self.source_labels is None else self.source_labels.shape[3]

    def masks(self) -> tuple[Bool[np.ndarray, "S n"], Bool[np.ndarray, "T m"]]:
        """Which states of the sources and of the targets are real."""
        sides = ((self.source_size, self.source), (self.target_size, self.target))
        return tuple(np.arange(models.shape[1]) < np.asarray(size)[:, None] for size, models in sides)

    def problem(self, chosen) -> HomomorphismProblem:
        """The programs of some of the pairs, lanes last."""
        one, other = self.pairs[chosen].T

        def lanes_last(array, index):
            return None if array is None else np.moveaxis(array[index], 0, -1)

        return HomomorphismProblem(
            source=lanes_last(self.source, one),
            target=lanes_last(self.target, other),
            source_size=self.source_size[one],
            target_size=self.target_size[other],
            anchored=self.anchored,
            source_labels=lanes_last(self.source_labels, one),
            target_labels=lanes_last(self.target_labels, other),
        )
