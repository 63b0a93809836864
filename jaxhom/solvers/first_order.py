"""Refusing second derivatives of values whose first ones hold part of the answer constant.

By the envelope theorem the derivative of an optimal value needs no derivative of the optimal point, so nobody computes
that. Differentiating such a derivative again would take the point for a constant and return a wrong number.
"""

from __future__ import annotations

import functools
from typing import TypeVar

import jax

Tree = TypeVar("Tree")


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def first_order_only(point: Tree, inputs: object, message: str) -> Tree:
    """The point, which is to be, or to be found from, the inputs in a way that is not differentiated.

    Args:
      point, inputs: pytrees of arrays.
      message: of the ValueError raised where one of them is under differentiation.
    """
    del inputs, message
    return point


@first_order_only.defjvp
def _(message, primals, tangents):
    del primals, tangents
    raise ValueError(message)
