"""Chains of policies on the host, in float64: linear systems that iterations do not reach, solved directly.

Near a discount of 1 a chain that mixes slowly (a corridor, two recurrent classes) leaves every iteration on products
hundreds of thousands of steps to go, where sparse LU takes one. With P_pi(s, s') = sum_a pi(s, a) T(s, a, s'),

    (I - gamma P_pi)   V  = r_pi,        (I - gamma P_pi)^T mu = alpha.

Rows of T are brought to sum 1 once more, in float64, and 1 - gamma P_pi(s, s) is computed as (1 - gamma) + gamma times
the chance to leave s: nothing cancels, so float32 tables give right values at any discount that float32 can hold.
"""

from __future__ import annotations

import copy
import functools
import weakref
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from jaxhom.models.mdp import MDP
from jaxhom.planning.moving_mass import flow_of_moving_mass

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, Int

    Report = Callable[[float, float], None]  # told what is open, and what may be

_NARROW = 8.0  # bandwidth, in square roots of S, up to which elimination fills in little: roads, grids, corridors
_FEW_ENTRIES = 1e5  # states times bandwidth that any factor may hold: 300 states, all linked, take 2 ms
_BAND_WORK = 8e6  # states times squared bandwidth, up to which a band is factorised sooner: grids up to 48 x 48
_MAX_ENTRIES = 2e8  # states times bandwidth: what a factor may hold
# Up to these a solve on the host takes less time than a program's compiling, half a second; above such a discount less
# than the hundreds of products of an iteration.
_FEW_LANES, _FEW_STATES, _MODERATE_DISCOUNT = 4, 1024, 0.99
# Linear systems of chains are as quick on the host, lane by lane, as in programs, or quicker, on most models of
# bench/results/speed_planning.csv (garnet_sparse, grid16 to grid100), and nothing compiles; on racetrack_a programs are
# quicker by less than compiling takes. On grid316 they take less than half as long.
_CHAIN_LANES, _CHAIN_STATES = 128, 20_000
_GOOD_ENOUGH = 1e-3  # relative error that a residual may allow, beyond which nothing is returned
_SMALL_ERROR, _MAX_PRODUCTS = 1e-9, 300  # of BiCGSTAB; racetracks take 50 steps
_FIRST_SWEEPS = 20
_MOST_SWEEPS, _SWEEPS_PER_LOOK = 30_000, 100  # ten digits at 0.999
# Expectations on the grid of 262,144 states in bench/results/scale.jsonl take 1.4 s; by a factor they took 3.4.
_MANY_STATES, _FEW_SWEEPS, _WINDOW = 100_000, 3000, 0.25
_SAFE = 0.1  # of the error: its residual is measured in another norm
_latest: dict = {}  # one entry at most


def host_model(mdp: MDP) -> HostModel:
    """The model on the host; that of the latest model is kept as long as its arrays are."""
    array, discount, model = _latest.get("model", (lambda: None, None, None))
    if array() is not mdp.probability or discount is not mdp.discount:
        model = HostModel(mdp)
        _latest["model"] = (weakref.ref(mdp.probability, lambda _: _latest.clear()), mdp.discount, model)
    return model


class _Order(NamedTuple):
    """Where each state stands [S], and how far apart linked states stand then."""

    place: Int[np.ndarray, " S"]
    bandwidth: int


class _BandFactor:
    """LU of a matrix whose entries lie in a band once its rows and columns stand in an order (LAPACK's `gbtrf`)."""

    def __init__(self, numbers: np.ndarray, row: np.ndarray, column: np.ndarray, order: _Order) -> None:
        self._place, width = order
        self._width, size, height = width, len(order.place), 3 * width + 1
        row, column = order.place[row], order.place[column]
        band = np.bincount(column * height + (2 * width + row - column), numbers, size * height)
        band = band.reshape((height, size), order="F")
        self._band, self._pivots, _ = scipy.linalg.lapack.dgbtrf(band, width, width, overwrite_ab=True)

    def solve(self, right: np.ndarray, kind: str) -> np.ndarray:
        """Solves with the matrix ("N") or its transpose ("T"), as those of SuperLU do."""
        ordered = np.empty(right.shape)
        ordered[self._place] = right
        factor = (self._band, self._width, self._width)
        solution, _ = scipy.linalg.lapack.dgbtrs(*factor, ordered, self._pivots, trans=int(kind == "T"))
        return solution.reshape(right.shape)[self._place]


