"""Graph kernels between local models, in NumPy: how much two small models have in common, without a map between them.

The future work of Boularias and Chaib-draa 2010 (section VII). Each kernel is an inner product of features that one
model has by itself; divided by the lengths of the two, it is 1 for models that are equal up to a renaming of states,
and never negative.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from jaxhom.similarity.canonical_forms import colours_in_rounds
from jaxhom.similarity.class_pairs import LocalModel

NUM_ROUNDS = 3  # of colour refinement
NUM_STEPS = 12  # of a walk at most
CONTINUATION = 0.5  # a walk goes on with this probability after each step: one in 4096 is cut off


def colour_counts(
    models: Sequence[LocalModel], bits: int, *, anchored: bool, num_rounds: int = NUM_ROUNDS
) -> scipy.sparse.csr_array:
    """Features of the Weisfeiler-Lehman subtree kernel: how often each colour occurs in each model, [C, colours].

    Args:
      models: C of them; labels are at most 1.
      bits: probabilities and labels are the same if they agree to 2^-bits.
      anchored: give the centre a colour of its own.
      num_rounds: of refinement; colours of all rounds count, those before the first included.

    Source: Shervashidze, Schweitzer, van Leeuwen, Mehlhorn and Borgwardt 2011.
    """
    colours: list[np.ndarray] = [np.zeros(0, np.uint64)] * len(models)
    sizes = np.array([len(model.states) for model in models], int)
    for size in np.unique(sizes):
        (same,) = np.nonzero(sizes == size)
        transition = np.stack([models[c].transition for c in same])
        labels = None if models[same[0]].labels is None else np.stack([models[c].labels for c in same])
        found = colours_in_rounds(transition, bits, labels, num_rounds, anchored)
        own_round = np.arange(num_rounds + 1, dtype=np.uint64)[:, None, None]  # a colour of another round is another
        for c, own in zip(same, np.moveaxis(found + own_round, 1, 0), strict=True):
            colours[c] = own.ravel()
    _, column = np.unique(np.concatenate(colours), return_inverse=True)
    row = np.repeat(np.arange(len(models)), [len(own) for own in colours])
    ones = np.ones(len(column))
    return scipy.sparse.coo_array((ones, (row, column)), shape=(len(models), column.max(initial=-1) + 1)).tocsr()


def cosines(features: scipy.sparse.csr_array, pairs: np.ndarray) -> np.ndarray:
    """[Q]: the inner products of pairs [Q, 2] of rows, divided by their lengths."""
    square = (features * features).sum(axis=1)
    product = (features[pairs[:, 0]] * features[pairs[:, 1]]).sum(axis=1)
    return product / np.sqrt(square[pairs[:, 0]] * square[pairs[:, 1]])


def walks_in_common(
    source, target, source_size, target_size, labels=(), *, anchored: bool, num_steps: int = NUM_STEPS
) -> np.ndarray:
    """The random-walk kernel of Q pairs of models, not normalised, [Q].

    Two walks, one in each model, start at the centres and take the same random actions, each as likely as any other.
    The kernel is the expected number of steps, those beyond the first each going on with probability 1/2, for which
    the walks look alike: at every step both stayed where they were or both moved, and both are at the centre or both
    are not. Where models carry labels a step counts exp(-|l - l'|_1) for those of the pairs (state, action) it takes.

    Args:
      source: [Q, n, A, n], target: [Q, m, A, m], padding zero.
      source_size, target_size: int [Q], how many states are real.
      labels: none, or those of both, [Q, n, A, L] and [Q, m, A, L].
      anchored: start at the centres and tell them from other states. Otherwise walks start anywhere.
      num_steps: after which a walk is cut off.

    Source: Vishwanathan, Borgwardt and Schraudolph 2007; the labels of walks are those of Kashima, Tsuda and Inokuchi
    2003.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    labels = tuple(np.asarray(side, float) for side in labels)
    count, n, num_actions, _ = source.shape
    m = target.shape[1]
    real = (np.arange(n) < source_size[:, None])[:, :, None] & (np.arange(m) < target_size[:, None])[:, None]
    alike = real.astype(float)
    if anchored:
        alike *= (np.arange(n) == 0)[:, None] == (np.arange(m) == 0)
    stays, stays_there = (np.einsum("qiai->qai", model) for model in (source, target))
    moves, moves_there = (
        np.moveaxis(model * ~np.eye(model.shape[1], dtype=bool)[:, None], 2, 0) for model in (source, target)
    )
    back = np.swapaxes(moves_there, 2, 3)
    share = CONTINUATION / num_actions * _label_kernel(labels, (num_actions, count, n, m))
    walks = alike
    for _ in range(num_steps):
        ahead = 0.0
        for a in range(num_actions):
            step = moves[a] @ walks @ back[a] + stays[:, a, :, None] * stays_there[:, a, None] * walks
            ahead = ahead + share[a] * step
        walks = alike * (1.0 + ahead)
    return walks[:, 0, 0] if anchored else walks.sum(axis=(1, 2)) / real.sum(axis=(1, 2))


def _label_kernel(labels, shape: tuple[int, ...]) -> np.ndarray:
    """exp(-|l(i, a) - l'(k, a)|_1), [A, Q, n, m]; ones without labels."""
    if not labels:
        return np.ones((shape[0], 1, 1, 1))
    apart = np.zeros(shape)
    for label in range(labels[0].shape[3]):
        here, there = (np.moveaxis(side[..., label], 2, 0) for side in labels)
        apart += np.abs(here[..., :, None] - there[..., None, :])
    return np.exp(-apart)
