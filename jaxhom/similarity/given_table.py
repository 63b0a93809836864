"""The table that a function was given, or one of its own."""

from __future__ import annotations

import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.similarity.table import SimilarityTable


def table_for(table: SimilarityTable | None, mdp: MDP, distance: int, anchored: bool) -> SimilarityTable:
    """The table that was given, if it is one for this model and these options, or else `ValueError`; a new one if None.

    Options that differ from a table's are refused rather than overruled.
    """
    if table is None:
        return SimilarityTable(mdp, distance=distance, anchored=anchored)
    if not isinstance(table, SimilarityTable):
        raise ValueError(f"table must be a SimilarityTable, got {type(table).__name__}")
    if not _same_transitions(table.mdp, as_model(mdp)):
        raise ValueError("table was made for another model")
    if (table.distance, table.anchored) != (distance, bool(anchored)):
        raise ValueError(
            f"table was made with distance={table.distance} and anchored={table.anchored}, "
            f"not with distance={distance} and anchored={anchored}"
        )
    return table


def _same_transitions(one: MDP, other: MDP) -> bool:
    """Whether two models have the same local models: features, discount and initial distribution may differ.

    Of traced arrays shapes and types are all that can be compared.
    """

    def parts(mdp):
        return mdp.next_state, mdp.probability, mdp.allowed

    return one is other or all(
        a is b or (a.shape == b.shape and a.dtype == b.dtype and (checks.is_traced(a, b) or np.array_equal(a, b)))
        for a, b in zip(parts(one), parts(other), strict=True)
    )
