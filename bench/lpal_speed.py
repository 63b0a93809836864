"""Measures LPAL by this library and by other solvers on the same instances, judged by one certificate.

A section is an instance of `bench.instances.LPAL`; how it is measured is `bench.contest`'s. The policy is read off x
(eq. 5; where the state hardly occurs, a best response to w). `bench.models.Model`, none of our solvers, gives its
margin min_k V_k(pi) - Vhat_k and the bound max_pi w . V(pi) - w . Vhat, each with its own error added.
"""

import functools
from collections.abc import Iterator

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from bench import contest, instances, lp_peers  # noqa: E402
from bench.linear_programs import Lpal  # noqa: E402
from bench.lp_peers import Settings  # noqa: E402
from bench.models import Model  # noqa: E402
from bench.provenance import provenance  # noqa: E402

OURS = {"jaxhom": None} | {f"jaxhom {method}": method for method in ("columns", "interior_point", "pdhg")}
_PRIMAL_SIMPLEX = {"simplex_strategy": 4, "presolve": "off"}
_DUAL_SIMPLEX = {"use_dual_simplex": "true"}


def _dual(tolerance: float, options: dict | None = None, *, shares: bool = False) -> Settings:
    return Settings(tolerance, options or {}, "dual", shares)


CANDIDATES = {  # the fastest on one instance of results/speed_lpal.csv or another; the best of them is taken on each
    "moreau": (_dual(1e-6), Settings(1e-5, form="primal")),
    "clarabel": (_dual(1e-6), Settings(1e-5, form="primal")),
    "highs_simplex": (
        _dual(1e-7, _PRIMAL_SIMPLEX | {"simplex_scale_strategy": 0}, shares=True),
        _dual(1e-7, _PRIMAL_SIMPLEX, shares=True),
        Settings(1e-7, form="primal", shares=True),
    ),
    "highs_interior_point": (_dual(1e-5, {"presolve": "off"}, shares=True), _dual(1e-6, {"presolve": "off"})),
    "highs_pdlp": (_dual(1e-5),),
    "glop": (
        _dual(1e-7, _DUAL_SIMPLEX, shares=True),
        _dual(1e-7, _DUAL_SIMPLEX | {"use_preprocessing": "false"}, shares=True),
        Settings(1e-7, form="primal"),
    ),
    "ortools_pdlp": (_dual(1e-5, shares=True),),
    "mpax": (Settings(1e-5, form="primal", shares=True),),
}
SEED = 0
OUR_LANES = {"grid316": 8}  # what 24 GB hold
_DEFAULT_GAP = 1e-5  # of `jaxhom.lpal`, per step
_LEAST_TOLERANCE = 1e-10  # the least that HiGHS takes
_NO_OCCUPANCY = (1e-9, 1e-14)  # shares of all time that count as none: the better of two readings of x
_JUDGE_SHARE = 0.002  # of the gap asked, that the judge may add on either side: too little to decide a row
_PACKAGES = ("jax", "moreau", "clarabel", "highspy", "ortools", "mpax", "scipy")


def section(name: str, quick: bool, methods: list[str] | None, limit: float) -> Iterator[dict]:
    """All rows of an instance, with `jaxhom.lpal`'s default tolerance as the gap that is asked for, or its own."""
    instance, lanes = instances.LPAL[name], contest.QUICK_LANES if quick else OUR_LANES.get(name, contest.LANES)
    mdp, expectations = instance.draw(SEED, min(lanes, instance.most_lanes or lanes))
    model = Model.of(mdp)
    gap = (instance.gap or _DEFAULT_GAP) / (1.0 - model.discount) * abs(model.features).max()
    fields = {"instance": instance.title, "S": mdp.num_states, "A": mdp.num_actions, "K": mdp.num_features}
    fields |= {"dtype": "float64", "gap_asked": gap} | provenance(*_PACKAGES)

    def judge(answers: list) -> dict:
        worst = max(certified_gap(model, *pair, gap) for pair in zip(answers, expectations, strict=False))
        return {"gap_certified": worst if np.isfinite(worst) else None, "settled": float(worst <= gap)}

    problem = contest.Contest(fields, list(expectations), judge, _LEAST_TOLERANCE, quick, limit)
    del mdp  # its memory is for those who are measured
    options, has_batch = {"name": name, "tolerance": gap if instance.gap else None}, len(expectations) > 1
    ours = {key: ("ours:lpal", options | {"method": method}, has_batch) for key, method in OURS.items()}
    peers = {method: _peer(method, model) for method in CANDIDATES} if instance.has_peers else {}
    yield from contest.rows(problem, ours, peers, methods)


def _peer(method: str, model: Model) -> contest.Peer | None:
    def options(settings: Settings) -> dict:
        make = functools.partial(Lpal, model, settings.form, settings.shares)
        return {"method": method, "settings": settings, "make": make}

    if not lp_peers.is_installed(method):
        return None
    return contest.Peer(
        solver="lp_peers:Opened",
        package=lp_peers.PEERS[method][0],
        options=options,
        candidates=CANDIDATES[method],
        together=method == "moreau",
        is_hot=method == "highs_simplex",
        both_cores=method in lp_peers.USES_BOTH_CORES,
    )


# -------------------------------------------------------------------------------------------------------- certificate


def certified_gap(model: Model, answer, expectations: np.ndarray, gap: float) -> float:
    """Bound minus margin of an answer (x [S, A], w [K]); infinite if there is none."""
    if answer is None or not all(np.isfinite(part).all() and (part > 0).any() for part in answer):
        return np.inf
    x, w = (np.maximum(part, 0.0) for part in answer)
    w, enough = w / w.sum(), _JUDGE_SHARE * gap
    best, actions = model.most_value((model.features @ w).reshape(model.shape), enough)
    bound, fallback = best - w @ expectations, np.eye(model.shape[1])[actions]
    policies = [_policy_of(x, fallback, negligible) for negligible in _NO_OCCUPANCY]
    return bound - max((model.least_expectations(policy, enough) - expectations).min() for policy in policies)


def _policy_of(x: np.ndarray, fallback: np.ndarray, negligible: float) -> np.ndarray:
    """pi(s, a) = x(s, a) / sum_a' x(s, a'), [S, A]; `fallback` where the state hardly occurs."""
    total = x.sum(axis=-1, keepdims=True)
    occurs = total > negligible * total.sum()
    return np.where(occurs, x / np.where(occurs, total, 1.0), fallback)