class HostModel:
    """A concrete model in NumPy and SciPy, float64.

    Attributes:
      num_states, num_actions: S, A.
      discount: gamma.
      rows: [S A, S], T with a row per pair, zero where an action is not allowed; sparse, or an array if the model is
        dense.
    """

    def __init__(self, mdp: MDP) -> None:
        self.num_states, self.num_actions = mdp.num_states, mdp.num_actions
        self.discount = float(mdp.discount)
        pairs = self.num_states * self.num_actions
        probability = np.asarray(mdp.probability, np.float64).reshape(pairs, -1)
        probability = probability / _or_one(probability.sum(axis=1))[:, None]
        self.rows = mdp.dynamics.host_matrix(probability.reshape(mdp.probability.shape))

    def with_rows(self, rows: Float[np.ndarray, "S*A S"] | scipy.sparse.csr_array) -> HostModel:
        """The model with other transitions, as `rows` has them; what is not allowed any more stays with the caller."""
        other = copy.copy(self)
        other.__dict__.pop("_order", None)
        other.rows = rows
        return other

    def expected_next_value(self, value: Float[np.ndarray, " S"]) -> Float[np.ndarray, "S A"]:
        """E[value(s') | s, a]."""
        return (self.rows @ value).reshape(self.num_states, self.num_actions)

    def chain(
        self,
        policy: Float[np.ndarray, "S A"] | Int[np.ndarray, " S"],
        *,
        may_iterate: bool = False,
        may_factorise: bool = True,
    ) -> HostChain:
        """The chain of a policy, or of the actions that a deterministic one takes.

        With `may_iterate` it is solved by products where factors take long and products do it; where they do not, by
        factors if these may be.
        """
        by_products = may_iterate and not self.is_soon_factorised
        may_factorise &= self.is_solvable or not by_products  # who does not want products has asked before
        order = self._order if self.is_band and not by_products else None
        return HostChain(transition_under(policy, self.rows), self.discount, by_products, may_factorise, order)

    @property
    def bandwidth(self) -> int:
        """How far apart linked states are in a good order of the states: what elimination fills in."""
        return self._order.bandwidth if scipy.sparse.issparse(self.rows) else self.num_states

    @property
    def is_band(self) -> bool:
        """Whether all that a band holds is worked off before sparse LU has found where to begin."""
        return scipy.sparse.issparse(self.rows) and self.num_states * self.bandwidth**2 <= _BAND_WORK

    @functools.cached_property
    def _order(self) -> _Order:
        """A good order of the states of a sparse model."""
        owner = np.repeat(np.arange(len(self.rows.indptr) - 1) // self.num_actions, np.diff(self.rows.indptr))
        ones = np.ones(len(owner), np.float32)
        links = scipy.sparse.coo_array((ones, (owner, self.rows.indices)), shape=(self.num_states,) * 2).tocsr()
        order = scipy.sparse.csgraph.reverse_cuthill_mckee(links, symmetric_mode=False)
        place = np.empty(self.num_states, np.int64)
        place[order] = np.arange(self.num_states)
        return _Order(place, int(np.abs(place[owner] - place[self.rows.indices]).max(initial=0)))

    @property
    def is_narrow(self) -> bool:
        """Whether sparse LU is the quickest way: graphs like roads, grids and corridors."""
        return self.bandwidth <= _NARROW * np.sqrt(self.num_states)

    def iterates_sooner(self, lanes: int) -> bool:
        """Whether products on the host should be tried before the device: not too many systems of a sparse model.

        They take some ten milliseconds where the chain mixes, and a program seconds to compile.
        """
        return self._are_few_chains(lanes) and scipy.sparse.issparse(self.rows)

    def solves_sooner(self, lanes: int) -> bool:
        """Whether factors on the host should be asked before the device for so many linear systems."""
        return self.is_soon_factorised and (self._are_few_chains(lanes) or self.iterates_slowly)

    def _are_few_chains(self, lanes: int) -> bool:
        return lanes <= (_CHAIN_LANES if self.num_states <= _CHAIN_STATES else _FEW_LANES)

    @property
    def iterates_slowly(self) -> bool:
        """Whether the discount is so near 1 that a program may take hundreds of products for a linear system."""
        return self.discount > _MODERATE_DISCOUNT

    def plans_sooner(self, lanes: int) -> bool:
        """Whether the host should be asked first for the best policies of so many rewards."""
        is_small = self.num_states <= _FEW_STATES or self.iterates_slowly
        return lanes <= _FEW_LANES and is_small and self.is_soon_factorised

    def moves_sooner(self, error: float) -> bool:
        """Whether flows should first be tried by steps of moving mass, in large models."""
        if self.num_states < _MANY_STATES or not scipy.sparse.issparse(self.rows):
            return False
        return self.num_sweeps(error) <= (_FEW_SWEEPS if self.is_solvable else _MOST_SWEEPS)

    def is_swept(self, error: float) -> bool:
        """Whether sweeps are what is left: no factor fits, and the discount needs no more of them than are made."""
        return not self.is_solvable and self.num_sweeps(error) <= _MOST_SWEEPS

    def num_sweeps(self, error: float) -> float:
        """How many sweeps leave an error: gamma^n = error."""
        return np.log(error) / np.log(self.discount) if self.discount > 0 else 1.0

    @property
    def is_soon_factorised(self) -> bool:
        """Whether LU takes milliseconds: graphs like roads, and any graph of few states."""
        return (self.is_narrow and self.is_solvable) or self.num_states * self.bandwidth <= _FEW_ENTRIES

    @property
    def is_solvable(self) -> bool:
        """Whether a factor fits into memory."""
        return float(self.num_states) * self.bandwidth <= _MAX_ENTRIES


class HostChain:
    """One chain P_pi: solves with I - gamma P_pi and with its transpose.

    By LU, of a band if `order` makes one of the states; with `by_products` by BiCGSTAB (van der Vorst 1992),
    and by LU where that does not get on and may be.
    """

    def __init__(
        self,
        transition: Float[np.ndarray, "S S"] | scipy.sparse.csr_array,
        discount: float,
        by_products: bool = False,
        may_factorise: bool = True,
        order: _Order | None = None,
    ) -> None:
        self._discount, self._by_products, self._may_factorise = discount, by_products, may_factorise
        self._order = order
        if not scipy.sparse.issparse(transition):
            self._transition = transition / _or_one(transition.sum(axis=1))[:, None]
            return
        state = np.repeat(np.arange(transition.shape[0]), np.diff(transition.indptr))
        chance = transition.data / _or_one(np.bincount(state, transition.data, transition.shape[0]))[state]
        entries = (chance, transition.indices, transition.indptr)
        self._transition = scipy.sparse.csr_array(entries, shape=transition.shape)

    @functools.cached_property
    def _factor(self):
        """Of I - gamma P; of its transpose if it is sparse: its diagonal dominates its columns, so nothing pivots."""
        transition, discount = self._transition, self._discount
        if not scipy.sparse.issparse(transition):
            leaving = transition - np.diag(transition.diagonal())
            keeps = (1.0 - discount) + discount * leaving.sum(axis=1)
            return scipy.linalg.lu_factor(np.diag(keeps) - discount * leaving)
        size, successor, chance = transition.shape[0], transition.indices, transition.data
        states = np.arange(size)
        state = np.repeat(states, np.diff(transition.indptr))
        leaves = successor != state
        keeps = (1.0 - discount) + discount * np.bincount(state[leaves], chance[leaves], size)
        numbers = np.concatenate([-discount * chance[leaves], keeps])
        row, column = np.append(state[leaves], states), np.append(successor[leaves], states)
        if self._order is not None:
            return _BandFactor(numbers, column, row, self._order)
        columns = scipy.sparse.csc_array((numbers, (column, row)), shape=transition.shape)
        return scipy.sparse.linalg.splu(
            columns, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def value(self, reward: Float[np.ndarray, "S *K"], error: float = _SMALL_ERROR) -> Float[np.ndarray, "S *K"]:
        """V of rewards r_pi; NaN where rounding leaves more than a thousandth (of the largest) open.

        Args:
          reward: [S], or several of them [S, K].
          error: share of the values that may be off where products solve.
        """
        return self._checked(reward, is_flow=False, error=error)

    def state_occupancy(self, initial: Float[np.ndarray, " S"], error: float = _SMALL_ERROR) -> Float[np.ndarray, " S"]:
        """mu of an initial distribution; likewise."""
        return np.maximum(self.flow(initial, error), 0.0)

    def flow(self, source: Float[np.ndarray, "S *K"], error: float = _SMALL_ERROR) -> Float[np.ndarray, "S *K"]:
        """(I - gamma P)^-T of a source that may have either sign; likewise."""
        return self._checked(source, is_flow=True, error=error)

    def moved(
        self, source: Float[np.ndarray, " S"], error: float, report: Report | None = None
    ) -> Float[np.ndarray, " S"]:
        """The flow of a source by steps of moving mass; NaN where it does not stay together."""
        most_states = int(_WINDOW * len(source))
        flow = flow_of_moving_mass(self._transition, self._discount, source, error, most_states, report)
        return np.full_like(source, np.nan) if flow is None else flow

    def swept(
        self, right: Float[np.ndarray, " S"], error: float, *, is_flow: bool, report: Report | None = None
    ) -> Float[np.ndarray, " S"]:
        """V of a reward, or the flow of a source, by sweeps alone; NaN where the discount needs too many.

        The last resort for large models: a chain that takes thousands of steps to where it stays leaves Krylov's steps
        without a hold.
        """
        matrix = scipy.sparse.csr_array(self._transition.T) if is_flow else self._transition
        solution = right
        for count in range(1, _MOST_SWEEPS + 1):
            solution = right + self._discount * (matrix @ solution)
            if count % _SWEEPS_PER_LOOK == 0:
                missing, allowed = self._residual(error, right, solution, is_flow)
                if report:
                    report(missing, allowed)
                if missing <= allowed:
                    return solution
        return np.full_like(solution, np.nan)

    def _checked(self, right: np.ndarray, is_flow: bool, error: float) -> np.ndarray:
        if self._by_products:
            solution = self._iterate(right, is_flow, error)
            if np.isfinite(solution).all() or not self._may_factorise:
                return solution
        solution = self._solve(right, is_flow)
        return solution if self._is_within(_GOOD_ENOUGH, right, solution, is_flow) else np.full_like(solution, np.nan)

    def _is_within(self, error: float, right: np.ndarray, solution: np.ndarray, is_flow: bool) -> bool:
        """Whether a solution is off by no more than a share of its size."""
        missing, allowed = self._residual(error, right, solution, is_flow)
        return bool(missing <= allowed)

    def _residual(self, error: float, right: np.ndarray, solution: np.ndarray, is_flow: bool) -> tuple[float, float]:
        """What a solution leaves open, and what it may."""
        missing = right - solution + self._discount * self._step(solution, is_flow)
        # |(I - gamma P)^-1| is 1 / (1 - gamma) in the norm of sums for flows, and in that of maxima for values.
        norm = (lambda v: np.abs(v).sum()) if is_flow else (lambda v: np.abs(v).max())
        size = max(norm(solution), norm(right))
        return norm(missing), error * (1.0 - self._discount) * size + np.finfo(float).tiny

    def _step(self, vector: np.ndarray, is_flow: bool) -> np.ndarray:
        return self._transition.T @ vector if is_flow else self._transition @ vector

    def _iterate(self, right: np.ndarray, is_flow: bool, error: float) -> np.ndarray:
        """Column by column; NaN where it does not get there."""
        operator = scipy.sparse.linalg.LinearOperator(
            self._transition.shape, lambda x: x - self._discount * self._step(x, is_flow), dtype=np.float64
        )
        options = {"rtol": _SAFE * error * (1.0 - self._discount), "maxiter": _MAX_PRODUCTS}
        solution = np.full(right.shape, np.nan)
        for column in np.ndindex(right.shape[1:]):
            start = right[:, *column]  # sweeps first: from a single state on, steps that do not come back break it off
            for _ in range(_FIRST_SWEEPS):
                start = right[:, *column] + self._discount * self._step(start, is_flow)
            with np.errstate(all="ignore"):
                found = scipy.sparse.linalg.bicgstab(operator, right[:, *column], x0=start, **options)[0]
            if self._is_within(error, right[:, *column], found, is_flow):
                solution[:, *column] = found
        return solution

    def _solve(self, right: np.ndarray, is_flow: bool) -> np.ndarray:
        if isinstance(self._factor, tuple):
            return scipy.linalg.lu_solve(self._factor, right, trans=1 if is_flow else 0)
        return self._factor.solve(right, "N" if is_flow else "T")


def transition_under(
    policy: Float[np.ndarray, "S A"] | Int[np.ndarray, " S"], rows: Float[np.ndarray, "S*A S"] | scipy.sparse.csr_array
) -> Float[np.ndarray, "S S"] | scipy.sparse.csr_array:
    """P_pi of a policy, or of the actions that a deterministic one takes, from transitions with a row per pair.

    The rows of the policy sum to 1.
    """
    num_states, num_actions = len(policy), rows.shape[0] // len(policy)
    if policy.ndim == 2 and (np.count_nonzero(policy, axis=1) == 1).all():
        policy = policy.argmax(axis=1)
    if policy.ndim == 1:
        return rows[np.arange(num_states) * num_actions + policy]
    policy = np.asarray(policy, np.float64)
    if not scipy.sparse.issparse(rows):
        return np.einsum("sa,saz->sz", policy, rows.reshape(*policy.shape, -1))
    state, action = np.nonzero(policy)
    entries = (policy[state, action], (state, state * num_actions + action))
    return scipy.sparse.csr_array(entries, shape=(num_states, policy.size)) @ rows


def _or_one(total: np.ndarray) -> np.ndarray:
    """Sums to divide by; 1 where nothing was added up."""
    return np.where(total > 0, total, 1.0)
