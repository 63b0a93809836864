"""Constructors, importers and files under random input: the right result, or one `ValueError` of one line.

Valid input is drawn and compared with NumPy; then one thing is made wrong, and must be refused; then anything at all
is passed in, and nothing but a `ValueError` may come out.
"""

import io
import itertools
import pathlib
import tempfile
import types

import hypothesis
import numpy as np
import pytest
import scipy.sparse
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_models import dense_transition

from jaxhom import interop
from jaxhom.domains.track_maps import read_map
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP

few = hypothesis.settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
)


def one_line(function, *args, **kwargs):
    """The message of the `ValueError` that must come."""
    with pytest.raises(ValueError) as raised:
        function(*args, **kwargs)
    message = str(raised.value)
    assert message and "\n" not in message
    return message


def result_or_one_line(function, *args, **kwargs):
    """The result, or None after a `ValueError` of one line."""
    try:
        return function(*args, **kwargs)
    except ValueError as error:
        assert str(error) and "\n" not in str(error)
        return None


# ---------------------------------------------------------------------------------------- models


@st.composite
def transitions(draw, max_states=9):
    """[S, A, S] of probabilities k / n, many of them 0; some states are reached by nothing."""
    num_states, num_actions = draw(st.integers(1, max_states)), draw(st.integers(1, 3))
    shape = (num_states, num_actions, num_states)
    weights = draw(hnp.arrays(np.int64, shape, elements=st.integers(0, 3), fill=st.just(0)))
    weights[..., 0] += weights.sum(axis=-1) == 0
    return weights / weights.sum(axis=-1, keepdims=True)


