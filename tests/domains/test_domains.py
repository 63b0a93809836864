"""The domains, held to slow loops written from their descriptions and to numbers of a prototype."""

import itertools

import jax
import numpy as np
import pytest

from jaxhom.domains.gridworld import gridworld, sample_weights
from jaxhom.domains.racetrack import ACTIONS, racetrack

STRAIGHT = ["XXXXXX", "S....F", "XXXXXX"]
CORNER = ["X.F", "..X", "..."]


@pytest.fixture(scope="module", params=["a", "b"])
def shipped(request):
    return request.param, racetrack(request.param)


@pytest.fixture(scope="module")
def track_a():
    return racetrack("a")


# ---------------------------------------------------------------- gridworld


def slow_gridworld(size, noise):
    """T[s, a, s'] by the sentence in the paper, one entry at a time."""
    transition = np.zeros((size * size, 4, size * size))
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    for row, column, action in itertools.product(range(size), range(size), range(4)):
        for move in range(4):
            new_row, new_column = row + moves[move][0], column + moves[move][1]
            if not (0 <= new_row < size and 0 <= new_column < size):
                new_row, new_column = row, column
            chance = noise / 4 + (1 - noise) * (move == action)
            transition[row * size + column, action, new_row * size + new_column] += chance
    return transition


@pytest.mark.parametrize("size", [1, 2, 5, 8])
@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_gridworld_agrees_with_a_slow_loop(size, noise):
    world = gridworld(size, noise=noise)
    np.testing.assert_allclose(world.mdp.transition, slow_gridworld(size, noise), atol=1e-6)


def test_gridworld_regions_are_square_blocks_with_one_indicator_each():
    world = gridworld(6, num_regions=4)
    expected = [[0, 0, 0, 1, 1, 1]] * 3 + [[2, 2, 2, 3, 3, 3]] * 3
    np.testing.assert_array_equal(world.region.reshape(6, 6), expected)
    features = np.asarray(world.mdp.features)
    assert features.shape == (36, 4, 4)
    np.testing.assert_array_equal(features.argmax(-1), np.repeat(world.region[:, None], 4, axis=1))
    np.testing.assert_array_equal(features.sum(-1), 1)


def test_gridworld_geometry_and_start():
    world = gridworld(4, start=(1, 2))
    np.testing.assert_array_equal(np.asarray(world.coordinates) @ [4, 1], np.arange(16))
    np.testing.assert_array_equal(world.mdp.initial, np.arange(16) == 6)
    assert world.mdp.num_features == 0
    assert not np.any(world.region)
    assert world.size == 4


@pytest.mark.parametrize("num_regions", [0, -4, 3, 9, 25, 4.5])
def test_gridworld_rejects_regions_that_do_not_tile(num_regions):
    with pytest.raises(ValueError, match="num_regions must be"):
        gridworld(4, num_regions=num_regions)


@pytest.mark.parametrize("size", [0, -1, 2.5])
def test_gridworld_rejects_a_bad_size(size):
    with pytest.raises(ValueError, match="size must be"):
        gridworld(size)


@pytest.mark.parametrize("noise", [-0.1, 1.1, np.nan, "much", [0.1]])
def test_gridworld_rejects_noise_that_is_no_probability(noise):
    with pytest.raises(ValueError, match="noise must"):
        gridworld(4, noise=noise)


@pytest.mark.parametrize("start", [(4, 0), (0, -1), (0.5, 1), (1,), 3])
def test_gridworld_rejects_a_start_outside(start):
    with pytest.raises(ValueError, match="start must be"):
        gridworld(4, start=start)


