"""Pictures: every function draws what it should where it should, and refuses wrong shapes."""

import pathlib
import subprocess
import sys

import jax
import numpy as np
import pytest

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib import collections  # noqa: E402

from jaxhom import plotting  # noqa: E402
from jaxhom.domains.gridworld import gridworld  # noqa: E402
from jaxhom.domains.racetrack import racetrack  # noqa: E402
from jaxhom.models.demonstrations import Demonstrations  # noqa: E402
from jaxhom.plotting import figures, pictures  # noqa: E402

TRACK = ["XXXXXX", "S....F", "S..XXX", "XXXXXX"]
CELLS, OPEN = 9, 8  # of which one is on the finish line


@pytest.fixture(scope="module")
def world():
    return gridworld(4, num_regions=4)


@pytest.fixture(scope="module")
def track():
    return racetrack(TRACK, start=[(1, 0)])


@pytest.fixture(params=["world", "track"])
def domain(request):
    return request.getfixturevalue(request.param)


@pytest.fixture
def ax():
    return plt.subplots()[1]


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def uniform(domain):
    shape = (domain.mdp.num_states, domain.mdp.num_actions)
    return np.full(shape, 1.0 / shape[1])


def one_action(domain, action):
    policy = np.zeros((domain.mdp.num_states, domain.mdp.num_actions))
    policy[:, action] = 1.0
    return policy


def sampled(domain, number=3, horizon=5):
    """Trajectories through states that are drawn at random, none of them terminal."""
    open_states = np.flatnonzero(~np.asarray(getattr(domain, "terminal", np.zeros(16, bool))))
    states = np.random.default_rng(0).choice(open_states, (number, horizon))
    return Demonstrations.from_trajectories([(path, path % 4) for path in states])


def of_type(ax, kind):
    return [artist for artist in ax.get_children() if isinstance(artist, kind)]


def figure_of(world, track, **changes):
    arguments = {
        "reward": np.asarray(world.mdp.features[..., 0]),
        "gridworld_demonstrations": sampled(world),
        "gridworld_policy": uniform(world),
        "racetrack_demonstrations": sampled(track),
        "racetrack_policies": {"right": one_action(track, 4), "down": one_action(track, 2)},
        "key": jax.random.key(0),
        "horizon": 6,
    }
    return plotting.learned_policy_figure(gridworld=world, racetrack=track, **arguments | changes)


def heat(ax):
    """The image that was drawn last, and no ground."""
    return ax.images[-1].get_array()


DRAW = {
    "policy": lambda domain, ax: plotting.plot_policy(domain, uniform(domain), ax=ax),
    "trajectories": lambda domain, ax: plotting.plot_trajectories(domain, sampled(domain), ax=ax),
    "occupancy": lambda domain, ax: plotting.plot_occupancy(domain, uniform(domain), ax=ax),
}


# ------------------------------------------------------------------------- every function at once


@pytest.mark.parametrize("name", DRAW)
def test_returns_the_axes_that_it_was_given_or_makes_some(domain, ax, name):
    assert DRAW[name](domain, ax) is ax
    own = DRAW[name](domain, None)
    assert own is not ax
    assert (own.get_xlabel(), own.get_ylabel()) == ("column", "row")
    own.figure.canvas.draw()  # what cannot be rendered fails here


def test_domains_in_full(world, track, ax):
    options = {"trajectories": sampled(world), "policy": uniform(world)}
    values, visited = np.arange(16.0), np.arange(16) < 3
    assert plotting.plot_gridworld(world, values=values, visited=visited, ax=ax, **options) is ax
    ax.figure.canvas.draw()
    options = {"trajectories": sampled(track), "policy": uniform(track), "speed": (1, -2)}
    values, visited = np.arange(CELLS), np.arange(CELLS * 25) < 60
    own = plotting.plot_racetrack(track, values=values, visited=visited, **options)
    own.figure.canvas.draw()


# ------------------------------------------------------------------------------ what they draw


