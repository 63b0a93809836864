"""The table that a function was given, or one of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model, check_labels
from jaxhom.models.mdp import MDP
from jaxhom.similarity.table import SimilarityTable


def table_for(
    table: SimilarityTable | None,
    mdp: MDP,
    *,
    distance: int,
    anchored: bool,
    labels: Any = None,
    label_weight: Any = 1.0,
    relation: Any = "homomorphism",
    for_graph: bool = False,
) -> SimilarityTable:
    """The table that was given, if it is one for this model and these options, or else `ValueError`; a new one if None.

    Options that differ from a table's are refused rather than overruled; labels and relation do not count where the
    table stands for the graph alone.
    """
    if table is None:
        options = {"labels": labels, "label_weight": label_weight, "relation": relation}
        return SimilarityTable(mdp, distance=distance, anchored=anchored, **options)
    if not isinstance(table, SimilarityTable):
        raise ValueError(f"table must be a SimilarityTable, got {type(table).__name__}")
    if not _same_transitions(table.mdp, as_model(mdp)):
        raise ValueError("table was made for another model")
    if (table.distance, table.anchored) != (distance, anchored):
        raise ValueError(
            f"table was made with distance={table.distance} and anchored={table.anchored}, "
            f"not with distance={distance} and anchored={anchored}"
        )
    if for_graph:
        return table
    if relation != table.given_relation:
        raise ValueError(
            f"table was made with relation={checks.in_one_line(table.given_relation)}, "
            f"not with relation={checks.in_one_line(relation)}"
        )
    _require_same_labels(table, labels, label_weight)
    return table


def _require_same_labels(table: SimilarityTable, labels, label_weight) -> None:
    if (labels is None) != (table.labels is None):
        with_or_without = ("with", "without")[table.labels is None], ("with", "without")[labels is None]
        raise ValueError("table was made {} labels, not {} them".format(*with_or_without))
    if labels is not None and not checks.is_traced(labels, label_weight):
        given = check_labels(table.mdp, labels, label_weight)
        if given.shape != table.labels.shape or not np.array_equal(given, table.labels):
            raise ValueError("table was made with other labels")


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
