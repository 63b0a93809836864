"""Pictures of generalizations and certificates: every state where it should be, every bound on its side."""

import functools

import numpy as np
import pytest

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

import jax.numpy as jnp  # noqa: E402
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib import collections, quiver  # noqa: E402
from matplotlib.colors import to_rgba  # noqa: E402

from jaxhom import Demonstrations, Generalization, local_similarity, lpal, nearest_neighbors, plotting  # noqa: E402
from jaxhom.domains.gridworld import gridworld  # noqa: E402
from jaxhom.domains.racetrack import racetrack  # noqa: E402

TRACK = ["XXXXXX", "S....F", "S..XXX", "XXXXXX"]
CELLS, OPEN, STATES, GRID = 9, 8, 225, 16  # one cell of the track is on the finish line


@pytest.fixture(scope="module")
def world():
    return gridworld(4, num_regions=4)


@pytest.fixture(scope="module")
def track():
    return racetrack(TRACK, start=[(1, 0)])


@pytest.fixture
def ax():
    return plt.subplots()[1]


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def of_type(ax, kind):
    return [artist for artist in ax.get_children() if isinstance(artist, kind)]


def heat(ax):
    """The image that was drawn last, and no ground."""
    return ax.images[-1].get_array()


def bar_labels(ax):
    return [label.get_text() for label in ax.child_axes[0].get_yticklabels()]


def crosses(ax):
    """Centres of the crosses: the strokes that are neither level nor upright, two of each."""
    strokes = np.concatenate([c.get_segments() for c in of_type(ax, collections.LineCollection) if c.get_segments()])
    moved = strokes[:, 1] - strokes[:, 0]
    return sorted({tuple(np.round(stroke.mean(axis=0), 6)) for stroke in strokes[moved.all(axis=1)]})


def dots(ax):
    return [offset for c in of_type(ax, collections.EllipseCollection) for offset in c.get_offsets().tolist()]


def made_up(domain, radius, support):
    """A generalization with given radii, all of whose policies take action 1, except uniform ones."""
    num_states, num_actions = domain.mdp.num_states, domain.mdp.num_actions
    policy = np.where((radius < 0)[:, None], 1 / num_actions, np.eye(num_actions)[np.ones(num_states, int)])
    known = {"undecided": np.zeros_like(radius), "status": np.array(0)}
    return Generalization(policy=policy, visited=radius == 0, radius=radius, support=support, **known)


# ------------------------------------------------------------------------------------ generalizations


def test_radius_is_a_mosaic_of_speeds_with_two_signs_of_its_own(track, ax):
    radius = np.full(STATES, 3)
    radius[track.state_of((1, 2), (-2, 1))] = 0
    radius[track.state_of((1, 2), (2, -2))] = -1
    assert plotting.plot_radius(track, radius, ax=ax) is ax
    shown = heat(ax)
    assert shown.shape == (5 * len(TRACK), 5 * len(TRACK[0]))
    mosaic = np.full((5, 5), 3)
    mosaic[0, 3], mosaic[4, 0] = 0, -1
    np.testing.assert_array_equal(shown[5:10, 10:15], mosaic)
    assert shown.count() == OPEN * 25
    tones = ax.images[-1].to_rgba(np.array([-1, 0, 1, 2, 3]))
    assert len(np.unique(tones, axis=0)) == 5
    np.testing.assert_allclose(tones[:2], [to_rgba(plotting.PURPLE), to_rgba(plotting.VERMILLION)])
    names = ["\N{MULTIPLICATION SIGN} nothing found", "\N{BULLET} demonstrated"]
    assert bar_labels(ax) == [*names, "1 step away", "2 steps", "3 steps"]
    np.testing.assert_allclose(dots(ax), [[2.2, 0.6]])
    np.testing.assert_allclose(crosses(ax), [[1.6, 1.4]])


