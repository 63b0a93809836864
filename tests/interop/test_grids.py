"""Grid maps and gridworlds from files, against loops over their cells; and the racetracks of a like collection."""

import gzip
import itertools
import math
import re

import numpy as np
import pytest
from matplotlib import pyplot as plt
from small_models import dense_transition

from jaxhom import plotting
from jaxhom.domains.racetrack import racetrack
from jaxhom.domains.track_maps import read_map
from jaxhom.interop import FileError, from_gridworld, from_octile

MAP = ["..@S", "G.TW", "@..W", "..O@"]


def write(folder, text, name):
    path = folder / name
    path.write_text(text)
    return path


def octile(rows, height=None, width=None):
    size = f"height {height or len(rows)}\nwidth {width or len(rows[0])}\n"
    return f"type octile\n{size}map\n" + "\n".join(rows) + "\n"


def slow_moves(rows):
    """{cell: {step: cell}}, by the format's description."""
    medium = {**dict.fromkeys(".GS", "ground"), "W": "water"}
    kinds = {(r, c): medium.get(letter) for r, row in enumerate(rows) for c, letter in enumerate(row)}
    moves = {}
    for (r, c), kind in kinds.items():
        if kind is not None:
            steps = [step for step in itertools.product((-1, 0, 1), repeat=2) if step != (0, 0)]
            beside = {step: [(r + step[0], c), (r, c + step[1]), (r + step[0], c + step[1])] for step in steps}
            moves[r, c] = {step: cells[2] for step, cells in beside.items() if {kinds.get(z) for z in cells} == {kind}}
    return moves


def random_map(seed, height, width):
    letters = np.random.default_rng(seed).choice(
        list(".GSTW@O"), p=[0.5, 0.1, 0.1, 0.05, 0.15, 0.05, 0.05], size=(height, width)
    )
    return ["".join(row) for row in letters]


@pytest.mark.parametrize("rows", [MAP, random_map(0, 9, 12), random_map(1, 1, 7), ["."]])
@pytest.mark.parametrize("num_moves", [4, 8])
def test_moves_of_grid_maps(tmp_path, rows, num_moves):
    model = from_octile(write(tmp_path, octile(rows), "a.map"), discount=0.9, num_moves=num_moves)
    moves = slow_moves(rows)
    assert model.state_names == tuple(moves) and model.coordinates.tolist() == [list(cell) for cell in moves]
    transition, allowed = dense_transition(model.mdp), np.asarray(model.mdp.allowed)
    steps = model.domain.moves
    assert steps == ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1))[:num_moves]
    for state, (cell, there) in enumerate(moves.items()):
        there = {step: target for step, target in there.items() if step in steps}
        is_end = not there
        assert (model.terminal is not None and model.terminal[state]) == is_end
        for action, step in enumerate(steps):
            target = cell if is_end else there.get(step)
            assert allowed[state, action] == (target is not None)
            if target is not None:
                assert transition[state, action, list(moves).index(target)] == 1
                assert float(model.mdp.features[state, action, 0]) == (
                    0 if is_end else pytest.approx(-math.hypot(*step))
                )
    letters = np.array([rows[r][c] for r, c in moves])
    for name, letter in (("swamp", "S"), ("water", "W")):
        np.testing.assert_array_equal(model.labels.get(name, np.zeros(len(moves), bool)), letters == letter)


def test_grid_maps_are_drawn(tmp_path):
    model = from_octile(write(tmp_path, octile(MAP), "a.map"))
    assert model.domain.rows == ("..@.", "..@.", "@...", "..@@") and model.domain.state_of((2, 1)) == 6
    assert model.domain.coordinates.tolist() == model.coordinates.tolist()
    with pytest.raises(ValueError, match=r"cell \(0, 2\) is no state of the model"):
        model.domain.state_of((0, 2))
    policy = np.asarray(model.mdp.allowed) / np.asarray(model.mdp.allowed).sum(axis=1, keepdims=True)
    ax = plotting.plot_policy(model.domain, policy)
    ax = plotting.plot_occupancy(model.domain, np.arange(1.0, 12.0)[: model.mdp.num_states])
    assert ax.images[-1].get_array().compressed().size == model.mdp.num_states
    plt.close("all")


def test_compressed_grid_maps(tmp_path):
    (tmp_path / "a.map.gz").write_bytes(gzip.compress(octile(MAP).encode()))
    assert from_octile(tmp_path / "a.map.gz").mdp.num_states == sum(letter in ".GSW" for row in MAP for letter in row)