def test_weights_are_determined_by_their_key():
    draws = [np.asarray(sample_weights(jax.random.key(seed), 64)) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert np.any(draws[0] != draws[2])


def test_weights_under_jit_and_vmap_are_the_same():
    keys = jax.random.split(jax.random.key(3), 8)
    eager = np.stack([sample_weights(key, 16) for key in keys])
    doubled = jax.jit(lambda key: 2 * sample_weights(key, num_regions=16))
    np.testing.assert_array_equal(np.stack([doubled(key) for key in keys]), 2 * eager)
    np.testing.assert_array_equal(jax.vmap(lambda key: sample_weights(key, 16))(keys), eager)


def test_weights_are_mostly_zero_never_all_zero_and_uniform_otherwise():
    keys = jax.random.split(jax.random.key(0), 4000)
    weights = np.asarray(jax.vmap(lambda key: sample_weights(key, 16))(keys))
    assert np.all((weights >= 0) & (weights < 1))
    assert np.all(weights.any(axis=1))
    # A fraction 0.1 of the weights, given that not all 16 of a draw are zero.
    assert np.mean(weights > 0) == pytest.approx(0.1 / (1 - 0.9**16), abs=0.005)
    assert np.mean(weights[weights > 0]) == pytest.approx(0.5, abs=0.02)


def test_weights_reject_an_empty_draw():
    with pytest.raises(ValueError, match="num_regions must be at least 1"):
        sample_weights(jax.random.key(0), 0)


# ---------------------------------------------------------------- racetrack


def slow_move(rows, cell, speed):
    """Where a move by `speed` ends, with which speed, and as which event."""
    (row, column), (down, right) = cell, speed
    way = [(down, right)]
    if max(abs(down), abs(right)) == 2:
        way.insert(0, (int(down / 2), int(right / 2)))
    for step_down, step_right in way:
        now = row + step_down, column + step_right
        inside = 0 <= now[0] < len(rows) and 0 <= now[1] < len(rows[0])
        letter = rows[now[0]][now[1]] if inside else "#"
        if letter == "F":
            return now, speed, "finish"
        if letter == "#":
            return cell, (0, 0), "off road"
    return now, speed, "on road"


def slow_step(rows, cell, speed, action):
    """All (probability, cell, speed, event) that can follow outside the finish line."""
    change = {"nothing": (0, 0), "up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
    down, right = change[action]
    changed = speed[0] + down, speed[1] + right
    if action == "nothing" or max(map(abs, changed)) > 2:
        return [(1.0, *slow_move(rows, cell, speed))]
    present = speed[0] if down else speed[1]
    success = 0.5 if abs(present) == 2 else 0.9
    return [
        (success, *slow_move(rows, cell, changed)),
        (1 - success, *slow_move(rows, cell, speed)),
    ]


def slow_racetrack(track):
    """Transition tensor [S, A, S] and event probabilities [S, A, 3], and the start's own rows."""
    num_states = track.mdp.num_states
    transition = np.zeros((num_states, 5, num_states))
    events = np.zeros((num_states, 5, 3))
    names = ["on road", "finish", "off road"]
    states = itertools.product(np.asarray(track.cells).tolist(), np.asarray(track.speeds).tolist())
    for state, (cell, speed) in enumerate(states):
        for index, action in enumerate(ACTIONS):
            if track.rows[cell[0]][cell[1]] == "F":
                transition[state, index] = track.mdp.initial
                continue
            for chance, now, speed_now, event in slow_step(track.rows, cell, speed, action):
                transition[state, index, track.state_of(now, speed_now)] += chance
                events[state, index, names.index(event)] += chance
    return transition, events


@pytest.mark.parametrize("lines", [STRAIGHT, CORNER, ["FFF", "...", "...", "S.S"], ["XX...", "XX..", "S...FF"]])
def test_racetrack_agrees_with_a_slow_loop(lines):
    track = racetrack(lines)
    transition, events = slow_racetrack(track)
    np.testing.assert_allclose(track.mdp.transition, transition, atol=1e-6)
    np.testing.assert_allclose(track.mdp.features, events[..., :2], atol=1e-6)
    np.testing.assert_allclose(track.off_road, events[..., 2], atol=1e-6)


def test_shipped_tracks_have_the_papers_numbers_of_states(shipped):
    name, track = shipped
    num_cells = {"a": 236, "b": 204}[name]
    assert track.cells.shape == (num_cells, 2)
    assert track.mdp.num_states == 25 * num_cells
    assert (track.mdp.num_actions, track.mdp.num_features) == (5, 2)
    assert int(track.terminal.sum()) == 3 * 25
    assert track.mdp.initial.dtype == track.weights.dtype == track.off_road.dtype
    np.testing.assert_array_equal(track.weights, [5, 200])


def test_shipped_tracks_are_consistent(shipped):
    _, track = shipped
    np.testing.assert_allclose(track.mdp.probability.sum(-1), 1, atol=1e-5)
    np.testing.assert_allclose(track.mdp.initial.sum(), 1, atol=1e-5)
    features, off_road = np.asarray(track.mdp.features), np.asarray(track.off_road)
    assert features.min() >= 0 and features.max() <= 1
    total = features.sum(-1) + off_road
    expected = np.where(np.asarray(track.terminal), 0.0, 1.0)
    np.testing.assert_allclose(total, np.repeat(expected[:, None], 5, axis=1), atol=1e-6)


def test_shipped_tracks_can_be_finished_from_every_state(shipped):
    _, track = shipped
    next_state, probability = np.asarray(track.mdp.next_state), np.asarray(track.mdp.probability)
    can_finish = np.asarray(track.terminal)
    for _ in range(200):
        can_finish = can_finish | (can_finish[next_state] & (probability > 0)).any((1, 2))
    assert can_finish.all()


def test_the_car_starts_where_the_paper_says():
    one_place, anywhere = racetrack("a"), racetrack("b")
    assert np.flatnonzero(one_place.mdp.initial).tolist() == [one_place.state_of((7, 0))]
    starts = np.flatnonzero(anywhere.mdp.initial)
    assert len(starts) == 204 - 3
    assert np.all(starts % 25 == 12)
    assert not np.any(np.asarray(anywhere.terminal)[starts])


def test_the_start_can_be_chosen_and_defaults_to_the_letters():
    line = [(row, 0) for row in range(5, 9)]
    track = racetrack("a", start=line)
    chosen = np.flatnonzero(track.mdp.initial).tolist()
    assert chosen == [track.state_of(cell) for cell in line]
    np.testing.assert_allclose(np.asarray(track.mdp.initial)[chosen], 0.25)
    lettered, bare = racetrack(STRAIGHT), racetrack([" ...F"])
    assert np.flatnonzero(lettered.mdp.initial).tolist() == [12]
    assert np.flatnonzero(bare.mdp.initial).tolist() == [12, 37, 62, 87]


def test_states_are_numbered_cell_by_cell(track_a):
    coordinates = np.asarray(track_a.coordinates)
    np.testing.assert_array_equal(coordinates, np.repeat(track_a.cells, 25, axis=0))
    for state in (0, 1234, 5899):
        speed = np.asarray(track_a.speeds)[state % 25]
        assert track_a.state_of(coordinates[state], speed) == state


def test_expert_on_track_a_laps_in_21_steps_at_14_a_step(track_a):
    """Exact values of a prototype: 19.859 steps up to the finish with 291.87 of reward."""
    next_state = np.asarray(track_a.mdp.next_state)
    probability = np.asarray(track_a.mdp.probability, np.float64)
    reward = np.asarray(track_a.mdp.features, np.float64) @ [5.0, 200.0]
    value = np.zeros(len(reward))
    for _ in range(1500):
        action_value = reward + 0.99 * np.sum(probability * value[next_state], axis=-1)
        value = action_value.max(-1)
    best = np.arange(len(reward)), action_value.argmax(-1)
    onwards = np.where(np.asarray(track_a.terminal), 0.0, 1.0)
    steps, gain = np.zeros((2, len(reward)))
    for _ in range(500):
        steps = onwards * (1 + np.sum(probability[best] * steps[next_state[best]], axis=-1))
        gain = onwards * (reward[best] + np.sum(probability[best] * gain[next_state[best]], axis=-1))
    start = track_a.state_of((7, 0))
    assert steps[start] == pytest.approx(19.859, abs=1e-3)
    assert gain[start] == pytest.approx(291.87, abs=1e-2)
    assert gain[start] / (steps[start] + 1) == pytest.approx(13.99, abs=1e-2)


def local_model(next_state, probability, center):
    """M^{s,1} with its states in the order that the actions come upon them."""
    states = [center]
    for action, slot in itertools.product(range(5), range(2)):
        successor = next_state[center][action][slot]
        if probability[center][action][slot] > 0 and successor not in states:
            states.append(successor)
    model = np.zeros((len(states), 5, len(states)))
    for row, state in enumerate(states):
        for action, slot in itertools.product(range(5), range(2)):
            successor = next_state[state][action][slot]
            column = states.index(successor) if successor in states else row
            model[row, action, column] += probability[state][action][slot]
    return len(states), model.round(5).tobytes()


def test_track_a_has_113_local_models(track_a):
    # Successors are listed by their number, which is no invariant of renaming: order by chance.
    order = np.argsort(-np.asarray(track_a.mdp.probability), axis=-1, kind="stable")
    next_state = np.take_along_axis(np.asarray(track_a.mdp.next_state), order, -1).tolist()
    probability = np.take_along_axis(np.asarray(track_a.mdp.probability), order, -1).tolist()
    models = {local_model(next_state, probability, s) for s in range(track_a.mdp.num_states)}
    assert len(models) == 113


def test_a_move_does_not_jump_over_a_corner():
    track = racetrack(["..X", ".X.", "..F"])
    from_cell, speed = (0, 0), (2, 2)
    state = track.state_of(from_cell, speed)
    assert track.mdp.transition[state, 0, track.state_of((0, 0))] == 1
    assert track.off_road[state, 0] == 1


def test_a_car_that_would_overshoot_the_finish_line_finishes():
    track = racetrack(STRAIGHT)
    state = track.state_of((1, 4), (0, 2))
    np.testing.assert_array_equal(track.mdp.features[state, 0], [0, 1])
    assert track.mdp.transition[state, 0, track.state_of((1, 5), (0, 2))] == 1


@pytest.mark.parametrize("letters", ["X.SF", "x SG", "#.SG"])
def test_map_letters_are_interchangeable(letters):
    wall, road, start, finish = letters
    lines = [wall + start + road + finish]
    assert racetrack(lines).rows == ("#S.F",)


def test_a_map_may_come_as_text_lines_or_a_file(tmp_path):
    path = tmp_path / "oval.track"
    text = "XXXXXX\nS....F\nXXXXXX\n"
    path.write_text(text)
    sources = [path, str(path), text, text.replace("\n", "\r\n"), text.splitlines(keepends=True)]
    assert {racetrack(source).rows for source in sources} == {racetrack(STRAIGHT).rows}


def test_short_rows_are_filled_up_with_wall():
    assert racetrack(["X", "S..F"]).rows == ("####", "S..F")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["S..F", ".?.."], r"line 2, column 2: unknown letter '\?'"),
        (["S..F", "\t..."], r"line 2, column 1: unknown letter '\\t'"),
        (["S...", "X..."], "no finish cell"),
        (["XXFX", "XXXX"], "no road cell"),
        ([], "no road cell"),
    ],
)
def test_malformed_maps_are_rejected(lines, message):
    with pytest.raises(ValueError, match=message):
        racetrack(lines)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([], "at least one cell"),
        ([(0, 0)], r"start cell \(0, 0\) is a wall"),
        ([(1, 9)], r"start cell \(1, 9\) is outside the 3 x 6 map"),
        ([(-1, 0)], r"start cell \(-1, 0\) is outside"),
        ([(1, 0.5)], r"start cell must be two whole numbers \(row, column\), got \(1, 0\.5\)"),
        ([1, 0], r"start cell must be two whole numbers \(row, column\), got 1"),
        ([(1, 0), (1, 5)], r"start\[1\] is on the finish line"),
        ([(1, 0), (1, 0)], r"start\[1\] repeats"),
    ],
)
def test_malformed_starts_are_rejected(start, message):
    with pytest.raises(ValueError, match=message):
        racetrack(STRAIGHT, start=start)


