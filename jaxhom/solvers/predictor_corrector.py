"""The rules that primal-dual interior-point methods share: how long a step, how central a target, what to correct.

Such a method keeps pairs of positive vectors, here value and slack, and steers their products towards one small number:
Mehrotra (1992) first aims at 0 (the predictor), reads off how far that gets, and aims again at a target that is the
smaller the further it got, with the products of the first changes taken into account (the corrector). Gondzio (1996)
adds correctors that pull together the products that would end far apart.

What a step solves differs from method to method and stays with it. Arrays of NumPy and of JAX both work: on the host
the products are few and a call into JAX would take longer than all of them, inside a program NumPy cannot be. The
methods for single problems use this (`game_interior_point`, `sparse_interior_point`), and lane by lane so does that of
bands (`band_interior_point`). The one of the similarity has its lanes last and, but for the centre, rules for itself.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

from jaxhom.solvers.arrays import module_of

if TYPE_CHECKING:
    from jaxtyping import Array, Float

# Of programs over occupancies, on the host and in programs alike.
TO_BOUNDARY = 0.995  # of the way: points stay positive
PATIENCE = 30  # steps without a smaller error, after which rounding has won
MOST_CORRECTORS = 3  # after Mehrotra's
LONGER = 0.3  # what a corrector aims to add to the step
WORTH_IT = 0.03  # what it has to add, to both lengths together, to be kept
EVEN = 0.1  # products between this share of the target and its inverse stay as they are


def longest_step(
    *pairs: tuple[Float[Array, " n"], Float[Array, " n"]], most: float = 1.0, to_boundary: float = 1.0
) -> Float[Array, ""]:
    """The longest step that keeps every value + step * change non-negative, `to_boundary` of the way; at most `most`.

    Args:
      pairs: (value, change), values positive.
      most: where nothing is in the way.
      to_boundary: share of the way to the first boundary, below 1 for points that are to stay positive.
    """
    numpy = module_of(pairs[0][0])
    steps = [_first_boundary(numpy, value, change) for value, change in pairs]
    first = numpy.stack(steps).min() if len(steps) > 1 else steps[0]
    return numpy.minimum(to_boundary * first, most)


def _first_boundary(numpy: ModuleType, value, change):
    """The step at which the first value is 0; infinite if none falls."""
    is_falling = change < 0
    return numpy.where(is_falling, -value / numpy.where(is_falling, change, -1.0), numpy.inf).min(initial=numpy.inf)


def mehrotra_target(
    mean: Float[Array, ""], left: Float[Array, ""], least: float = 0.0, most: float = 1.0
) -> Float[Array, ""]:
    """What products should become: mean * left^3, where `left` is the share of them that the predictor leaves.

    Args:
      mean: of the products.
      left: the share.
      least: smallest factor; without one, products that nearly vanish leave the next step no room.
      most: largest factor. Above 1 only where points are not feasible yet, and products may have to grow first.
    """
    return mean * module_of(mean).clip(left**3, least, most)


def towards_centre(products: Float[Array, " n"], target: Float[Array, ""], even: float) -> Float[Array, " n"]:
    """What products lack to be between the share `even` of the target and the target divided by it.

    Large ones are corrected by no more than the largest product that is wanted: more would undo the step.
    """
    numpy = module_of(products)
    low, high = even * target, target / even
    return numpy.maximum(numpy.clip(products, low, high) - products, -high)
