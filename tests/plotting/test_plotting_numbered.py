"""Pictures of models without a map: what is drawn is what was given."""

import numpy as np
import pytest

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402

from jaxhom import Demonstrations, gridworld, plotting  # noqa: E402

POLICY = np.array([[0.25, 0.75], [1.0, 0.0], [0.5, 0.5]])


@pytest.fixture(params=[False, True])
def ax(request):
    yield plt.subplots()[1] if request.param else None
    plt.close("all")


def test_policies_are_images(ax):
    drawn = plotting.plot_policy_by_state(POLICY, visited=[False, True, True], ax=ax)
    assert ax is None or drawn is ax
    np.testing.assert_array_equal(drawn.images[0].get_array(), POLICY.T)
    np.testing.assert_array_equal(drawn.lines[0].get_xdata(), [1, 2])
    plain = plotting.plot_policy_by_state(POLICY)
    assert not plain.lines
    drawn.figure.canvas.draw()


def test_occupancies_are_spikes(ax):
    drawn = plotting.plot_occupancy_by_state([[3.0, 1.0], [0.0, 0.0], [1e-3, 0.0]], ax=ax)
    spikes = drawn.collections[0].get_segments()
    np.testing.assert_allclose([spike[:, 0] for spike in spikes], [[0, 0], [2, 2]])
    np.testing.assert_allclose([spike[1, 1] for spike in spikes], [4.0, 1e-3])
    assert drawn.get_yscale() == "log"


def test_trajectories_are_lines_over_steps(ax):
    drawn = plotting.plot_trajectories_by_state(
        Demonstrations.from_trajectories([([2, 5], [0, 0]), ([7, 1, 3], [0] * 3)]), ax=ax
    )
    np.testing.assert_array_equal(drawn.lines[0].get_ydata(), [2, 5])
    np.testing.assert_array_equal(drawn.lines[2].get_ydata(), [7, 1, 3])
    np.testing.assert_array_equal(drawn.lines[3].get_ydata(), [7])  # the ring where it begins


@pytest.mark.parametrize(
    ("radius", "heights"),
    [([0, 0, -1, 2, 1, 2], [1, 2, 1, 2]), ([0, 0], [0, 2, 0]), ([-1, 50], [1, 0] + [0] * 49 + [1])],
)
def test_radii_are_counted(ax, radius, heights):
    drawn = plotting.plot_radius_counts(np.array(radius), ax=ax)
    assert [bar.get_height() for bar in drawn.patches] == heights
    labels = [label.get_text() for label in drawn.get_xticklabels()]
    assert labels[2] == "1" and len(labels) <= 22


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: plotting.plot_policy_by_state(np.ones(3)), r"policy must have shape \[S, A\]"),
        (lambda: plotting.plot_policy_by_state(POLICY, visited=np.ones(2)), r"visited must have shape \(3,\)"),
        (lambda: plotting.plot_occupancy_by_state(np.ones((1, 1, 1))), r"occupancy must have shape \[S\] or"),
        (lambda: plotting.plot_occupancy_by_state(np.zeros(3)), "occupancy must be positive in some state"),
        (lambda: plotting.plot_occupancy_by_state([np.nan]), r"occupancy\[0\] must be finite"),
        (lambda: plotting.plot_radius_counts(np.ones((2, 2))), r"radius must have shape \[S\]"),
        (lambda: plotting.plot_radius_counts([0, -2]), r"radius\[1\] must be whole and at least -1"),
    ],
)
def test_malformed_input_is_rejected(draw, message):
    with pytest.raises(ValueError, match=message):
        draw()
    assert not plt.get_fignums()


def test_answers_have_no_time_and_no_offset(ax):
    """By state they are left out; on a map they are rings, and the other trajectories run as they did."""
    walks = Demonstrations.from_trajectories([([0, 1, 5], [3, 1, 1]), ([4, 5], [3, 3])])
    shown = walks.with_answers([9, 10], [0, 1])
    plain, answered = (plotting.plot_trajectories_by_state(some) for some in (walks, shown))
    assert len(answered.lines) == len(plain.lines)
    grid = gridworld(4)
    plain, answered = plotting.plot_trajectories(grid, walks), plotting.plot_trajectories(grid, shown, ax=ax)
    for one, other in zip(plain.lines, answered.lines, strict=False):
        np.testing.assert_allclose(other.get_xydata(), one.get_xydata())
    np.testing.assert_allclose(answered.lines[2].get_xydata(), [[1, 2]])


def test_few_states_and_actions_are_called_by_their_names():
    names = {"state_names": ["door", "room", (0, 1)], "action_names": ["stay", "go"]}
    drawn = plotting.plot_policy_by_state(POLICY, **names)
    assert [label.get_text() for label in drawn.get_xticklabels()] == ["door", "room", "(0, 1)"]
    assert [label.get_text() for label in drawn.get_yticklabels()] == ["stay", "go"]
    odd = plotting.plot_policy_by_state(POLICY, state_names=["$100_$200", "$x$", "\ud800"])
    odd.figure.canvas.draw()
    assert [label.get_text() for label in odd.get_xticklabels()] == ["$100_$200", "$x$", "\\ud800"]
    many = plotting.plot_occupancy_by_state(np.ones(100), state_names=range(1000, 1100))
    assert "1000" not in [label.get_text() for label in many.get_xticklabels()]
    with pytest.raises(ValueError, match="state_names must be 3 names, got 2"):
        plotting.plot_policy_by_state(POLICY, state_names=["a", "b"])