def test_a_track_that_does_not_exist_is_rejected():
    with pytest.raises(FileNotFoundError, match="neither shipped"):
        racetrack("c")


@pytest.mark.parametrize("speed", [(3, 0), (0, -3), (0.5, 0)])
def test_state_of_rejects_an_impossible_speed(speed):
    with pytest.raises(ValueError, match="speed must be"):
        racetrack(STRAIGHT).state_of((1, 0), speed)


def test_state_of_rejects_a_wall():
    with pytest.raises(ValueError, match="is a wall"):
        racetrack(STRAIGHT).state_of((0, 0))


def test_dtype_is_the_default_unless_given():
    default = np.zeros(1).astype(jax.dtypes.canonicalize_dtype(float)).dtype
    assert racetrack(STRAIGHT).mdp.dtype == gridworld(4).mdp.dtype == default
    half = np.float32
    assert racetrack(STRAIGHT, dtype=half).mdp.dtype == gridworld(4, dtype=half).mdp.dtype == half


@pytest.mark.parametrize("dtype", [np.int32, bool, "nope"])
def test_models_are_of_floats(dtype):
    for make in (gridworld, racetrack):
        with pytest.raises(ValueError, match="dtype must be a floating-point type such as jax.numpy.float32, got"):
            make(4 if make is gridworld else STRAIGHT, dtype=dtype)


def test_domains_are_pytrees():
    for domain in (racetrack(STRAIGHT), gridworld(4, num_regions=4)):
        leaves, structure = jax.tree.flatten(domain)
        assert all(isinstance(leaf, jax.Array) for leaf in leaves)
        assert type(jax.tree.unflatten(structure, leaves)) is type(domain)
