"""LPAL inside a program, where the queue of `pdhg` and the certificates of the host cannot be: one `while_loop`.

A pass is some iterations of PDHG on the flow (`flow_splitting`), then a look: the policy that is read off x becomes a
column; the weights that PDHG has come to are planned for, which gives a bound, and another column; the game over the
columns mixes them, which gives the margin; and its weights are asked for once more. So every lane has the crossover
from PDHG to columns that `pdhg` has outside. Lanes are solved a few at a time; those that are closed keep
what they have until the others are.

Bounds are those of the model's type, widened by what rounding and a rough linear solve can hide: the margin is that of
the policy that is returned, proved by the residual of the flow of its occupancy.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.column_responses import LOOSE_GAME, LOOSE_PLANNING, expected_features
from jaxhom.apprenticeship.flow_splitting import STEPS_PER_WEIGHT, Goal, State, advance, begin
from jaxhom.apprenticeship.model_in_program import ModelInProgram
from jaxhom.apprenticeship.planning_bound import UpperBound, bound_by_planning
from jaxhom.apprenticeship.presolve import default_tolerance, reduce_expectations
from jaxhom.apprenticeship.solution import RARE_STATES, LPALMethod, LPALSolution
from jaxhom.models.mdp import MDP, push_forward, uniform_policy
from jaxhom.planning.occupancy import policy_from_occupancy
from jaxhom.planning.plan import Plan
from jaxhom.solvers.game_interior_point import solve_game
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int

ITERATIONS = 1_000  # of PDHG, if nothing else is asked for
_ITERATIONS_PER_LOOK = 50
_MOST_LANES = 16  # at a time: more wait for the slowest, and leave a core's caches
_COLUMNS_PER_LOOK = 3  # the policy of x, and the best responses to PDHG's weights and to those of the game
_MOST_COLUMNS = 32  # of a game: 27 of 32 lanes of grid16 (bench.instances) close in 1,000 iterations, with 64 no more
_PULL = 0.3  # share of the best bound's weights in the second query
_ERROR = 0.02  # share of the tolerance by which expectations of a column may be off
_CLOSED = 0.9  # share of the tolerance at which a lane is: the rest is for what the last certificate adds


class Asked(Record):
    """What is asked: expectations [B, K], gaps [B], and policies [B, S, A] and weights [B, K] to begin with."""

    expectations: Float[Array, "B K"]
    tolerance: Float[Array, " B"] | None
    policy: Float[Array, "B S A"]
    weights: Float[Array, "B K"]


class _Standing(Record):
    """Where the lanes of a batch are; every leaf but `flow` has them first.

    Attributes:
      flow: PDHG's state, lanes last.
      x: [B, C, S, A], occupancies of the columns. expected: [B, C, K], their expectations; NaN where there is none.
      q: [B, C], the mixture. w: [B, K], the game's weights.
      lower: [B], the mixture's margin. upper: [B], the least bound; weights [B, K] that prove it, its actions [B, S].
      value: [B, S], of the last plan.
      iterations: int32 [B]. has_asked: bool [B], whether the game had to ask for columns of its own to close the lane.
    """

    flow: State
    x: Float[Array, "B C S A"]
    expected: Float[Array, "B C K"]
    q: Float[Array, "B C"]
    w: Float[Array, "B K"]
    lower: Float[Array, " B"]
    upper: Float[Array, " B"]
    weights: Float[Array, "B K"]
    actions: Int[Array, "B S"]
    value: Float[Array, "B S"]
    iterations: Int[Array, " B"]
    has_asked: Bool[Array, " B"]


def solve_in_program(
    program: ModelInProgram,
    expectations: Float[Array, "B K"],
    *,
    tolerance: float | Float[np.ndarray, " B"] | None,
    policy: Float[Array, "*B S A"] | None,
    weights: Float[Array, "*B K"] | None,
    max_iterations: int,
) -> LPALSolution:
    """The solutions of a batch; under `vmap` over anything but the model all lanes become one batch."""
    mdp, (count, num_features) = program.mdp, expectations.shape
    dtype = mdp.dtype
    policy = uniform_policy(mdp) if policy is None else policy
    weights = jnp.full(num_features, 1.0 / num_features) if weights is None else weights
    asked = Asked(
        expectations=expectations.astype(dtype),
        tolerance=None if tolerance is None else jnp.broadcast_to(jnp.asarray(tolerance, dtype), count),
        policy=jnp.broadcast_to(policy.astype(dtype), (count, *mdp.allowed.shape)),
        weights=jnp.broadcast_to(weights.astype(dtype), expectations.shape),
    )
    looks = -(-max_iterations // _ITERATIONS_PER_LOOK)
    return _solve(*jax.lax.stop_gradient((program, asked)), looks)


@functools.partial(jax.jit, static_argnames="looks")
def _solve(program: ModelInProgram, asked: Asked, looks: int) -> LPALSolution:
    @jax.custom_batching.custom_vmap
    def solve_batch(program, asked):
        return _solve_in_chunks(program, asked, looks)

    @solve_batch.def_vmap
    def _merge_axes(axis_size, in_batched, program, asked):
        def with_axis(leaf, is_batched):
            return leaf if is_batched else jnp.broadcast_to(leaf, (axis_size, *jnp.shape(leaf)))

        asked = jax.tree.map(with_axis, asked, in_batched[1])
        if any(jax.tree.leaves(in_batched[0])):  # models of their own: one after the other
            programs = jax.tree.map(with_axis, program, in_batched[0])
            found = jax.lax.map(lambda one: solve_batch(*one), (programs, asked))
        else:
            merged = solve_batch(program, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), asked))
            found = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), merged)
        return found, jax.tree.map(lambda _: True, found)

    return solve_batch(program, asked)


def _solve_in_chunks(program: ModelInProgram, asked: Asked, looks: int) -> LPALSolution:
    """Some lanes at a time, equally many; the surplus repeats the first."""
    total = len(asked.expectations)
    chunks = -(-total // _MOST_LANES)
    width = -(-total // chunks)
    if chunks == 1:
        return _solve_chunk(program, asked, looks)
    order = jnp.arange(chunks * width) % total
    parts = jax.tree.map(lambda leaf: leaf[order].reshape(chunks, width, *leaf.shape[1:]), asked)
    found = jax.lax.map(lambda part: _solve_chunk(program, part, looks), parts)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], found)


def _solve_chunk(program: ModelInProgram, asked: Asked, looks: int) -> LPALSolution:
    reduction = reduce_expectations(program.reach, asked.expectations)
    tolerance = default_tolerance(program.reach, reduction) if asked.tolerance is None else asked.tolerance
    target, gap = reduction.expectations / program.unit, tolerance / program.unit
    goal = program.goal(target, asked.policy / program.mdp.num_states, asked.weights)
    look = functools.partial(_look, program, asked.policy, goal, target, gap)
    closed_at = jnp.maximum(_CLOSED * gap, _rounding_of_bounds(program.mdp))

    def is_open(now: _Standing) -> Bool[Array, " B"]:
        return ~(now.upper - now.lower <= closed_at)

    def keep_going(carry):
        now, number = carry
        return is_open(now).any() & (number <= looks)

    def advance_open(carry):
        now, number = carry
        return _where(is_open(now), look(now, number), now), number + 1

    start = _start(program, goal, asked, looks)
    now, _ = jax.lax.while_loop(keep_going, advance_open, (start, jnp.zeros((), jnp.int32)))
    return _certified(program, asked, reduction, tolerance, now, looks)


def _start(program: ModelInProgram, goal: Goal, asked: Asked, looks: int) -> _Standing:
    """Without any column."""
    (count, num_features), pairs, dtype = asked.expectations.shape, program.mdp.allowed.shape, program.mdp.dtype
    room = min(_COLUMNS_PER_LOOK * (looks + 1), _MOST_COLUMNS)
    return _Standing(
        flow=begin(program.splitting, goal),
        x=jnp.zeros((count, room, *pairs), dtype),
        expected=jnp.full((count, room, num_features), jnp.nan, dtype),
        q=jnp.zeros((count, room), dtype),
        w=asked.weights,
        lower=jnp.full(count, -jnp.inf, dtype),
        upper=jnp.full(count, jnp.inf, dtype),
        weights=asked.weights,
        actions=jnp.broadcast_to(program.mdp.allowed.argmax(axis=1), (count, pairs[0])).astype(jnp.int32),
        value=jnp.zeros((count, pairs[0]), dtype),
        iterations=jnp.zeros(count, jnp.int32),
        has_asked=jnp.zeros(count, bool),
    )


def _where(choice: Bool[Array, " B"], new: _Standing, old: _Standing) -> _Standing:
    """Lane by lane the new or the old."""

    def choose(one, other):
        return jnp.where(choice.reshape(-1, *(1,) * (one.ndim - 1)), one, other)

    flow = jax.tree.map(lambda one, other: jnp.where(choice, one, other), new.flow, old.flow)
    return jax.tree.map(choose, new.replace(flow=None), old.replace(flow=None)).replace(flow=flow)


def _look(
    program: ModelInProgram, policy, goal: Goal, target, gap, now: _Standing, number: Int[Array, ""]
) -> _Standing:
    """One pass. The first has no iterations: it looks at the policy and the weights to begin with."""
    mdp, splitting, is_first = program.mdp, program.splitting, number == 0
    steps = jnp.where(is_first, 0, _ITERATIONS_PER_LOOK // STEPS_PER_WEIGHT)
    flow = jax.lax.fori_loop(0, steps, lambda _, state: advance(splitting, goal, state), now.flow)
    x, weights, value = program.read(goal, flow)
    uniform = jnp.broadcast_to(uniform_policy(mdp), x.shape)
    policy = jnp.where(is_first, policy, policy_from_occupancy(mdp, x, uniform))
    weights = jnp.where(is_first, now.w, weights)
    is_guess = ~is_first & jnp.isfinite(value).all(axis=1, keepdims=True)
    made = now.iterations + steps * STEPS_PER_WEIGHT
    now = now.replace(flow=flow, value=jnp.where(is_guess, value, now.value), iterations=made)

    def ask(column: int, now: _Standing) -> _Standing:
        # The policy of x, the best response to the weights, and that to the game's.
        is_given, left = column == 0, now.upper - now.lower
        query = jnp.where(column >= 2, (1.0 - _PULL) * now.w + _PULL * now.weights, weights)
        accuracy = jnp.maximum(gap, LOOSE_PLANNING * jnp.where(jnp.isfinite(left), left, 0.0))
        accuracy = jnp.where(is_given, jnp.inf, accuracy)
        bound, plan = bound_by_planning(mdp, target, query, now.value, accuracy, is_quick=True)
        now = now.replace(has_asked=(column >= 2) & ~(left <= _CLOSED * gap))
        now = _with_bound(now, bound, plan).replace(iterations=now.iterations + ~is_given)
        chosen = jnp.where(is_given, policy, plan.policy)
        mu, expected = expected_features(mdp, chosen, _ERROR * gap, is_quick=True)
        now = _with_column(now, mu.T[..., None] * chosen, expected)
        return _with_game(now, target, jnp.where(is_given, jnp.inf, gap))

    now = jax.lax.fori_loop(0, _COLUMNS_PER_LOOK, ask, now)
    started = program.begin(goal, now.x[:, 0])
    return now.replace(flow=jax.tree.map(lambda new, old: jnp.where(is_first, new, old), started, now.flow))


def _with_bound(now: _Standing, bound: UpperBound, plan: Plan) -> _Standing:
    is_better = bound.margin_bound < now.upper
    is_finite = jnp.isfinite(plan.value).all(axis=1, keepdims=True)
    actions = plan.policy.argmax(axis=-1).astype(jnp.int32)
    return now.replace(
        upper=jnp.where(is_better, bound.margin_bound, now.upper),
        weights=jnp.where(is_better[:, None], bound.weights, now.weights),
        actions=jnp.where(is_better[:, None], actions, now.actions),
        value=jnp.where(is_finite, plan.value, now.value),
    )


def _with_column(now: _Standing, x: Float[Array, "B S A"], expected: Float[Array, "B K"]) -> _Standing:
    """A column more, in an empty place, or in that of the one that the mixture has least of."""
    is_empty = jnp.isnan(now.expected[..., 0])
    place = jnp.where(is_empty, -1.0, now.q).argmin(axis=1)
    is_good = jnp.isfinite(expected).all(axis=1) & jnp.isfinite(x).all(axis=(1, 2))
    here = is_good[:, None] & (jnp.arange(now.q.shape[1]) == place[:, None])
    return now.replace(
        x=jnp.where(here[..., None, None], x[:, None], now.x),
        expected=jnp.where(here[..., None], expected[:, None], now.expected),
        q=jnp.where(here, 0.0, now.q),
    )


def _with_game(now: _Standing, target: Float[Array, "B K"], gap: Float[Array, " B"]) -> _Standing:
    """The best mixture of the columns."""

    def play(expected, target, gap, bound, w, q):
        is_column = jnp.isfinite(expected[:, 0])
        payoff = jnp.where(is_column[:, None], expected - target, 0.0).T
        return solve_game(payoff, is_column, tolerance=0.25 * gap, share=LOOSE_GAME, bound=bound, start=(w, q))

    game = jax.vmap(play)(now.expected, target, gap, now.upper, now.w, now.q)
    is_finite = jnp.isfinite(game.lower)
    return now.replace(
        q=jnp.where(is_finite[:, None], game.q, now.q),
        w=jnp.where(is_finite[:, None], game.w, now.w),
        lower=jnp.where(is_finite, game.lower, now.lower),
    )


def _certified(program: ModelInProgram, asked: Asked, reduction, tolerance, now: _Standing, looks: int) -> LPALSolution:
    """What the lanes end with, in the caller's units; the margin is proved by the flow of the policy's occupancy."""
    mdp, unit, eps = program.mdp, program.unit, jnp.finfo(program.mdp.dtype).eps
    x = jnp.einsum("bc,bcsa->bsa", now.q, now.x)
    best = jax.nn.one_hot(now.actions, mdp.num_actions, dtype=mdp.dtype)
    policy = policy_from_occupancy(mdp, x, best, negligible=RARE_STATES)
    occupancy = x.sum(axis=-1, keepdims=True) * policy
    expected, error = _expected_features(mdp, occupancy)
    given, shift = asked.expectations / unit, reduction.shift / unit
    least = expected - given - error[:, None] - 4.0 * eps * (jnp.abs(expected) + jnp.abs(given))
    margin = least.min(axis=1)
    # The bound is for the reduced expectations, which are rounded too.
    size = jnp.maximum(jnp.abs(program.reach.low), jnp.abs(program.reach.high)).max() / unit
    bound = now.upper + shift + 8.0 * eps * (jnp.abs(now.upper) + jnp.abs(shift) + size)
    low, high = jnp.minimum(margin, bound) * unit, jnp.maximum(margin, bound) * unit
    is_over = now.iterations >= _ITERATIONS_PER_LOOK * looks
    return LPALSolution(
        policy=policy,
        occupancy=occupancy,
        margin=low,
        margin_bound=high,
        weights=reduction.weights(slice(None), now.weights),
        iterations=now.iterations,
        decided_by=jnp.where(now.has_asked, LPALMethod.COLUMNS, LPALMethod.PDHG).astype(jnp.int32),
        status=jnp.where(
            high - low <= tolerance, Status.SOLVED, jnp.where(is_over, Status.ITERATION_LIMIT, Status.STALLED)
        ).astype(jnp.int32),
    )


def _expected_features(mdp: MDP, occupancy: Float[Array, "B S A"]) -> tuple[Float[Array, "B K"], Float[Array, " B"]]:
    """Expectations [B, K] of policies, from what is nearly their occupancies, and by how much they may be off.

    What misses in the flow, |r|_1, is worth at most the largest |feature| over all discounted time.
    """
    last = jnp.moveaxis(occupancy, 0, -1)
    mu = last.sum(axis=1)
    missing = mdp.initial[:, None] + mdp.discount * push_forward(mdp, last) - mu
    eps, largest, total = jnp.finfo(mdp.dtype).eps, jnp.abs(mdp.features).max(), mu.sum(axis=0)
    rounding = (mdp.dynamics.longest_sum + mdp.num_actions + 8.0) * eps * (total + 1.0)
    lost = (jnp.abs(missing).sum(axis=0) + rounding) / (1.0 - mdp.discount)
    # Sums over states in two stages, so that rounding grows with the root of their number.
    width = int(np.ceil(mdp.num_states**0.5))
    filling = [(0, 0), (0, -mdp.num_states % width), (0, 0)]
    pairs, features = jnp.pad(occupancy, filling), jnp.pad(mdp.features, [filling[1], (0, 0), (0, 0)])
    if features.shape[1] == 1:
        pairs = pairs.sum(axis=2, keepdims=True)
    blocks = pairs.reshape(len(pairs), -1, width, pairs.shape[2])
    expected = jnp.einsum("bgwa,gwak->bgk", blocks, features.reshape(-1, width, *features.shape[1:])).sum(axis=1)
    in_sums = (2.0 * width + mdp.num_actions) * eps * largest * total
    return expected, lost * largest + in_sums


def _rounding_of_bounds(mdp: MDP) -> Float[Array, ""]:
    """What rounding in the values of plans widens bounds by, or a little more: nearer they do not come."""
    terms = 2.0 * (mdp.probability.shape[-1] + 8.0)
    return terms * jnp.finfo(mdp.dtype).eps * jnp.abs(mdp.features).max() / (1.0 - mdp.discount) ** 2