def test_radius_and_support_of_one_speed_are_one_pixel_a_cell(track, ax):
    radius = np.where(np.arange(STATES) % 25 == 13, np.arange(STATES) // 25 + 1, 90)  # 13: speed (0, 1)
    plotting.plot_radius(track, radius, speed=(0, 1), ax=ax)
    np.testing.assert_array_equal(heat(ax).compressed(), np.delete(np.arange(1, CELLS + 1), 5))  # cell 5 is the finish
    support = np.where(np.arange(STATES) % 25 == 13, 2, 0)
    plotting.plot_support(track, support, speed=(0, 1), visited=np.arange(STATES) == 13, ax=ax)
    assert heat(ax).compressed().tolist() == [0] + [2] * (OPEN - 1)
    np.testing.assert_allclose(dots(ax), [[0, 1]])


def test_radius_of_demonstrated_states_alone(world, ax):
    plotting.plot_radius(world, np.zeros(GRID, int), ax=ax)
    assert set(heat(ax).ravel()) == {0}
    assert len(dots(ax)) == GRID and not crosses(ax)


def test_support_counts_voters(world, ax):
    support = np.arange(GRID) % 4
    assert plotting.plot_support(world, support, ax=ax) is ax
    np.testing.assert_array_equal(heat(ax).ravel(), np.where(support == 0, -1, support))
    assert bar_labels(ax)[2:] == ["1 voter", "2 voters", "3 voters"]
    assert crosses(ax) == [(0, 0), (0, 1), (0, 2), (0, 3)]


def test_many_levels_leave_room_for_the_names_of_the_first_two(world, ax):
    plotting.plot_support(world, np.arange(GRID) * 20, ax=ax)
    ticks = ax.child_axes[0].get_yticks()
    low, high = ax.child_axes[0].get_ylim()
    assert np.diff(ticks).min() >= 0.04 * (high - low)
    assert len(ticks) <= 10


@pytest.mark.parametrize("largest", [300, 2**31 - 1])
def test_radii_in_metres_share_tones(largest, world, ax):
    radius = np.linspace(-1, largest, GRID).round()
    plotting.plot_radius(world, radius, ax=ax)
    ax.figure.canvas.draw()
    numbers = ax.images[0].norm(radius)
    assert numbers[0] == 0 and numbers[-1] == ax.images[0].cmap.N - 1
    assert np.all(np.diff(numbers) > 0)


def test_three_panels_of_a_gridworld(world):
    demonstrations = Demonstrations.from_trajectories([([0, 1, 5], [3, 1, 1])])
    general = nearest_neighbors(world.mdp, demonstrations)
    radius, support, policy = plotting.plot_generalization(world, general)
    assert [ax.get_title(loc="left") for ax in (radius, support, policy)] == ["radius", "support", "policy"]
    np.testing.assert_array_equal(heat(radius).ravel(), general.radius)
    expected = np.where(general.visited, 0, general.support)
    np.testing.assert_array_equal(heat(support).ravel(), expected)
    np.testing.assert_allclose(heat(policy).ravel(), np.asarray(general.policy).max(axis=1))
    assert of_type(policy, quiver.Quiver)
    policy.figure.canvas.draw()


def test_three_panels_of_a_track_at_one_speed_and_at_all(track):
    radius = np.where(np.arange(STATES) % 25 == 12, 1, -1)
    general = made_up(track, radius, np.where(radius > 0, 1, 0))
    own = plt.subplots(3)[1]
    panels = plotting.plot_generalization(track, general, ax=own)
    assert panels.tolist() == own.tolist()
    assert panels[2].get_title(loc="left") == "policy, speed (0, 0)"
    assert set(heat(panels[0]).compressed()) == {1}
    (arrows,) = of_type(panels[2], quiver.Quiver)
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V]), [[0] * OPEN, [-0.8] * OPEN])  # up
    mosaics = plotting.plot_generalization(track, general, speed=None)
    assert mosaics[2].get_title(loc="left") == "policy, all speeds"
    for panel, (level, other) in zip(mosaics, ((1, -1), (1, -1), (2, 0)), strict=True):
        cell = np.full((5, 5), other)
        cell[2, 2] = level
        np.testing.assert_array_equal(heat(panel)[5:10, 10:15], cell)
        assert len(crosses(panel)) == OPEN * 24
    assert bar_labels(mosaics[2])[:3] == ["no majority", "nothing", "\N{UPWARDS ARROW} up"]
    mosaics[0].figure.canvas.draw()


# --------------------------------------------------------------------------------------- certificates


def test_certificate_shows_the_best_gap_so_far(ax):
    lower, upper = np.array([0.0, 0.6, 0.5, 1.0]), np.array([2.0, 3.0, 1.0, 1.0])
    assert plotting.plot_certificate(lower, upper, label="columns", ax=ax) is ax
    best, own = (np.asarray(line.get_ydata()) for line in ax.lines)
    np.testing.assert_allclose(best[:3], [2.0, 1.4, 0.4])
    np.testing.assert_allclose(own[:3], [2.0, 2.4, 0.5])
    assert 0 < best[3] < 1e-14
    assert ax.get_yscale() == "log"
    plotting.plot_certificate(lower, upper, iterations=[10, 20, 30, 40], ax=ax)
    first, second = ax.lines[0], ax.lines[2]
    assert first.get_color() != second.get_color()
    assert (first.get_marker(), first.get_linestyle()) != (second.get_marker(), second.get_linestyle())
    ax.figure.canvas.draw()


