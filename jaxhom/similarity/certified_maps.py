"""The maps behind similarities: for pairs of states, an f of LP (9) together with the bounds that it proves.

`brackets` settles many pairs of classes and keeps no map. Here the local models of a few pairs of states are mapped
onto each other for people to look at: exactly, by a renaming, where they are isomorphic, and by PDHG elsewhere.
"""

import dataclasses

import numpy as np

from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import settle_by_pdhg
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem, plain_forward
from jaxhom.similarity.local_models import isomorphism, local_models, model_rounding
from jaxhom.solvers import pdhg
from jaxhom.status import Status

_LANES = 8
_SMALL = 8  # local models up to this size share one padding, larger ones the next power of two
_MAX_ITERATIONS = 100_000
_MAX_PRODUCTS = 2e10  # multiplications per pair: large models stop early, with the bounds they have


@dataclasses.dataclass(frozen=True, eq=False)
class CertifiedMaps:
    """Maps from the local models of P source states to those of P target states, NumPy.

    Attributes:
      lower: [P], lower <= e <= upper for the optimal error e of LP (9), rounding included.
      upper: [P], likewise.
      maps: [P, n, m], rows sum to 1: f(i, k) is the share of the source's i-th state that goes to the target's k-th.
        Its own error |K f|_inf is at most `upper`. Zero on padding.
      sources: int [P, n], the states of M^{s,d} that the rows stand for, centre first; -1 on padding.
      targets: int [P, m], the states of M^{s',d} that the columns stand for, likewise.
      status: int [P], a `jaxhom.Status`.
    """

    lower: np.ndarray
    upper: np.ndarray
    maps: np.ndarray
    sources: np.ndarray
    targets: np.ndarray
    status: np.ndarray


def certified_maps(mdp: MDP, sources, targets, distance: int, anchored: bool) -> CertifiedMaps:
    """Maps M^{s,d} to M^{s',d} for pairs (s, s') of states, each with as small an error as can be certified.

    Args:
      mdp: the model.
      sources, targets: int [P], the states s and s' of each pair.
      distance, anchored: as in `local_similarity`.

    Returns:
      `CertifiedMaps`; the bounds are 1e-6 apart (1e-4 in float32), or `status` says why not.

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    from_models, to_models = (local_models(mdp, states, distance) for states in (sources, targets))
    count, dtype = len(from_models.size), from_models.transition.dtype
    result = CertifiedMaps(
        lower=np.zeros(count, dtype),
        upper=np.ones(count, dtype),
        maps=np.zeros((count, from_models.members.shape[1], to_models.members.shape[1]), dtype),
        sources=from_models.members,
        targets=to_models.members,
        status=np.full(count, Status.SOLVED, np.int32),
    )
    differs = np.ones(count, bool)
    for pair, (n, m) in enumerate(zip(from_models.size, to_models.size, strict=True)):
        source, target = from_models.transition[pair, :n, :, :n], to_models.transition[pair, :m, :, :m]
        labels = None
        if from_models.labels is not None:
            labels = from_models.labels[pair, :n], to_models.labels[pair, :m]
        renaming = isomorphism(source, target, labels)
        if renaming is not None:
            f = np.eye(m, dtype=dtype)[renaming]
            result.maps[pair, :n, :m] = f
            result.upper[pair] = np.abs(plain_forward(source, target, f)).max() + model_rounding(dtype)
            differs[pair] = False
    if differs.any():
        _solve(from_models, to_models, np.flatnonzero(differs), anchored, result)
    return result


def _solve(from_models, to_models, pairs: np.ndarray, anchored: bool, result: CertifiedMaps) -> None:
    """Writes the bounds and maps of the given pairs into `result`."""
    n, m = result.maps.shape[1:]
    (source, source_labels), (target, target_labels) = _padded(from_models, pairs), _padded(to_models, pairs)
    tolerance = 1e-6 if source.dtype == np.float64 else 1e-4
    per_iteration = 2 * source.shape[1] * len(source) * len(target) * (len(source) + len(target))
    found = settle_by_pdhg(
        HomomorphismProblem(
            source=source,
            target=target,
            source_size=from_models.size[pairs],
            target_size=to_models.size[pairs],
            anchored=anchored,
            source_labels=source_labels,
            target_labels=target_labels,
        ),
        tolerance=tolerance,
        max_iterations=int(np.clip(_MAX_PRODUCTS / per_iteration, pdhg.STEPS_PER_CHECK, _MAX_ITERATIONS)),
        lanes=_LANES,
        keep=("best_primal",),
    )
    result.lower[pairs], result.upper[pairs] = found["lower"], found["upper"]
    result.maps[pairs] = np.moveaxis(found["best_primal"], -1, 0)[:, :n, :m]
    result.status[pairs] = found["status"]


def _padded(models, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """[n', A, n', P] and labels [n', A, L, P] or None: some models, lanes last, padded to one of a few sizes."""
    transition = np.moveaxis(models.transition[pairs], 0, -1)
    size = len(transition)
    room = 2 ** int(np.ceil(np.log2(max(size, _SMALL)))) - size
    labels = models.labels
    if labels is not None:
        labels = np.pad(np.moveaxis(labels[pairs], 0, -1), [(0, room), (0, 0), (0, 0), (0, 0)])
    return np.pad(transition, [(0, room), (0, 0), (0, room), (0, 0)]), labels