BAD_MAPS = {
    "": "no line `map`, behind which the map begins",
    "type octile\nsize 3\nmap\n": "line 2: expected `type octile`, `height N` or `width N`, got 'size 3'",
    "type octile\nheight x\nmap\n": "line 2: expected `type octile`, `height N` or `width N`, got 'height x'",
    "type octile\nheight 2\nmap\n..\n..\n": "no line `width N` before its map",
    octile(MAP, height=5): "its map has 4 rows, but its height is 5",
    octile(MAP, width=5): "line 5: 4 columns, but the width is 5",
    octile(["..", ".x"]): "line 6, column 2: no letter 'x' among .GSW@OT",
    octile(["@@", "TO"]): "no cell of its map is passable",
}


@pytest.mark.parametrize("text", BAD_MAPS)
def test_bad_grid_maps_are_refused(tmp_path, text):
    path = write(tmp_path, text, "a.map")
    with pytest.raises(FileError, match=f"^{re.escape(str(path))}.*{re.escape(BAD_MAPS[text])}"):
        from_octile(path)


def test_other_numbers_of_moves_are_refused(tmp_path):
    with pytest.raises(ValueError, match="num_moves must be 4 or 8, got 6"):
        from_octile(write(tmp_path, octile(MAP), "a.map"), num_moves=6)


# ------------------------------------------------------------------------------------- gridworlds

GRID = ["x.G", "S@x   ", "..D"]


def test_moves_of_gridworlds(tmp_path):
    model = from_gridworld(write(tmp_path, "\n".join(GRID) + "\n", "a.gw"), discount=0.9, slip=0.2)
    cells = [(r, c) for r, row in enumerate(GRID) for c, letter in enumerate(row.strip()) if letter != "x"]
    assert model.state_names == tuple(cells) and model.action_names == ("up", "down", "left", "right")
    expected, features = np.zeros((7, 4, 7)), np.zeros((7, 4, 3))
    steps = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    for state, cell in enumerate(cells):
        if GRID[cell[0]][cell[1]] in "GD":
            expected[state, :, state] = 1
            continue
        for action, (down, right) in enumerate(steps):
            for (r, c), chance in (((down, right), 0.8), ((right, down), 0.1), ((-right, -down), 0.1)):
                target = (cell[0] + r, cell[1] + c)
                target = target if target in cells else cell
                expected[state, action, cells.index(target)] += chance
                features[state, action, 2] += chance * (GRID[target[0]][target[1]] == "G")
            features[state, action, :2] = -1, -(GRID[cell[0]][cell[1]] == "@")
    np.testing.assert_allclose(dense_transition(model.mdp), expected, atol=1e-12)
    np.testing.assert_allclose(model.mdp.features, features, atol=1e-12)
    assert model.mdp.initial.tolist() == [0, 0, 1, 0, 0, 0, 0] and model.terminal.nonzero()[0].tolist() == [1, 6]
    assert {name: mask.nonzero()[0].tolist() for name, mask in model.labels.items()} == {
        "hole": [3],
        "goal": [1],
        "dead end": [6],
    }
    assert model.domain.rows == ("@.F", "S.@", "..#") and model.reward is None


def test_gridworlds_without_a_start_or_slips(tmp_path):
    model = from_gridworld(write(tmp_path, ".G\n", "a.gw"), slip=0.0)
    assert model.mdp.initial.tolist() == [1, 0] and model.mdp.transition[0].argmax(axis=-1).tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it has no map"),
        ("..\n.q\n", "line 2, column 2: no letter 'q' among xX#.@SGD"),
        ("GxD\n", "no cell of its map is open"),
        ("xx\n", "no cell of its map is open"),
    ],
)
def test_bad_gridworlds_are_refused(tmp_path, text, message):
    path = write(tmp_path, text, "a.gw")
    with pytest.raises(FileError, match=f"^{re.escape(f'{path}')}.*{re.escape(message)}"):
        from_gridworld(path)


@pytest.mark.parametrize(("slip", "message"), [(1.5, "slip must lie in"), ("a", "slip must be a number")])
def test_slips_that_are_no_probabilities_are_refused(tmp_path, slip, message):
    with pytest.raises(ValueError, match=message):
        from_gridworld(write(tmp_path, ".G\n", "a.gw"), slip=slip)


# ------------------------------------------------------------------------------------- racetracks


@pytest.mark.parametrize("header", ["5\n3\n", "5 3\n"])
def test_o_is_slippery_road_behind_width_and_height(tmp_path, header):
    path = write(tmp_path, header + "XXXXX\nXSoGX\nXXOPX", "a.track")
    assert read_map(path) == ("#####", "#S.F#", "##..#")
    assert racetrack(path).mdp.num_states == 5 * 25


@pytest.mark.parametrize("header", ["", "dim: 2 4\n", "2,4\n"])
def test_o_is_wall_elsewhere(tmp_path, header):
    assert read_map(write(tmp_path, header + "S.oF\nS..F\n", "a.track")) == ("S.#F", "S..F")