def test_bounds_show_both_sides_and_the_best_so_far(ax):
    history = [(1, 0.0, 2.0), (4, 0.5, 1.0), (2, 0.6, 3.0)]
    assert plotting.plot_bounds(history, value="margin", ax=ax) is ax
    lines = {line.get_label(): line for line in ax.lines}
    np.testing.assert_array_equal(lines["lower bound"].get_xydata(), [(1, 0.0), (2, 0.6), (4, 0.5)])
    np.testing.assert_array_equal(lines["upper bound"].get_xydata(), [(1, 2.0), (2, 3.0), (4, 1.0)])
    assert lines["lower bound"].get_marker() != lines["upper bound"].get_marker()
    steps = [line.get_ydata().tolist() for line in ax.lines if line.get_marker() == "None"]
    assert steps == [[0.0, 0.6, 0.6], [2.0, 2.0, 1.0]]
    assert ax.get_legend().get_title().get_text() == "4.0e-01 apart"
    assert (ax.get_xscale(), ax.get_ylabel()) == ("linear", "margin")
    own = plotting.plot_bounds([(16, 0, 1), (320, jnp.zeros(()), 0.5)])
    assert own.get_xscale() == "log"
    own.figure.canvas.draw()


def test_histories_of_both_solvers_close(world):
    """As the module says to get them."""
    mdp = world.mdp
    expectations = np.array([9.0, 30.0, 30.0, 9.0])
    margins = [(n, s.margin, s.margin_bound) for n in (1, 4) for s in [lpal(mdp, expectations, max_iterations=n)]]
    solve = functools.partial(local_similarity, mdp, [5], [0], method="pdhg", tolerance=1e-9)
    brackets = {n: solve(max_iterations=n) for n in (16, 64)}
    errors = [(n, bracket.lower[0], bracket.upper[0]) for n, bracket in brackets.items()]
    for history in (margins, errors):
        ax = plotting.plot_bounds(history)
        lower, upper = (line.get_ydata() for line in ax.lines if line.get_marker() == "None")
        assert (lower <= upper).all()
        assert upper[-1] - lower[-1] < upper[0] - lower[0]


# ------------------------------------------------------------------------------------ malformed input

MALFORMED = {
    "radius": (lambda w, t: plotting.plot_radius(t, np.ones(CELLS)), "radius must have shape"),
    "radius of -2": (
        lambda w, t: plotting.plot_radius(w, np.arange(GRID) - 2),
        r"radius\[0\] must be whole and at least -1",
    ),
    "speed of radius": (lambda w, t: plotting.plot_radius(t, np.ones(STATES), speed=(3, 0)), "speed must be"),
    "support": (lambda w, t: plotting.plot_support(t, np.ones(CELLS)), "support must have shape"),
    "negative support": (
        lambda w, t: plotting.plot_support(w, np.arange(GRID) - 1),
        r"support\[0\] must be whole and not negative",
    ),
    "visited": (lambda w, t: plotting.plot_support(w, np.ones(GRID), visited=np.ones(3)), "visited must have shape"),
    "speed of support": (lambda w, t: plotting.plot_support(t, np.ones(STATES), speed=(0, 9)), "speed must be"),
    "another model's": (
        lambda w, t: plotting.plot_generalization(w, made_up(t, np.ones(STATES, int), np.ones(STATES, int))),
        "policy must have shape",
    ),
    "its speed": (
        lambda w, t: plotting.plot_generalization(
            t, made_up(t, np.ones(STATES, int), np.ones(STATES, int)), speed=(0, 3)
        ),
        "speed must be",
    ),
    "a policy": (
        lambda w, t: plotting.plot_generalization(w, np.ones((GRID, 4)) / 4),
        "must be a jaxhom.Generalization",
    ),
    "one panel": (
        lambda w, t: plotting.plot_generalization(w, made_up(w, np.ones(GRID, int), np.ones(GRID, int)), ax=[None]),
        r"ax must have shape \(3,\), three axes",
    ),
    "lower": (lambda w, t: plotting.plot_certificate(np.ones((2, 2)), np.ones(2)), "lower must"),
    "upper": (lambda w, t: plotting.plot_certificate(np.ones(2), np.ones(3)), "upper must"),
    "iterations": (
        lambda w, t: plotting.plot_certificate(np.ones(2), np.ones(2), iterations=[1]),
        "iterations must",
    ),
    "no number": (lambda w, t: plotting.plot_certificate([0.0, np.nan], np.ones(2)), r"lower\[1\] must be finite"),
    "history": (lambda w, t: plotting.plot_bounds(np.ones((3, 2))), r"history must have shape \[T, 3\]"),
    "no history": (lambda w, t: plotting.plot_bounds([]), r"history must have shape \[T, 3\]"),
    "infinite history": (lambda w, t: plotting.plot_bounds([(1, 0, np.inf)]), r"history\[0, 2\] must be finite"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_input_is_rejected_before_anything_is_drawn(world, track, name):
    draw, message = MALFORMED[name]
    with pytest.raises(ValueError, match=message):
        draw(world, track)
    assert not plt.get_fignums()