def test_gridworld_borders_are_those_of_its_regions(world, ax):
    plotting.plot_gridworld(world, ax=ax)
    (borders,) = of_type(ax, collections.LineCollection)
    assert len(borders.get_segments()) == 4 * 4 + 2 * 4  # round the grid, and across it twice
    assert not ax.images
    assert ax.yaxis_inverted()


def test_racetrack_shows_walls_road_start_and_finish(track, ax):
    plotting.plot_racetrack(track, ax=ax)
    (image,) = ax.images
    pixels = np.asarray(image.get_array())
    side = len(pixels) // len(TRACK)

    def tones_of(row, columns):
        start, stop = side * columns[0], side * columns[1]
        block = pixels[side * row : side * (row + 1), start:stop]
        return {tuple(tone) for tone in block.reshape(-1, 3)}

    places = {"X": (0, (0, 6)), "S": (1, (0, 1)), ".": (1, (1, 5)), "F": (1, (5, 6))}
    tones = {letter: tones_of(*place) for letter, place in places.items()}
    assert [len(tones[letter]) for letter in "XS.F"] == [1, 1, 1, 2]
    assert len(set.union(*tones.values())) == 4  # the finish shares the tone of the road
    outline = of_type(ax, collections.LineCollection)[0].get_segments()
    assert len(outline) == 2 * (6 + 2)  # the road is 6 cells wide and 2 high


@pytest.mark.parametrize("action", range(4))
def test_a_deterministic_policy_has_one_centred_arrow_per_cell(world, ax, action):
    plotting.plot_policy(world, one_action(world, action), ax=ax)
    (arrows,) = of_type(ax, matplotlib.quiver.Quiver)
    direction = [(0, -1), (0, 1), (-1, 0), (1, 0)][action]  # x, y: up, down, left, right
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], -1), np.tile(np.multiply(0.8, direction), (16, 1)))
    middle = np.stack([arrows.X + arrows.U / 2, arrows.Y + arrows.V / 2], -1)
    np.testing.assert_allclose(middle, np.asarray(world.coordinates)[:, ::-1], atol=1e-12)


def test_arrows_are_as_long_as_their_actions_are_probable(track, ax):
    policy = np.tile([0.5, 0.3, 0.19, 0.01, 0.0], (CELLS * 25, 1))
    policy[track.state_of((1, 2), (0, 1))] = [0, 0, 0, 0, 1]
    plotting.plot_policy(track, policy, speed=(0, 1), ax=ax)
    (arrows,) = of_type(ax, matplotlib.quiver.Quiver)
    (dots,) = of_type(ax, collections.EllipseCollection)
    assert len(dots.get_offsets()) == OPEN - 1  # "nothing"; none on the finish line
    lengths = np.sort(np.hypot(arrows.U, arrows.V))
    expected = [0.8 * 0.19] * (OPEN - 1) + [0.8 * 0.3] * (OPEN - 1) + [0.8]
    np.testing.assert_allclose(lengths, expected)


@pytest.mark.parametrize("number", [1, 3])
def test_one_line_per_trajectory_and_one_ring_per_starting_cell(domain, ax, number):
    trajectories = sampled(domain, number)
    plotting.plot_trajectories(domain, trajectories, color=plotting.BLUE, label="trials", ax=ax)
    assert len(ax.lines) == number
    assert {line.get_color() for line in ax.lines} == {plotting.BLUE}
    assert ax.get_legend_handles_labels()[1] == ["trials"]
    cells = np.asarray(domain.coordinates)[np.asarray(trajectories.states)]
    rings = of_type(ax, collections.PathCollection)[0].get_offsets()
    assert {tuple(ring) for ring in np.asarray(rings)} == {(x, y) for y, x in cells[:, 0]}
    for line, path in zip(ax.lines, cells, strict=True):
        drawn = np.asarray(line.get_xydata())
        drawn = drawn[~np.isnan(drawn[:, 0])]
        np.testing.assert_array_equal(np.round(drawn), path[:, ::-1])
        assert np.abs(drawn - path[:, ::-1]).max() <= 0.2 * (number > 1) + 1e-9


