"""Measures planning, occupancies and values by this library and by others on the same instances.

A section is an instance of `bench.instances.PLANNING`; how it is measured is `bench.contest`'s. Planning is judged by
the policy: its value, by `Model.policy_solve`, must lie within 1e-6 / (1 - discount) times the largest reward of an
upper bound on the optimal one at every state. Occupancies and values must have a relative error of 1e-8 against that
solve.
"""

import functools
from collections.abc import Iterator

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxhom  # noqa: E402
from bench import contest, instances, planning_peers  # noqa: E402
from bench.lp_peers import Settings  # noqa: E402
from bench.models import Model  # noqa: E402
from bench.provenance import provenance  # noqa: E402

OURS = "jaxhom"
SEED = 0
_LOSS = 1e-6  # per step, as a share of the largest reward: a tenth of what LPAL is asked for
_LEAST_TOLERANCE = 1e-10  # of toolboxes, times the largest value: below it float64 ends
_RELATIVE_ERROR = 1e-8  # direct solves have 1e-12 at the worst (results/speed_planning.csv); for iterative ones
_MIXED = 0.1  # of the uniform policy, in the policies that are evaluated: every state occurs
_PACKAGES = ("jax", "mdptoolbox-hiive", "mdpsolver", "quantecon", "scipy", "numpy")


def section(name: str, quick: bool, methods: list[str] | None, limit: float) -> Iterator[dict]:
    """All rows of an instance: ours, then each peer's, for each kind of work."""
    title, build, reward_of = instances.PLANNING[name]
    mdp = build()
    model, lanes = Model.of(mdp), range(contest.QUICK_LANES if quick else contest.LANES)
    drawn = np.stack([reward_of(mdp, SEED, lane) for lane in lanes])
    plans = [jaxhom.optimal_policy(mdp, reward) for reward in drawn]
    lanes = [
        (reward, (1.0 - _MIXED) * np.asarray(plan.policy) + _MIXED / mdp.num_actions)
        for reward, plan in zip(drawn, plans, strict=True)
    ]
    upper = [np.asarray(plan.upper_bound(mdp)) for plan in plans]
    loss = _LOSS / (1.0 - model.discount) * float(np.abs(drawn).max())
    # The loss of the greedy policy is at most twice the Bellman residual over 1 - discount.
    options = {"name": name, "tolerance": 0.5 * (1.0 - model.discount) * loss}
    for work in ("planning", "occupancy", "policy_value"):
        asked = loss if work == "planning" else _RELATIVE_ERROR
        fields = {"instance": title, "work": work, "S": mdp.num_states, "A": mdp.num_actions}
        fields |= {"dtype": "float64", "error_asked": asked} | provenance(*_PACKAGES)
        judge = functools.partial(_judged, work, model, lanes, upper, asked)
        problem = contest.Contest(fields, lanes, judge, _LEAST_TOLERANCE * loss / _LOSS, quick, limit)
        ours = {OURS: ("ours:planning", options | {"work": work}, True)}
        yield from contest.rows(problem, ours, _peers(work, model, loss), methods)


def _peers(work: str, model: Model, loss: float) -> dict[str, contest.Peer | None]:
    """The toolboxes, or the linear solvers, which have no tolerance."""
    is_planning, peers = work == "planning", {}
    for method in planning_peers.PLANNERS if is_planning else planning_peers.SOLVERS:
        if planning_peers.can_solve(method, model):
            shared = {"method": method, "work": work, "model": model}
            peer = contest.Peer(
                solver="planning_peers:opened",
                package=planning_peers.package(method),
                options=lambda settings, shared=shared: shared | {"tolerance": settings.tolerance},
                candidates=(Settings(loss if is_planning else 0.0),),
            )
            peers[method] = peer if planning_peers.is_installed(method) else None
    return peers


def _judged(work: str, model: Model, lanes: list, upper: list, asked: float, answers: list) -> dict:
    """The worst lane's error, and whether it is small enough."""
    error = max(_error(work, model, *case) for case in zip(lanes, upper, answers, strict=False))
    return {"error": error if np.isfinite(error) else None, "settled": float(error <= asked)}


def _error(work: str, model: Model, lane: tuple, upper: np.ndarray, found: np.ndarray) -> float:
    reward, policy = lane
    if not np.isfinite(found).all():
        return float("inf")
    if work == "planning":
        return float((upper - model.policy_value(np.eye(model.shape[1])[found], reward)).max())
    if work == "occupancy":
        exact = model.occupancy(policy)
        return float(np.abs(found - exact).sum() / exact.sum())
    exact = model.policy_value(policy, reward)
    return float(np.abs(found - exact).max() / np.abs(exact).max())
