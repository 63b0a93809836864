"""What the learners beside LPAL return: weights of a reward, and the policies that go with them.

LPAL returns a policy with a certified margin (`LPALSolution`). The learners of the line of work that it comes from (Ng
and Russell 2000, Abbeel and Ng 2004, Syed and Schapire 2007, Ziebart 2010) return weights too, and one of two policies
is meant: that of their theory, which may be random, or the best one for the reward that they have found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int


class Learned(Record):
    """Weights of a reward, and the policies that go with them; a batch adds a leading axis [B] to every field.

    What `objective` and `bound` are is said by the learner. Values are discounted sums.

    Attributes:
      policy: [S, A], rows sum to 1: the policy of the learner's theory, which may be random.
      greedy_policy: [S, A], one-hot: optimal for `weights`.
      weights: [K], of the features as the model has them; the reward is features @ weights. Where `inverse_lp` is given
        a model without features, [S], the reward of every state.
      expectations: [K], feature expectations of `policy`; [S], its occupancy of the states, where `weights` are [S].
      objective: scalar, what the learner makes small or large, at what is returned.
      bound: scalar, what no policy (of `inverse_lp`: no weights) can go beyond, certified: the objective's distance to
        it is the certificate; None where the learner has none.
      gradient_norm: scalar, the largest entry of the gradient that is left; None where nothing is descended.
      iterations: int32 scalar.
      status: int32 scalar, a `jaxhom.Status`.
    """

    policy: Float[Array, "*B S A"]
    greedy_policy: Float[Array, "*B S A"]
    weights: Float[Array, "*B K"]
    expectations: Float[Array, "*B K"]
    objective: Float[Array, "*B"]
    bound: Float[Array, "*B"] | None = None
    gradient_norm: Float[Array, "*B"] | None = None
    iterations: Int[Array, "*B"]
    status: Int[Array, "*B"]