def test_lines_stop_at_the_padding_and_are_cut_at_a_restart(track, ax):
    finish, start = track.state_of((1, 5)), track.state_of((1, 0))
    paths = [[start, finish, start], [start]]
    trajectories = Demonstrations.from_trajectories([(path, [0] * len(path)) for path in paths])
    plotting.plot_trajectories(track, trajectories, ax=ax)
    restarted, single = (line.get_xdata() for line in ax.lines)
    np.testing.assert_array_equal(np.isnan(restarted), [False, False, True, False])
    assert len(single) == 1


def test_visited_cells_are_tinted(track, ax):
    visited = np.zeros(CELLS * 25, bool)
    visited[[track.state_of((1, 1), (0, 2)), track.state_of((1, 1)), track.state_of((1, 5))]] = True
    plotting.plot_racetrack(track, visited=visited, ax=ax)
    (tint,) = of_type(ax, collections.PatchCollection)
    (path,) = tint.get_paths()  # the finish cell stays as it is
    np.testing.assert_allclose(path.get_extents().get_points().mean(axis=0), [1, 1])


def test_racetrack_values_are_the_largest_over_speeds(track, ax):
    values = np.random.default_rng(0).normal(size=CELLS * 25)
    plotting.plot_racetrack(track, values=values, label="worth", ax=ax)
    cells = np.asarray(track.cells)
    expected = np.where(np.asarray(track.terminal)[::25], np.nan, values.reshape(CELLS, 25).max(1))
    shown = heat(ax).filled(np.nan)
    np.testing.assert_array_equal(shown[tuple(cells.T)], expected)
    assert np.isfinite(shown).sum() == OPEN
    (bar,) = ax.child_axes
    assert bar.get_ylabel() == "worth"


def test_occupancy_is_summed_over_speeds_and_actions(domain, ax):
    occupancy = np.random.default_rng(0).uniform(size=uniform(domain).shape)
    occupancy[0] = 0.0
    plotting.plot_occupancy(domain, occupancy, ax=ax)
    expected = np.zeros(heat(ax).shape)
    np.add.at(expected, tuple(np.asarray(domain.coordinates).T), occupancy.sum(axis=1))
    shown = heat(ax)
    np.testing.assert_allclose(shown.compressed(), expected[~shown.mask])
    assert ax.images[-1].norm.vmax == shown.max()


def test_the_figure_has_a_panel_per_policy_and_is_reproducible(world, track):
    figure = figure_of(world, track)
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    title, *trials = filter(None, titles)
    assert title == "Learned from 3 demonstrations"
    assert len(trials) == 2
    assert trials[0].startswith("right: finish in ")
    assert trials[0].endswith(" steps, 0 off-roads")
    assert trials[1].startswith("down: no finish in 6 steps, ")
    assert [ax.get_title(loc="left") for ax in figure_of(world, track).axes] == titles
    figure.canvas.draw()


def test_off_roads_are_told_from_halts(track):
    """Down from the lower row is always off the road; a halt is not; a failed brake is."""
    fast, slow = track.state_of((1, 4), (0, 2)), track.state_of((2, 2), (0, 1))
    stands = track.state_of((2, 2))
    steps = [
        (track.state_of((2, 1), (1, 1)), 0, track.state_of((2, 1)), 1.0),
        (stands, 0, stands, 0.0),
        (stands, 2, stands, 0.9),  # 0.9: the car moves, and hits the wall; else it stays put
        (slow, 3, stands, 0.1),  # 0.9: the car halts
        (fast, 0, track.state_of((1, 5), (0, 2)), 0.0),
    ]
    for here, action, after, expected in steps:
        states = np.array([here, after])
        (chance,) = figures._off_road_chances(track, states, np.array([action]))
        np.testing.assert_allclose(chance, expected, atol=1e-12)


def test_the_median_trial_is_in_the_middle(track):
    trial = figures._median_trial(jax.random.key(1), track, uniform(track), 6)
    assert trial.states.shape == (1, 7)
    (states,) = pictures.unpadded(trial)
    assert not np.asarray(track.terminal)[states[:-1]].any()


# ------------------------------------------------------------------------------ malformed input

