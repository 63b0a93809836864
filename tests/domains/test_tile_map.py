"""Maps of grid environments: every move leads where the map says, and pictures draw only what is open."""

import gymnasium
import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib import quiver

from jaxhom import plotting
from jaxhom.domains.tile_map import TileMap
from jaxhom.interop import from_gymnasium
from jaxhom.interop.environment_maps import tile_map
from jaxhom.models.mdp import MDP


def made(name, end_state=False, **options):
    with gymnasium.make(name, **options) as env:
        mdp = from_gymnasium(env, discount=0.9, end_state=end_state).mdp
        return mdp, tile_map(env, mdp)


def corridor(num_states=3):
    return MDP.from_dense(np.full((num_states, 2, num_states), 1.0 / num_states), discount=0.9)


@pytest.mark.parametrize(
    ("name", "options", "rows"),
    [
        ("FrozenLake-v1", {"is_slippery": False}, ("S...", ".#.#", "...#", "#..F")),
        ("FrozenLake-v1", {"is_slippery": False, "desc": ["SFH", "FFG"]}, ("S.#", "..F")),
        ("CliffWalking-v1", {}, ("." * 12, "." * 12, "." * 12, "S" + "#" * 10 + "F")),
    ],
)
def test_moves_lead_to_the_next_cell(name, options, rows):
    mdp, found = made(name, **options)
    assert found.rows == rows and found.mdp is mdp
    start = next(state for state in range(mdp.num_states) if "".join(rows)[state] == "S")
    likeliest = np.take_along_axis(
        np.asarray(mdp.next_state), np.asarray(mdp.probability).argmax(axis=-1)[..., None], axis=-1
    )[..., 0]
    limits = np.array([len(rows), len(rows[0])]) - 1
    for state in np.flatnonzero(np.isin(list("".join(rows)), [".", "S"])):
        for action, move in enumerate(found.moves):
            cell = np.clip(found.coordinates[state] + move, 0, limits)
            there = found.state_of(cell)
            falls = name.startswith("Cliff") and "".join(rows)[there] == "#"
            assert likeliest[state, action] == (start if falls else there)


@pytest.mark.parametrize(("name", "end_state"), [("Taxi-v4", False), ("FrozenLake-v1", True)])
def test_models_without_a_map(name, end_state):
    assert made(name, end_state)[1] is None


@pytest.mark.parametrize(
    ("rows", "moves", "message"),
    [
        (["..", "."], [(0, 1), (0, 0)], "rows must be equally long and have 3 cells"),
        (["...."], [(0, 1), (0, 0)], "rows must be equally long and have 3 cells"),
        (["..@"], [(0, 1), (0, 0)], "rows must be equally long and have 3 cells"),
        ([], [(0, 1), (0, 0)], "rows must be equally long"),
        (["..x"], [(0, 1), (0, 0)], r"rows\[0\] must be made of #, ., S, F and @, got '..x'"),
        (["..."], [(0, 1)], r"moves must have shape \(2, 2\)"),
        (["..."], [(0, 1), (0, 0.5)], r"moves\[1, 1\] must be whole, got 0\.5"),
    ],
)
def test_malformed_maps_are_rejected(rows, moves, message):
    with pytest.raises(ValueError, match=message):
        TileMap.from_rows(corridor(), rows, moves)


def test_cells_off_the_map_are_rejected():
    with pytest.raises(ValueError, match=r"cell \(1, 0\) is outside the 1 x 3 map"):
        TileMap.from_rows(corridor(), ["..."], [(0, 1), (0, 0)]).state_of((1, 0))


def test_cells_that_are_not_whole_are_rejected():
    with pytest.raises(ValueError, match=r"cell must be two whole numbers \(row, column\), got \(0, 0\.5\)"):
        TileMap.from_rows(corridor(), ["..."], [(0, 1), (0, 0)]).state_of((0, 0.5))


def test_cells_that_are_no_states():
    tiles = TileMap.from_rows(corridor(), ["@.", "S#"], [(0, 1), (0, 0)])
    assert tiles.coordinates.tolist() == [[0, 1], [1, 0], [1, 1]] and tiles.letters == ".S#"
    assert [tiles.state_of(cell) for cell in tiles.coordinates] == [0, 1, 2]
    with pytest.raises(ValueError, match=r"cell \(0, 0\) is no state of the model"):
        tiles.state_of((0, 0))


def test_pictures_draw_what_is_open():
    tiles = TileMap.from_rows(corridor(4), ["S.", "#F"], [(0, 1), (1, 0)])
    ax = plotting.plot_policy(tiles, np.eye(2)[[0, 1, 0, 1]])
    (arrows,) = [artist for artist in ax.get_children() if isinstance(artist, quiver.Quiver)]
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], axis=1), [[0.8, 0.0], [0.0, 0.8]])
    ax = plotting.plot_occupancy(tiles, np.arange(1.0, 5.0))
    np.testing.assert_array_equal(ax.images[-1].get_array().compressed(), [1.0, 2.0])
    plt.close("all")