@st.composite
def successors(draw, transition):
    """The same model as lists: any order, successors repeated, padded with anything."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    num_states, num_actions, _ = transition.shape
    width = 2 * num_states + draw(st.integers(0, 2))
    next_state = rng.integers(num_states, size=(num_states, num_actions, width))
    probability = np.zeros(next_state.shape)
    next_state[..., : 2 * num_states] = np.tile(np.arange(num_states), 2)
    probability[..., : 2 * num_states] = np.tile(transition, 2) / 2
    order = rng.permuted(np.broadcast_to(np.arange(width), next_state.shape), axis=-1)
    return np.take_along_axis(next_state, order, -1), np.take_along_axis(probability, order, -1)


@few
@hypothesis.given(st.data(), transitions(), st.floats(0.01, 0.99), st.sampled_from([np.float32, np.float64]))
def test_every_door_makes_the_same_model(data, transition, discount, dtype):
    num_states, num_actions, _ = transition.shape
    options = {"discount": discount, "features": transition[:, 0], "initial": transition[0, 0]}
    next_state, probability = data.draw(successors(transition))
    rows = scipy.sparse.coo_array(transition.reshape(-1, num_states).astype(dtype))
    by_action = [scipy.sparse.csc_array(transition[:, a].astype(dtype)) for a in range(num_actions)]
    models = [
        MDP.from_dense(transition.astype(dtype), **options),
        MDP.from_successors(next_state, probability.astype(dtype), **options),
        interop.from_scipy(rows, **options),
        interop.from_mdptoolbox(by_action, **options),
        interop.from_mdptoolbox(np.moveaxis(transition, 1, 0).astype(dtype), **options),
    ]
    for mdp in models:
        assert mdp.dtype == dtype
        np.testing.assert_allclose(dense_transition(mdp), transition, rtol=0, atol=4 * np.finfo(dtype).eps)
        np.testing.assert_array_equal(mdp.initial, transition[0, 0].astype(dtype))
        np.testing.assert_array_equal(mdp.features[:, -1], transition[:, 0].astype(dtype))
        assert mdp.discount == dtype(discount)


@few
@hypothesis.given(st.data(), transitions())
def test_every_door_refuses_one_bad_entry(data, transition):
    """NaN, infinity, a negative entry, a row that sums to 1.1: the state and the action are named."""
    num_states, num_actions, _ = transition.shape
    s, a, z = (data.draw(st.integers(0, size - 1)) for size in transition.shape)
    broken = transition.copy()
    kind = data.draw(st.sampled_from(["nan", "inf", "negative", "sum"]))
    broken[s, a, z] += {"nan": np.nan, "inf": np.inf, "negative": -2.0, "sum": 0.1}[kind]
    said = {"nan": "finite", "inf": "finite", "negative": "negative", "sum": "sum"}[kind]
    width = np.broadcast_to(np.arange(num_states), broken.shape)
    place = f"[{s}, {a}" + ("]" if kind == "sum" else f", {z}]")
    for function, args in ((MDP.from_dense, (broken,)), (MDP.from_successors, (width, broken))):
        message = one_line(function, *args, discount=0.9)
        assert said in message and place in message
    message = one_line(interop.from_mdptoolbox, np.moveaxis(broken, 1, 0), discount=0.9)
    assert said in message and f"[{a}, {s}" in message
    matrices = [scipy.sparse.coo_array(broken[:, action]) for action in range(num_actions)]
    message = one_line(interop.from_mdptoolbox, matrices, discount=0.9)
    assert said in message and f"transitions[{a}] row {s}" in message
    message = one_line(interop.from_scipy, scipy.sparse.csr_array(broken.reshape(-1, num_states)), discount=0.9)
    assert said in message and f"(state {s}, action {a})" in message


@few
@hypothesis.given(st.data(), transitions())
def test_successors_that_do_not_exist_are_refused(data, transition):
    next_state, probability = data.draw(successors(transition))
    place = tuple(data.draw(st.integers(0, size - 1)) for size in next_state.shape)
    wrong = data.draw(st.sampled_from([-1, len(transition), 2**31, 2**53, 2**62, 0.5, np.nan]))
    array = next_state.astype(float if isinstance(wrong, float) else np.int64)
    array[place] = wrong
    message = one_line(MDP.from_successors, array, probability, discount=0.9)
    assert f"next_state{list(place)}" in message


@few
@hypothesis.given(st.data(), transitions(max_states=4))
def test_arrays_of_another_shape_are_refused(data, transition):
    """Every argument with one axis changed, dropped or added."""
    num_states, num_actions, _ = transition.shape
    good = {"initial": np.full(num_states, 1 / num_states), "features": np.zeros((num_states, num_actions, 2))}
    name = data.draw(st.sampled_from(["transition", "initial", "features", "discount"]))
    array = {"transition": transition, "discount": np.array(0.9), **good}[name]
    hypothesis.assume(name != "features" or num_states != num_actions)  # else [S, K] of another K is meant
    change = data.draw(st.sampled_from(["add"] if name == "discount" else ["drop", "add", "widen", "empty"]))
    if change == "drop":
        array = array[0]
    elif change == "add":
        array = array[None]
    else:
        array = array[:0] if change == "empty" else np.concatenate([array, array[:1]])
    options = {"discount": 0.9, name: array}
    message = one_line(MDP.from_dense, options.pop("transition", transition), **options)
    assert message.startswith(f"{name} must have shape")


@few
@hypothesis.given(
    st.one_of(st.floats(), st.sampled_from([0.0, 1.0, -0.0, 5e-324, 1 - 2**-53, 1 - 2**-24, 1 - 2**-25, 1e-45])),
    st.sampled_from([np.float16, np.float32, np.float64]),
)
def test_discounts_lie_inside_in_the_models_type_or_are_refused(discount, dtype):
    transition = np.ones((1, 1, 1), dtype)
    if 0.0 < discount < 1.0 and 0.0 < dtype(discount) < 1.0:
        assert MDP.from_dense(transition, discount=discount).discount == dtype(discount)
    else:
        assert one_line(MDP.from_dense, transition, discount=discount).startswith("discount must")


# --------------------------------------------------------------------------------- trajectories

INDEX = st.one_of(st.integers(0, 5), st.integers(0, 2**31 - 2))


@st.composite
def episodes(draw, min_size=1):
    """(states, actions) pairs as lists, ragged; many have one step."""
    lengths = draw(st.lists(st.integers(1, 5), min_size=min_size, max_size=4))
    return [tuple(draw(st.lists(INDEX, min_size=n, max_size=n)) for _ in "sa") for n in lengths]


def unpadded(demonstrations):
    arrays = (np.asarray(array) for array in (demonstrations.states, demonstrations.actions, demonstrations.mask))
    return [(s[m].tolist(), a[m].tolist()) for s, a, m in zip(*arrays, strict=True)]


@few
@hypothesis.given(st.data(), episodes(), st.sampled_from([list, np.array, np.float64, np.uint32]))
def test_every_door_reads_the_same_trajectories(data, pairs, make):
    converted = [tuple(make(column) for column in pair) for pair in pairs]
    assert unpadded(Demonstrations.from_trajectories(converted)) == pairs
    last = data.draw(st.sampled_from([[], [3]]))
    recorded = [types.SimpleNamespace(obs=make([*states, *last]), acts=make(actions)) for states, actions in pairs]
    demonstrations, report = interop.demonstrations_from_episodes(recorded)
    assert unpadded(demonstrations) == pairs
    assert report.final_observations == len(pairs) * len(last) and report.steps == sum(len(s) for s, _ in pairs)
    rows = [(i, s, a) for i, pair in enumerate(pairs) for s, a in zip(*pair, strict=True)]
    demonstrations, _ = interop.demonstrations_from_steps(*zip(*rows, strict=True))
    assert unpadded(demonstrations) == pairs
    rows += [(i, state, "") for i in range(len(pairs)) for state in last]
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "steps.csv"
        path.write_text("".join(f"{e},{s},{a}\n" for e, s, a in [("episode", "state", "action"), *rows]))
        demonstrations, csv_report = interop.demonstrations_from_csv(path)
    assert unpadded(demonstrations) == pairs and csv_report == report


@few
@hypothesis.given(st.data(), episodes(), st.sampled_from([-1, 0.5, np.nan, np.inf, 2**31 - 1, 2**62, 1e300]))
def test_every_door_refuses_one_bad_step(data, pairs, wrong):
    i = data.draw(st.integers(0, len(pairs) - 1))
    column, t = data.draw(st.integers(0, 1)), data.draw(st.integers(0, len(pairs[i][0]) - 1))
    pairs = [tuple(map(list, pair)) for pair in pairs]
    pairs[i][column][t] = wrong
    message = one_line(Demonstrations.from_trajectories, pairs)
    assert f"trajectory {i} {('states', 'actions')[column]}[{t}]" in message
    result = result_or_one_line(interop.demonstrations_from_episodes, pairs)
    assert (result is None) == (len(pairs) == 1)
    if result is not None:
        demonstrations, report = result
        assert unpadded(demonstrations) == pairs[:i] + pairs[i + 1 :]
        assert [position for position, _ in report.dropped] == [i]


# --------------------------------------------------------------------------------------- samples


@few
@hypothesis.given(
    st.data(), st.integers(1, 4), st.integers(1, 3), st.floats(0.0, 100.0), st.sampled_from(["observed", "all"])
)
def test_sampled_rows_are_distributions_with_the_mode_of_the_counts(data, num_states, num_actions, prior, support):
    sizes = (num_states, num_actions, num_states)
    steps = data.draw(st.lists(st.tuples(*(st.integers(0, n - 1) for n in sizes)), min_size=1, max_size=12))
    prior = max(prior, 1e-3) if support == "all" else prior
    columns = np.array(steps).T
    model = interop.from_samples(
        *columns, num_states=num_states, num_actions=num_actions, discount=0.9, prior=prior, support=support
    )
    counts = np.zeros(sizes)
    np.add.at(counts, tuple(columns), 1)
    np.testing.assert_array_equal(model.count, counts.sum(axis=-1))
    transition = dense_transition(model.mdp)
    np.testing.assert_allclose(transition.sum(axis=-1), 1.0, rtol=0, atol=1e-12)
    for s, a in np.ndindex(num_states, num_actions):
        order = np.argsort(counts[s, a], kind="stable")
        if counts[s, a].any():
            assert np.all(np.diff(transition[s, a, order]) >= -1e-15)
    l1, deviation = np.asarray(model.expected_l1_error), np.asarray(model.standard_deviation)
    assert np.all((l1 >= 0.0) & (l1 <= 2.0)) and np.all(deviation <= np.sqrt(2.0))
    # Norms: |x|_2^2 <= |x|_1^2 <= 2 |x|_1 here, and |x|_1 <= sqrt(classes) |x|_2.
    assert np.all(deviation**2 <= 2.0 * l1 + 1e-9) and np.all(l1 <= np.sqrt(num_states + 1) * deviation + 1e-9)


# ------------------------------------------------------------------------------------- anything

SCALAR = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 3), st.integers(), st.floats(), st.text(max_size=3), st.binary(max_size=3)
)
ANYTHING = st.one_of(
    SCALAR,
    st.recursive(
        SCALAR,
        lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.integers(0, 2), inner, max_size=3)),
    ),
    hnp.arrays(
        st.one_of(hnp.floating_dtypes(), hnp.integer_dtypes(), hnp.complex_number_dtypes(), st.just(np.dtype(bool))),
        hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=3),
    ),
)

_RING = MDP.from_dense(np.eye(2)[[[0, 1], [1, 0]]], discount=0.9)
DOORS = {
    "from_dense": lambda x, y: MDP.from_dense(x, discount=0.9, features=y),
    "from_dense, discount and initial": lambda x, y: MDP.from_dense(np.ones((1, 1, 1)), discount=x, initial=y),
    "from_successors": lambda x, y: MDP.from_successors(x, y, discount=0.9),
    "from_trajectories": lambda x, y: Demonstrations.from_trajectories(x),
    "from_trajectories, one": lambda x, y: Demonstrations.from_trajectories([(x, y)]),
    "from_mdptoolbox": lambda x, y: interop.from_mdptoolbox(x, discount=0.9),
    "from_mdptoolbox, list": lambda x, y: interop.from_mdptoolbox([scipy.sparse.eye_array(1), x], discount=0.9),
    "from_scipy": lambda x, y: interop.from_scipy(x, discount=0.9),
    "from_samples": lambda x, y: interop.from_samples(x, y, x, num_states=2, num_actions=2, discount=0.9),
    "from_samples, sizes": lambda x, y: interop.from_samples(
        [0], [0], [0], num_states=3 if isinstance(x, int) and x > 9 else x, num_actions=1, discount=0.9, support=y
    ),
    "from_samples, prior": lambda x, y: interop.from_samples(
        [0], [0], [1], num_states=2, num_actions=1, discount=0.9, prior=x, support="all" if y else "observed"
    ),
    "from_samples, anything": lambda x, y: interop.from_samples(x, y, x, discount=0.9),
    "from_samples, ends": lambda x, y: interop.from_samples(
        [0, 1], [0, 0], [1, 0], discount=0.9, rewards=x, terminated=y, end_state=True
    ),
    "demonstrations_from": lambda x, y: interop.demonstrations_from(x),
    "demonstrations_from, table": lambda x, y: interop.demonstrations_from({"obs": x, "act": y, "episode": x}),
    "demonstrations_from, flags": lambda x, y: interop.demonstrations_from(
        {"s": [0, 1], "a": [0, 0], "done": x, "t": y}
    ),
    "demonstrations_from, states": lambda x, y: interop.demonstrations_from({"s": x, "run": y}, mdp=_RING),
    "demonstrations_from_states": lambda x, y: interop.demonstrations_from_states(_RING, x),
    "demonstrations_from_states, one": lambda x, y: interop.demonstrations_from_states(_RING, [x], ambiguous=y),
    "from_gymnasium": lambda x, y: interop.from_gymnasium(x if not isinstance(x, str) else None, discount=0.9),
    "from_gymnasium, table": lambda x, y: interop.from_gymnasium(
        types.SimpleNamespace(P=x, initial_state_distrib=y), discount=0.9
    ),
    "from_gymnasium, outcome": lambda x, y: interop.from_gymnasium(
        types.SimpleNamespace(P=[[[x]]], initial_state_distrib=[1.0]), discount=0.9
    ),
    "demonstrations_from_episodes": lambda x, y: interop.demonstrations_from_episodes(x),
    "demonstrations_from_episodes, one": lambda x, y: interop.demonstrations_from_episodes([(x, y)]),
    "demonstrations_from_steps": lambda x, y: interop.demonstrations_from_steps(x, y, y),
    "from_table": lambda x, y: interop.from_table(x, discount=0.9, columns=y),
    "from_table, columns": lambda x, y: interop.from_table({"state": x, "action": y, "next": x}, discount=0.9),
    "from_table, numbers": lambda x, y: interop.from_table(
        {"state": [0, 0], "action": [0, 0], "next": [0, 1], "probability": x, "reward": y}, discount=0.9
    ),
    "read_map": lambda x, y: read_map(x if not isinstance(x, str) else [x]),
}


@pytest.mark.parametrize("door", DOORS)
def test_anything_gives_a_result_or_one_line(door):
    @few
    @hypothesis.given(ANYTHING, ANYTHING)
    def test(x, y):
        result_or_one_line(DOORS[door], x, y)

    test()


@few
@hypothesis.given(st.text(st.sampled_from("Xx# .SsGgF0123456789,:dim\n\r\t?é"), max_size=40))
def test_any_text_is_a_track_or_one_line(text):
    rows = result_or_one_line(read_map, text + "\n")
    if rows is not None:
        assert len({len(row) for row in rows}) == 1 and set("".join(rows)) <= set("#.SF")


@few
@hypothesis.given(st.text(st.sampled_from('012,.-\n\r" e;xé\0'), max_size=60), st.booleans())
def test_any_text_is_a_csv_file_or_one_line(text, with_header):
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "steps.csv"
        path.write_text(("episode,state,action\n" if with_header else "") + text, newline="")
        result = result_or_one_line(interop.demonstrations_from_csv, path)
    if result is not None:
        assert result[1].steps == sum(len(states) for states, _ in unpadded(result[0])) > 0


# ----------------------------------------------------------------------------------------- files

NAMES = ["transition", "discount", "next_state", "probability", "initial", "features"]
NAMES += ["states", "actions", "length", "policy", "format_version"]


@pytest.mark.parametrize("load", [interop.load_mdp, interop.load_demonstrations, interop.load_policy])
def test_any_arrays_in_a_file_are_loaded_or_one_line(load, tmp_path):
    path = tmp_path / "file.npz"
    seeds = {"discount": 0.9, "transition": np.ones((1, 1, 1)), "states": [[0]], "actions": [[0]], "policy": [[1.0]]}

    @few
    @hypothesis.given(st.dictionaries(st.sampled_from(NAMES), ANYTHING.map(as_plain_array), max_size=3))
    def test(arrays):
        np.savez(path, **{**seeds, **arrays})
        result_or_one_line(load, path)

    test()


def as_plain_array(value):
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError):
        return np.zeros(0)
    return array if not array.dtype.hasobject else np.zeros(0)


@few
@hypothesis.given(transitions(), episodes())
def test_files_give_back_what_was_saved(transition, pairs):
    with tempfile.TemporaryDirectory() as folder:
        model, demonstrations = pathlib.Path(folder) / "model", pathlib.Path(folder) / "demonstrations"
        mdp = MDP.from_dense(transition, discount=0.5, features=transition)
        interop.save_mdp(model, mdp)
        loaded = interop.load_mdp(model)
        interop.save_demonstrations(demonstrations, Demonstrations.from_trajectories(pairs))
        assert unpadded(interop.load_demonstrations(demonstrations)) == pairs
    np.testing.assert_array_equal(loaded.probability, mdp.probability)
    np.testing.assert_array_equal(loaded.features, transition)


def test_damaged_archives_are_one_line():
    """Every byte of a small archive changed in turn, three ways."""
    buffer = io.BytesIO()
    np.savez(buffer, policy=np.array([[0.25, 0.75]]))
    content = buffer.getvalue()
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "policy.npz"
        loaded = refused = 0
        for place, change in itertools.product(range(0, len(content), 2), (0xFF, 0x01, 0x20)):
            path.write_bytes(content[:place] + bytes([content[place] ^ change]) + content[place + 1 :])
            policy = result_or_one_line(interop.load_policy, path)
            loaded, refused = loaded + (policy is not None), refused + (policy is None)
            assert policy is None or policy.tolist() == [[0.25, 0.75]]
    assert loaded > 0 and refused > loaded