GRID, STATES = 16, CELLS * 25
MALFORMED = {
    "gridworld, track": (lambda w, t: plotting.plot_gridworld(t), "must be a Gridworld, got Racet"),
    "racetrack, grid": (lambda w, t: plotting.plot_racetrack(w), "must be a Racetrack, got Gridw"),
    "policy, model": (
        lambda w, t: plotting.plot_policy(w.mdp, uniform(w)),
        "must be a Gridworld or a Racetrack or a TileMap, got MDP",
    ),
    "gridworld values": (
        lambda w, t: plotting.plot_gridworld(w, values=np.ones((4, 4))),
        r"values must have shape \(16,\), got \(4, 4\)",
    ),
    "racetrack values": (
        lambda w, t: plotting.plot_racetrack(t, values=np.ones(STATES + 1)),
        "values must have shape",
    ),
    "values of NaN": (
        lambda w, t: plotting.plot_gridworld(w, values=np.full(GRID, np.nan)),
        r"values\[0\] must be finite",
    ),
    "visited": (
        lambda w, t: plotting.plot_racetrack(t, visited=np.ones(CELLS, bool)),
        "visited must have shape",
    ),
    "gridworld policy": (
        lambda w, t: plotting.plot_gridworld(w, policy=np.ones((GRID, 5))),
        "policy must have shape",
    ),
    "racetrack trajectories": (
        lambda w, t: plotting.plot_racetrack(t, trajectories=Demonstrations.from_trajectories([([STATES], [0])])),
        "states.* must lie in",
    ),
    "racetrack speed": (
        lambda w, t: plotting.plot_racetrack(t, policy=uniform(t), speed=(3, 0)),
        "speed must be",
    ),
    "policy": (lambda w, t: plotting.plot_policy(w, np.ones((GRID, 5))), "policy must have shape"),
    "policy of cells": (
        lambda w, t: plotting.plot_policy(t, np.ones((CELLS, 5))),
        "policy must have shape",
    ),
    "speed": (lambda w, t: plotting.plot_policy(t, uniform(t), speed=(0, 3)), "speed must be"),
    "trajectories": (
        lambda w, t: plotting.plot_trajectories(w, Demonstrations.from_trajectories([([0, 16], [0, 0])])),
        r"states\[0, 1\] must lie in \[0, 16\)",
    ),
    "occupancy": (
        lambda w, t: plotting.plot_occupancy(w, np.ones((GRID, 4, 1))),
        "occupancy must have shape",
    ),
    "no occupancy": (
        lambda w, t: plotting.plot_occupancy(t, np.asarray(t.terminal)),
        "occupancy must be positive",
    ),
    "no policies": (
        lambda w, t: figure_of(w, t, racetrack_policies={}),
        "at least one policy",
    ),
    "figure's reward": (
        lambda w, t: figure_of(w, t, reward=np.ones(GRID + 1)),
        "reward must have shape",
    ),
    "figure's gridworld policy": (
        lambda w, t: figure_of(w, t, gridworld_policy=np.ones((GRID, 5))),
        "policy must have shape",
    ),
    "figure's racetrack policy": (
        lambda w, t: figure_of(w, t, racetrack_policies={"any": np.ones((STATES, 4))}),
        "policy must have shape",
    ),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_input_is_rejected_before_anything_is_drawn(world, track, name):
    draw, message = MALFORMED[name]
    with pytest.raises(ValueError, match=message):
        draw(world, track)
    assert not plt.get_fignums()


def test_without_matplotlib_one_message_names_the_extra():
    code = "import sys; sys.modules['matplotlib'] = None; import jaxhom; import jaxhom.plotting"
    command = [sys.executable, "-c", code]
    root = pathlib.Path(__file__).parents[2]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert result.stderr.strip().splitlines()[-1].endswith("pip install '.[plot]'")
    assert "ImportError: jaxhom.plotting needs matplotlib" in result.stderr


def test_no_trajectories_are_no_lines():
    none = Demonstrations.from_trajectories([([0], [0])])[:0]
    assert not plotting.plot_trajectories(gridworld(4), none).lines
