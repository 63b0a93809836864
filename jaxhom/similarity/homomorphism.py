"""Soft local homomorphisms: how well one state's local model maps onto another's.

LP (9) of Boularias and Chaib-draa 2010 gives every ordered pair of states an error e >= 0: the best a map f from
M^{s,d} to M^{s',d} can do at commuting with the transitions (`homomorphism_lp` states the program).
e = 0 means that f is an exact homomorphism.

As printed, the program can be empty of meaning: if the target has a distribution that is stationary under every
action, an absorbing state say, mapping everything there gives e = 0 whatever the source. `anchored=True` requires
in addition that the centre is mapped to the centre, which removes that solution; `anchored=False` is the program as
printed.

States whose local models are equal up to a renaming share every error, so one program per pair of classes is
solved, never one per pair of states.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.similarity import interior_point
from jaxhom.similarity.brackets import METHODS, LocalSimilarity, bracket_errors, suits_interior_point
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.local_models import (
    LocalModelClasses,
    LocalModelMaker,
    LocalModels,
    is_oversized,
    local_model_classes,
    model_rounding,
)
from jaxhom.solvers import pdhg
from jaxhom.solvers.first_order import first_order_only
from jaxhom.status import Status

_SMALL = 8  # local models up to this size share one padding
_ALIKE_GROUP = 4  # up to 2^4 states both models of a pair are padded alike
_CHUNK_LANES = 32  # of `homomorphism_error` under vmap
_CHUNK_BYTES = 256 * 2**20
_MAX_ITERATIONS = 100_000
_MAX_PRODUCTS = 2e11  # multiplications per pair: large models stop early, with the bounds they have
_MIN_ITERATIONS = 64
_TOO_LARGE = -2


def local_similarity(
    mdp: MDP,
    sources,
    targets,
    *,
    distance: int = 1,
    anchored: bool = True,
    tolerance: float = 1e-4,
    method: str = "auto",
    max_iterations: int = _MAX_ITERATIONS,
    progress: bool = False,
) -> LocalSimilarity:
    """Brackets the optimal error e of LP (9) for pairs of states, from M^{s,d} to M^{s',d}.

    Args:
      mdp: the model.
      sources: int [P], the state s of each pair.
      targets: int [P], its s'. The error is not symmetric.
      distance: d >= 1, the radius of the local models.
      anchored: require that the centre is mapped to the centre; False is the program as printed.
      tolerance: largest upper - lower to settle for.
      method: "pdhg"; "interior_point", for tight brackets of small models on a CPU (whatever it leaves open, PDHG
        finishes); or "auto", which chooses between them by the sizes and the tolerance.
      max_iterations: per pair, 100,000 if not given; a pair that needs more says so in `status` and keeps valid bounds.
      progress: show a progress bar.

    Returns:
      `LocalSimilarity`, in the order of the pairs.

    Raises:
      ValueError: if a state is out of range, the shapes differ, or an option is unknown.

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    mdp = as_model(mdp)
    _check_options(method, tolerance)
    sources, targets = _validated_pairs(mdp, sources, targets)
    classes, source_label, target_label = _classes_of_pairs(mdp, sources, targets, distance)
    solver = ClassSimilarity(
        mdp, classes, distance, anchored, tolerance, None, method=method, max_iterations=max_iterations
    )
    unique, position = np.unique(np.stack([source_label, target_label], 1), axis=0, return_inverse=True)
    bounds = solver.solve(unique, progress=progress)
    return jax.tree.map(lambda leaf: leaf[position.ravel()], bounds)


def locally_similar(
    mdp: MDP,
    sources,
    targets,
    threshold: float = 0.0,
    *,
    distance: int = 1,
    anchored: bool = True,
    mutual: bool = False,
    tolerance: float = 1e-4,
    progress: bool = False,
) -> np.ndarray:
    """Decides e <= threshold for pairs of states, stopping each pair as soon as its bounds settle it.

    A pair counts as similar if e <= threshold is proved up to the tolerance (upper <= threshold + tolerance), and
    as different if lower > threshold. Where both hold, the upper bound decides: within the band
    (threshold, threshold + tolerance] either answer is possible. A pair that is not settled after the iteration
    limit counts as different. Of local models that are equal to about 12 digits (6 in float32) one stands for all.

    Args:
      mdp: the model.
      sources: int [P], the state s of each pair.
      targets: int [P], its s'.
      threshold: epsilon >= 0.
      distance: d >= 1, as in `local_similarity`.
      anchored: as in `local_similarity`.
      mutual: require the error of both directions to be within the threshold.
      tolerance: width of the band.
      progress: show a progress bar.

    Returns:
      bool [P].

    Raises:
      ValueError: as `local_similarity`.

    Source: Boularias and Chaib-draa 2010, section V.
    """
    mdp = as_model(mdp)
    _check_options("auto", tolerance)
    if not threshold >= 0:
        raise ValueError(f"threshold must not be negative, got {threshold}")
    sources, targets = _validated_pairs(mdp, sources, targets)
    classes, source_label, target_label = _classes_of_pairs(mdp, sources, targets, distance)
    solver = ClassSimilarity(mdp, classes, distance, anchored, tolerance, threshold)
    return solver.decide(source_label, target_label, mutual=mutual, progress=progress)


class ClassSimilarity:
    """Errors between classes of local models, each pair solved at most once.

    Args:
      mdp: the model.
      classes: its states' classes.
      distance, anchored, tolerance: as in `local_similarity`.
      threshold: None to bracket errors, or epsilon to decide e <= epsilon.
      method, max_iterations: as in `local_similarity`.
    """

    def __init__(
        self,
        mdp: MDP,
        classes: LocalModelClasses,
        distance: int,
        anchored: bool,
        tolerance: float,
        threshold: float | None,
        *,
        method: str = "auto",
        max_iterations: int = _MAX_ITERATIONS,
    ):
        self.classes, self.anchored = classes, anchored
        self.tolerance, self.threshold = tolerance, threshold
        self.method, self.max_iterations = method, max_iterations
        self.rounding = model_rounding(mdp.dtype)
        self.num_solved = 0
        self._mdp, self.distance = mdp, distance
        self._maker = LocalModelMaker(mdp, distance)
        self._groups = _size_groups(classes.size)
        self._known = _PairTable(len(classes.representative), mdp.dtype)

    @property
    def num_undecided(self) -> int:
        """Pairs that were met and could not be settled; they count as different."""
        return int((self._known.bounds.status != Status.SOLVED).sum())

    def decide(self, sources, targets, *, mutual=False, progress=False) -> np.ndarray:
        """bool [P]: is e(source class, target class) <= threshold? Only pairs not met before are solved."""
        pairs = np.stack([sources, targets], axis=1).reshape(-1, 2)
        met = np.concatenate([pairs, pairs[:, ::-1]]) if mutual else pairs
        unknown = self._known.missing(met)
        if len(unknown):
            self._known.add(unknown, self.solve(unknown, progress=progress))
        similar = self._known.look_up(met).upper <= self.threshold + self.tolerance
        return similar[: len(pairs)] & similar[len(pairs) :] if mutual else similar

    def solve(self, pairs: np.ndarray, *, progress: bool = False) -> LocalSimilarity:
        """Bounds for different ordered pairs of classes [Q, 2]; a class against itself has an isomorphism."""
        count, dtype = len(pairs), self._mdp.dtype
        lower, upper = np.zeros(count, dtype), np.full(count, self.rounding, dtype)
        iterations, status = np.zeros((2, count), np.int32)
        groups = self._paddings(pairs)
        too_large = groups[:, 0] == _TOO_LARGE
        upper[too_large], status[too_large] = 1.0, Status.ITERATION_LIMIT
        self.num_solved += int((groups[:, 0] >= 0).sum())
        with tqdm(total=count, desc="similarity", unit="pair", leave=False, disable=not progress) as bar:
            bar.update(int((groups[:, 0] < 0).sum()))
            for group in np.unique(groups[groups[:, 0] >= 0], axis=0):
                (members,) = np.nonzero((groups == group).all(axis=1))
                width = max(self._width(side) for side in group)
                chunk = max(1, _CHUNK_BYTES // (width**2 * self._mdp.num_actions * self._mdp.dtype.itemsize))
                for start in range(0, len(members), chunk):
                    index = members[start : start + chunk]
                    # A class's models differ by that much. Decisions are about the one that stands for the class: in
                    # float32 the widening alone would exceed the tolerance.
                    slack = self.rounding * (2.0 + width) if self.threshold is None else 0.0
                    found = self._solve_group(pairs[index], group, slack, bar.update)
                    lower[index] = np.maximum(found.lower - slack, 0.0)
                    upper[index] = found.upper + slack
                    iterations[index] = found.iterations
                    status[index] = self._status(lower[index], upper[index], found.status)
        return LocalSimilarity(lower=lower, upper=upper, iterations=iterations, status=status)

    def _paddings(self, pairs: np.ndarray) -> np.ndarray:
        """The size groups [Q, 2] to which the models of each pair are padded; negative where there is nothing to solve.

        -1 for a class against itself, -2 where a model is too large. Both sides alike where they are small, so that few
        shapes are compiled; each to its own where one is large.
        """
        groups = self._groups[pairs]
        larger = groups.max(axis=1, keepdims=True)
        groups = np.where(larger <= _ALIKE_GROUP, larger, groups)
        too_large = is_oversized(self.classes.size, self._mdp.num_actions)[pairs].any(axis=1, keepdims=True)
        groups = np.where(too_large, _TOO_LARGE, groups)
        return np.where(pairs[:, :1] == pairs[:, 1:], -1, groups)

    def _solve_group(self, pairs: np.ndarray, group: np.ndarray, slack: float, update) -> LocalSimilarity:
        """Brackets for pairs [Q, 2] whose models are of the given size groups, good when widened by `slack`."""
        source, target = (self._models(size, side) for size, side in zip(group, pairs.T, strict=True))
        (_, n, num_actions, _), m = source.transition.shape, target.transition.shape[1]
        affordable = _MAX_PRODUCTS / (2.0 * num_actions * n * m * (n + m))
        return bracket_errors(
            source.transition,
            target.transition,
            source_size=self.classes.size[pairs[:, 0]],
            target_size=self.classes.size[pairs[:, 1]],
            source_labels=source.labels,
            target_labels=target.labels,
            anchored=self.anchored,
            tolerance=max(self.tolerance - 2.0 * slack, 0.5 * self.tolerance),
            threshold=None if self.threshold is None else self.threshold + slack,
            method=self.method,
            max_iterations=int(min(self.max_iterations, max(affordable, _MIN_ITERATIONS))),
            progress=update,
        )

    def _status(self, lower: np.ndarray, upper: np.ndarray, status: np.ndarray) -> np.ndarray:
        """The status of widened bounds; where the widening alone keeps them open, rounding is to blame."""
        is_open = upper - lower > self.tolerance
        if self.threshold is not None:
            is_open &= (lower <= self.threshold) & (upper > self.threshold + self.tolerance)
        blamed = np.where(status == Status.SOLVED, Status.STALLED, status)
        return np.where(is_open, blamed, Status.SOLVED)

    def _width(self, group: int) -> int:
        """States of the largest class up to a size group."""
        return int(self.classes.size[self._groups <= group].max())

    def _models(self, group: int, classes: np.ndarray) -> LocalModels:
        """The models of the given classes [Q], padded to the width of a size group."""
        different, position = np.unique(classes, return_inverse=True)
        models = self._maker.make(self.classes.representative[different], self._width(group))
        return jax.tree.map(lambda leaf: leaf[position], models)


class _PairTable:
    """What is known of ordered pairs of classes; only of those that have been met."""

    def __init__(self, num_classes: int, dtype):
        self._num_classes = num_classes
        self._keys = np.zeros(0, np.int64)
        numbers, counts = np.zeros(0, dtype), np.zeros(0, np.int32)
        self.bounds = LocalSimilarity(lower=numbers, upper=numbers, iterations=counts, status=counts)

    def missing(self, pairs: np.ndarray) -> np.ndarray:
        """Those of the pairs [P, 2] that are not here, each once."""
        keys = np.setdiff1d(self._key(pairs), self._keys)
        return np.stack(np.divmod(keys, self._num_classes), axis=1)

    def add(self, pairs: np.ndarray, bounds: LocalSimilarity) -> None:
        """Takes in pairs that are missing."""
        keys = np.concatenate([self._keys, self._key(pairs)])
        order = np.argsort(keys)
        self._keys = keys[order]
        self.bounds = jax.tree.map(lambda old, new: np.concatenate([old, new])[order], self.bounds, bounds)

    def look_up(self, pairs: np.ndarray) -> LocalSimilarity:
        """Bounds of pairs [P, 2] that are here."""
        place = np.searchsorted(self._keys, self._key(pairs))
        return jax.tree.map(lambda leaf: leaf[place], self.bounds)

    def _key(self, pairs: np.ndarray) -> np.ndarray:
        return pairs[:, 0].astype(np.int64) * self._num_classes + pairs[:, 1]


def homomorphism_error(
    source: jax.Array,
    target: jax.Array,
    *,
    source_labels: jax.Array | None = None,
    target_labels: jax.Array | None = None,
    anchored: bool = True,
) -> jax.Array:
    """The optimal error e of LP (9) between two small models, as a differentiable function of both.

    Args:
      source: [n, A, n], transition tensor with the centre as state 0; rows sum to 1, or to 0 where an action leads
        nowhere.
      target: [m, A, m], likewise.
      source_labels: [n, A, L], what the map has to keep besides the transitions, as given: e also bounds
        |l(i,a) - sum_k f(i,k) l'(k,a)|. Labels in [0, 1] weigh like probabilities. None, or for both models.
      target_labels: [m, A, L], likewise.
      anchored: require that the centre is mapped to the centre; False is the program as printed.

    Returns:
      Scalar e, to 1e-6 in float64 (1e-4 in float32); NaN, derivatives included, where 100,000 iterations do not bring
      the bounds that close. Works under `jit`, `vmap`, `grad` and `jvp`.

    Raises:
      ValueError: if the shapes do not fit, or on a second derivative.

    The derivative is the envelope theorem's, <y, (dT) f - f (dT')> at an optimal map f and an optimal dual y. Where
    either is not unique, e is only directionally differentiable and what is returned is the slope for the pair that
    the solver found; at e = 0 the dual y = 0 is optimal and the slope may be zero.

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    source, target = jnp.asarray(source), jnp.asarray(target)
    checks.require_model_pair(source, target)
    if (source_labels is None) != (target_labels is None):
        raise ValueError("source_labels and target_labels must be given together")
    labels = () if source_labels is None else _checked_labels(source, target, source_labels, target_labels)
    dtype = jnp.promote_types(jnp.result_type(source, target, *labels), jnp.float32)
    models = jax.tree.map(lambda array: array.astype(dtype), (source, target, labels))
    return _error(models, anchored)


def _checked_labels(source, target, source_labels, target_labels) -> tuple[jax.Array, jax.Array]:
    source_labels, target_labels = jnp.asarray(source_labels), jnp.asarray(target_labels)
    expected = f"[{source.shape[0]}, {source.shape[1]}, L]"
    fits = source_labels.ndim == 3 and source_labels.shape[:2] == source.shape[:2]
    checks.require_shape("source_labels", source_labels, expected, fits)
    expected = (*target.shape[:2], source_labels.shape[2])
    checks.require_shape("target_labels", target_labels, str(expected), target_labels.shape == expected)
    return source_labels, target_labels


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _error(models, anchored):
    return _optimal_pair(models, anchored)[0]


@_error.defjvp
def _(anchored, primals, tangents):
    (models,), ((source_dot, target_dot, labels_dot),) = primals, tangents
    message = "homomorphism_error has first derivatives only: the map and the dual point carry none"
    error, f, y = _optimal_pair(first_order_only(models, models, message), anchored)
    m = f.shape[1]
    change = jnp.einsum("iak,iaj,jk->", y[..., :m], source_dot, f)
    change -= jnp.einsum("iak,il,lak->", y[..., :m], f, target_dot)
    if labels_dot:
        own_dot, other_dot = labels_dot
        change += jnp.einsum("ial,ial->", y[..., m:], own_dot)
        change -= jnp.einsum("ial,ik,kal->", y[..., m:], f, other_dot)
    return error, change


@functools.partial(jax.jit, static_argnums=1)
def _optimal_pair(models, anchored) -> tuple[jax.Array, jax.Array, jax.Array]:
    """e, f [n, m] and y [n, A, m + L] of one instance; under vmap all instances share one batch."""

    @jax.custom_batching.custom_vmap
    def solve_batch(models):
        return _solve_in_chunks(models, anchored)

    @solve_batch.def_vmap
    def _merge_axes(axis_size, in_batched, models):
        def with_axis(array, is_batched):
            return array if is_batched else jnp.broadcast_to(array, (axis_size, *array.shape))

        models = jax.tree.map(with_axis, models, in_batched[0])
        lanes = models[0].shape[1]
        merged = solve_batch(jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), models))
        split = jax.tree.map(lambda a: a.reshape(axis_size, lanes, *a.shape[1:]), merged)
        return split, (True, True, True)

    return jax.tree.map(lambda leaf: leaf[0], solve_batch(jax.tree.map(lambda leaf: leaf[None], models)))


def _solve_in_chunks(models, anchored):
    """`_solve_batch` a few instances at a time: they fit into the cache, and wait for the slowest of the few."""
    lanes = len(models[0])
    if lanes <= _CHUNK_LANES:
        return _solve_batch(models, anchored)
    order = jnp.arange(-(-lanes // _CHUNK_LANES) * _CHUNK_LANES) % lanes  # the surplus repeats the first
    chunks = jax.tree.map(lambda array: array[order].reshape(-1, _CHUNK_LANES, *array.shape[1:]), models)
    found = jax.lax.map(lambda chunk: _solve_batch(chunk, anchored), chunks)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:lanes], found)


def _solve_batch(models, anchored):
    """[B, n, A, n], [B, m, A, m] and labels -> e [B], f [B, n, m], y [B, n, A, m + L]; NaN where it is not found."""
    source, target, labels = jax.tree.map(lambda leaf: jnp.moveaxis(jax.lax.stop_gradient(leaf), 0, -1), models)
    lanes = source.shape[-1]
    problem = HomomorphismProblem(
        source=source,
        target=target,
        source_size=jnp.full(lanes, len(source), jnp.int32),
        target_size=jnp.full(lanes, len(target), jnp.int32),
        anchored=anchored,
        **dict(zip(("source_labels", "target_labels"), labels, strict=False)),
    )
    for_lower, for_upper = problem.rounding()
    tolerance = 1e-6 if source.dtype == jnp.float64 else 1e-4
    # The bounds without their widening, which in float32 would be most of the gap.
    gap = 0.5 * tolerance + for_lower + for_upper

    def read(state, f, y):
        error = 0.5 * (jnp.maximum(state.lower + for_lower, 0.0) + state.upper - for_upper)
        found = (error, f, y)
        is_found = state.upper - state.lower <= gap
        return is_found, jax.tree.map(lambda leaf: jnp.where(is_found, leaf, jnp.nan), found)

    def by_pdhg(start=None):
        state = pdhg.solve(problem, pdhg.init(problem, start), tolerance=gap, max_iterations=_MAX_ITERATIONS)
        return read(state, state.best_primal, state.best_dual)[1]

    if suits_interior_point(source, target, tolerance):
        near = interior_point.solve(problem, tolerance=gap)
        point = near.f, near.plus - near.minus
        is_found, found = read(near, *point)

        def finish():
            return jax.tree.map(lambda one, other: jnp.where(is_found, one, other), found, by_pdhg(point))

        error, f, y = jax.lax.cond(is_found.all(), lambda: found, finish)
    else:
        error, f, y = by_pdhg()
    return error, jnp.moveaxis(f, -1, 0), jnp.moveaxis(y, -1, 0)


def _size_groups(sizes: np.ndarray) -> np.ndarray:
    """Group of each model: those up to `_SMALL` states together, then by powers of two."""
    return np.ceil(np.log2(np.maximum(sizes, _SMALL))).astype(int)


def _check_options(method: str, tolerance: float) -> None:
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")


def _validated_pairs(mdp: MDP, sources, targets) -> tuple[np.ndarray, np.ndarray]:
    arrays = []
    for name, states in (("sources", sources), ("targets", targets)):
        states = checks.as_host_array(name, states)
        checks.require_shape(name, states, "[P]", states.ndim == 1)
        arrays.append(checks.require_integers(name, states, upper=mdp.num_states))
    checks.require_shape("targets", arrays[1], str(arrays[0].shape), len(arrays[0]) == len(arrays[1]))
    return arrays[0], arrays[1]


def _classes_of_pairs(mdp, sources, targets, distance):
    """Classes of the states that occur, and the label of each source and target."""
    states, position = np.unique(np.concatenate([sources, targets]), return_inverse=True)
    classes = local_model_classes(mdp, states, distance)
    labels = classes.label[position]
    return classes, labels[: len(sources)], labels[len(sources) :]
