"""Models from matrices and from samples, against plain loops and integrals."""

import re

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.sparse
import scipy.stats
import small_models
from small_models import dense_transition

from jaxhom.interop import ImportReport, SampledModel, from_gymnasium, from_mdptoolbox, from_samples, from_scipy

# ------------------------------------------------------------------------------------- matrices


def action_first(transition):
    return np.moveaxis(transition, 1, 0)


def object_array(matrices):
    array = np.empty(len(matrices), object)
    array[:] = matrices
    return array


TOOLBOX = {
    "array": action_first,
    "nested lists": lambda transition: action_first(transition).tolist(),
    "matrices": lambda transition: list(action_first(transition)),
    "csr": lambda transition: [scipy.sparse.csr_array(matrix) for matrix in action_first(transition)],
    "objects": lambda transition: object_array(
        [scipy.sparse.csc_matrix(matrix) for matrix in action_first(transition)]
    ),
    "mixed": lambda transition: (scipy.sparse.coo_array(transition[:, 0]), *action_first(transition)[1:]),
}


@pytest.mark.parametrize("layout", TOOLBOX)
@pytest.mark.parametrize("name", ["dense", "sparse", "restart", "one_state"])
def test_mdptoolbox_layouts(name, layout):
    case = small_models.case(name)
    mdp = from_mdptoolbox(
        TOOLBOX[layout](case.transition), discount=case.discount, initial=case.initial, features=case.features
    )
    np.testing.assert_allclose(dense_transition(mdp), case.transition, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(mdp.initial, case.initial)
    np.testing.assert_array_equal(mdp.features, case.features)
    assert mdp.is_dense == case.mdp.is_dense and float(mdp.discount) == case.discount


@pytest.mark.parametrize("kind", ["csr_array", "csr_matrix", "coo_array", "lil_matrix"])
@pytest.mark.parametrize("name", ["dense", "sparse", "restart"])
def test_scipy_rows_are_pairs_actions_of_a_state_together(name, kind):
    case = small_models.case(name)
    matrix = getattr(scipy.sparse, kind)(case.transition.reshape(-1, case.shape[0]))
    mdp = from_scipy(matrix, discount=case.discount, features=case.features)
    np.testing.assert_allclose(dense_transition(mdp), case.transition, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(mdp.features, case.features)


@pytest.mark.parametrize("rest", [0.0, np.nan, 7.0])
def test_rows_of_actions_that_do_not_exist_are_not_looked_at(rest):
    """Dense, sparse and pair by pair: what stands in such rows is nobody's business, and they end up empty."""
    case = small_models.case("sparse")
    allowed = np.ones(case.transition.shape[:2], bool)
    allowed[1, 0] = allowed[4, 1:] = False
    given = np.where(allowed[..., None], case.transition, rest)
    pairs = scipy.sparse.csr_array(given.reshape(-1, len(given)))
    layouts = {name: TOOLBOX[name](given) for name in ("array", "csr", "mixed")}
    options = {"discount": 0.9, "features": case.features, "allowed": allowed}
    for mdp in (*(from_mdptoolbox(layout, **options) for layout in layouts.values()), from_scipy(pairs, **options)):
        np.testing.assert_array_equal(mdp.allowed, allowed)
        np.testing.assert_allclose(dense_transition(mdp), np.where(allowed[..., None], case.transition, 0), atol=1e-15)
    for wrong, message in ((allowed.T, "allowed must have shape"), (allowed * 1.0, "allowed must be bool")):
        for build, transitions in ((from_mdptoolbox, layouts["array"]), (from_scipy, pairs)):
            with pytest.raises(ValueError, match=message):
                build(transitions, discount=0.9, allowed=wrong)


def test_duplicates_add_up_zeros_vanish_and_the_matrix_is_left_alone():
    entries = np.array([0.25, 0.25, 0.5, 0.0, 1.0], np.float32)
    matrix = scipy.sparse.csr_array((entries, [1, 1, 0, 2, 2], [0, 4, 5, 5]), shape=(3, 3)).tocsr()
    matrix = scipy.sparse.vstack([matrix[:2], matrix[1:2]], format="csr")
    before = matrix.copy()
    mdp = from_scipy(matrix, discount=0.9)
    np.testing.assert_array_equal(dense_transition(mdp)[:, 0], [[0.5, 0.5, 0], [0, 0, 1], [0, 0, 1]])
    assert mdp.dtype == np.float32
    for name in ("data", "indices", "indptr"):
        np.testing.assert_array_equal(getattr(matrix, name), getattr(before, name))


def test_a_large_sparse_model_stays_sparse():
    num_states = 50_000
    ring = scipy.sparse.csr_array(
        (np.ones(num_states), (np.arange(num_states), (np.arange(num_states) + 1) % num_states))
    )
    mdp = from_mdptoolbox([ring, ring.T], discount=0.9)
    assert mdp.probability.shape == (num_states, 2, 1)
    np.testing.assert_array_equal(mdp.next_state[[0, 7, 49_999], :, 0], [[1, 49_999], [8, 6], [0, 49_998]])


def test_rows_too_wide_for_the_indices_are_refused_before_they_are_made():
    """50000 states, one of which can go anywhere: 2.5e9 padded slots, which would take 30 GB."""
    num_states = 50_000
    identity = scipy.sparse.csr_array((np.ones(num_states - 1), (np.arange(1, num_states), np.arange(1, num_states))))
    wide = scipy.sparse.csr_array(np.full((1, num_states), 1.0 / num_states))
    matrix = scipy.sparse.vstack([wide, identity[1:]], format="csr")
    with pytest.raises(ValueError, match=r"50000 x 1 x 50000 successor slots .* more than 2\^31 - 2"):
        from_scipy(matrix, discount=0.9)


def edited(index, value):
    """Two actions in three states, one number changed, as arrays and as sparse matrices."""
    array = np.tile(np.full((3, 3), 1.0 / 3.0), (2, 1, 1))
    array[index] = value
    return array


BAD_TOOLBOX = [
    (edited((1, 2, 0), np.nan), "transitions[1, 2, 0] must be finite", "transitions[1] row 2, column 0 must be finite"),
    (
        edited((0, 1, 2), -0.5),
        "transitions[0, 1, 2] must not be negative, got -0.5",
        "transitions[0] row 1, column 2 must not be negative, got -0.5",
    ),
    (
        edited((1, 1, 1), 1 / 3 + 0.1),
        "sum of transitions[1, 1] must be 1, got 1.09",
        "transitions[1] row 1 must sum to 1, got 1.09",
    ),
    (edited((1, 0), 0.0), "sum of transitions[1, 0] must be 1, got 0", "transitions[1] row 0 must sum to 1, got 0.0"),
    (
        np.ones((2, 3, 2)) / 2,
        "transitions must have shape [A, S, S]",
        "transitions[0] must have shape (3, 3) with at least one state, got (3, 2)",
    ),
    (np.ones((2, 0, 0)), "transitions must have shape [A, S, S]", "with at least one state, got (0, 0)"),
]


@pytest.mark.parametrize(("array", "dense_message", "sparse_message"), BAD_TOOLBOX)
def test_bad_transitions_name_action_and_state(array, dense_message, sparse_message):
    with pytest.raises(ValueError, match=re.escape(dense_message)):
        from_mdptoolbox(array, discount=0.9)
    with pytest.raises(ValueError, match=re.escape(sparse_message)):
        from_mdptoolbox([scipy.sparse.coo_array(matrix) for matrix in array], discount=0.9)


@pytest.mark.parametrize(
    ("transitions", "message"),
    [
        ([], "transitions must have shape [A, S, S]"),
        (None, "transitions must have shape [A, S, S]"),
        (np.array(None), "transitions must have shape [A, S, S]"),
        (scipy.sparse.eye_array(3), "one sparse matrix is for from_scipy"),
        ([scipy.sparse.eye_array(3), np.eye(2)], "transitions[1] must have shape (3, 3)"),
        ([scipy.sparse.eye_array(3), 1.0], "transitions[1] must have shape (3, 3)"),
        ([scipy.sparse.eye_array(3, dtype=complex)], "transitions[0] must hold real numbers, got dtype complex128"),
        ([np.eye(2), np.eye(3)], "transitions is not a rectangular array"),
    ],
)
def test_what_is_no_list_of_matrices_is_refused(transitions, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        from_mdptoolbox(transitions, discount=0.9)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "matrix must be a SciPy sparse matrix, got ndarray"),
        (scipy.sparse.coo_array((3, 2)), "matrix must have shape (S * A, S) with S, A >= 1, got (3, 2)"),
        (scipy.sparse.coo_array((0, 2)), "got (0, 2)"),
        (scipy.sparse.coo_array(np.ones(3)), "got (3,)"),
        (scipy.sparse.coo_array((4, 2)), "matrix row 0 (state 0, action 0) must sum to 1, got 0.0"),
        (
            scipy.sparse.coo_array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.5, -0.5]]),
            "matrix row 3 (state 1, action 1), column 1 must not be negative, got -0.5",
        ),
        (
            scipy.sparse.coo_array([[1.0, 0.0], [np.inf, 0.0]]),
            "matrix row 1 (state 1, action 0), column 0 must be finite",
        ),
    ],
)
def test_bad_matrices_name_the_row(matrix, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        from_scipy(matrix, discount=0.9)


# -------------------------------------------------------------------------------------- samples

# Pair (0, 0) saw 1, 1, 2, 1; pair (0, 1) saw 0 once; pair (2, 0) saw 0 and 3; everything else is unvisited.
STATES = [0, 0, 2, 0, 0, 2, 0]
ACTIONS = [0, 0, 0, 0, 1, 0, 0]
NEXT_STATES = [1, 1, 0, 2, 0, 3, 1]
SIZES = {"num_states": 4, "num_actions": 2, "discount": 0.9}


def slow_rows(prior, support):
    """Rows, counts and both uncertainties by loops and integrals over beta distributions."""
    rows, count, l1, square = np.zeros((4, 2, 4)), np.zeros((4, 2)), np.zeros((4, 2)), np.zeros((4, 2))
    for s, a in np.ndindex(4, 2):
        seen = [z for i, z in enumerate(NEXT_STATES) if (STATES[i], ACTIONS[i]) == (s, a)]
        classes = range(4) if support == "all" else sorted(set(seen))
        weights = [seen.count(z) + prior for z in classes]
        count[s, a] = len(seen)
        if not weights:
            rows[s, a, s], l1[s, a], square[s, a] = 1.0, 2.0, 2.0
            continue
        chances = [weight / sum(weights) for weight in weights]
        rows[s, a, list(classes)] = chances
        if support == "observed" and prior > 0:  # elsewhere
            weights, chances = [*weights, prior], [*chances, 0.0]
        for weight, chance in zip(weights, chances, strict=True):
            rest = sum(weights) - weight
            if rest > 0:
                draw = scipy.stats.beta(weight, rest)
                below = scipy.integrate.quad(draw.cdf, 0.0, chance)[0]
                l1[s, a] += below + scipy.integrate.quad(draw.sf, chance, 1.0)[0]
                square[s, a] += draw.var() + (draw.mean() - chance) ** 2
    return rows, count, l1, np.sqrt(square)


@pytest.mark.parametrize(
    ("prior", "support"), [(0.0, "observed"), (0.5, "observed"), (2.0, "observed"), (0.25, "all"), (1.0, "all")]
)
def test_rows_and_their_uncertainty(prior, support):
    model = from_samples(STATES, ACTIONS, NEXT_STATES, **SIZES, prior=prior, support=support)
    rows, count, l1, deviation = slow_rows(prior, support)
    np.testing.assert_allclose(dense_transition(model.mdp), rows, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(model.count, count)
    np.testing.assert_allclose(model.expected_l1_error, l1, rtol=0, atol=1e-7)
    np.testing.assert_allclose(model.standard_deviation, deviation, rtol=0, atol=1e-12)


def test_a_row_seen_once_is_not_certain_and_one_never_seen_knows_nothing():
    model = from_samples(STATES, ACTIONS, NEXT_STATES, **SIZES)
    error = np.asarray(model.expected_l1_error)
    assert error[1, 1] == 2.0 > error[0, 1] > error[0, 0] > 0.0
    np.testing.assert_array_equal(dense_transition(model.mdp)[1, 1], np.eye(4)[1])


def test_uncertainty_is_calibrated():
    """Rows drawn from the prior: the mean error of 4000 estimates is the mean of what was expected."""
    rng = np.random.default_rng(0)
    truth = rng.dirichlet(np.ones(4), size=(4, 1000))
    successors = np.array([[rng.choice(4, size=5, p=row) for row in rows] for rows in truth])
    states, actions, _ = np.indices(successors.shape)
    model = from_samples(
        states.ravel(),
        actions.ravel(),
        successors.ravel(),
        num_states=4,
        num_actions=1000,
        discount=0.9,
        prior=1.0,
        support="all",
    )
    error = np.abs(truth - dense_transition(model.mdp))
    surprise = error.sum(-1) - np.asarray(model.expected_l1_error)
    assert abs(surprise.mean()) < 4 * surprise.std() / np.sqrt(surprise.size)
    surprise = (error**2).sum(-1) - np.asarray(model.standard_deviation) ** 2
    assert abs(surprise.mean()) < 4 * surprise.std() / np.sqrt(surprise.size)


def test_a_million_samples_are_counted_and_close_to_the_truth():
    case = small_models.case("dense")
    rng = np.random.default_rng(1)
    num_states, num_actions = case.shape
    states, actions = rng.integers(num_states, size=1_000_000), rng.integers(num_actions, size=1_000_000)
    below = np.cumsum(case.transition, axis=-1)[states, actions]
    successors = np.minimum((rng.random((1_000_000, 1)) > below).sum(axis=-1), num_states - 1)
    model = from_samples(
        states.astype(np.uint8), actions.astype(float), successors, num_states=7, num_actions=3, discount=0.9
    )
    assert int(model.count.sum()) == 1_000_000
    error = np.abs(dense_transition(model.mdp) - case.transition).sum(axis=-1)
    assert error.max() < 3 * np.asarray(model.expected_l1_error).max() < 0.05


def test_one_state_is_certain_and_models_are_pytrees():
    model = from_samples([0], [0], [0], num_states=1, num_actions=2, discount=0.9)
    np.testing.assert_array_equal(model.expected_l1_error, [[0.0, 0.0]])
    assert isinstance(jax.tree.map(lambda leaf: leaf, model), SampledModel)


def test_initial_and_features_are_passed_on():
    features, initial = np.arange(12.0).reshape(4, 3), np.eye(4)[2]
    for support in ("observed", "all"):
        model = from_samples(STATES, ACTIONS, NEXT_STATES, **SIZES, support=support, initial=initial, features=features)
        np.testing.assert_array_equal(model.mdp.initial, initial)
        np.testing.assert_array_equal(model.mdp.features[:, 1], features)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": []}, "states must have shape [T] with T >= 1, got (0,)"),
        ({"states": [[0, 1]]}, "states must have shape [T] with T >= 1, got (1, 2)"),
        ({"actions": [0, 1]}, "actions must have shape (7,) like states, got (2,)"),
        ({"next_states": NEXT_STATES[:-1] + [4]}, "next_states[6] must be below 4, got 4"),
        ({"actions": [0, -1] + ACTIONS[2:]}, "actions[1] must not be negative, got -1"),
        ({"states": [0.5] * 7}, "states[0] must be whole, got 0.5"),
        ({"states": ["a"] * 7}, "states must hold integers, got dtype <U1"),
        ({"num_states": 0}, "num_states must be at least 1, got 0"),
        ({"num_actions": 2.0}, "num_actions must be a whole number, got 2.0"),
        ({"discount": 1.0}, "discount must lie strictly between 0 and 1, got 1.0"),
        ({"prior": -1.0}, "prior must be at least 0, got -1.0"),
        ({"prior": np.nan}, "prior must be finite, got nan"),
        ({"prior": [1.0]}, "prior must have shape (), got (1,)"),
        ({"prior": 0.0, "support": "all"}, "prior must be positive, got 0.0"),
        ({"support": "seen"}, "support must be one of observed, all, got 'seen'"),
        ({"num_states": 40_000, "support": "all"}, "40000 x 2 x 40000 successor slots"),
        ({"num_states": 2**31}, "2147483648 x 2 x 1 successor slots"),
    ],
)
def test_bad_samples_are_refused(changes, message):
    arguments = {"states": STATES, "actions": ACTIONS, "next_states": NEXT_STATES, **SIZES, **changes}
    columns = [arguments.pop(name) for name in ("states", "actions", "next_states")]
    with pytest.raises(ValueError, match=re.escape(message)):
        from_samples(*columns, **arguments)


def test_results_are_short_when_printed():
    lake = from_gymnasium("FrozenLake-v1", discount=0.99)
    estimate = from_samples([0, 0], [0, 0], [1, 0], num_states=2, num_actions=1, discount=0.9)
    report = ImportReport(episodes=1, steps=2, final_observations=0, dropped=((1, "it has no actions"),) * 100)
    for result, parts in (
        (lake, ["GymnasiumModel(", "num_states=16", "reward=float64[16,4]", "terminal=bool[16]"]),
        (estimate, ["SampledModel(", "num_states=2", "count=int32[2,1]"]),
        (report, ["ImportReport(episodes=1, steps=2, final_observations=0, dropped="]),
    ):
        assert all(part in repr(result) for part in parts) and len(repr(result)) < 400, repr(result)
