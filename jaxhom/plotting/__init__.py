"""Pictures of gridworlds, racetracks, policies, demonstrations, generalizations and certificates.

Every `plot_*` function draws on the axes it is given and returns them; with `ax=None` it makes a
figure of a fitting size. The domain is a `Gridworld`, a `Racetrack` or a `TileMap`; models without a
map have pictures by the number of the state. Arrays may be JAX or NumPy.

One vocabulary throughout, told apart without colour vision (Okabe and Ito 2008; cividis, Nunez et
al. 2018): amounts run from white to blue, so that black arrows and orange lines stay legible on
them; ordinal levels are cividis; walls are grey, start cells green, finish cells chequered.

A racetrack's state is a cell and one of 25 speeds. What has one number per state is drawn per cell,
by the rule that each function states, or as a mosaic of the 25 speeds.

This module needs matplotlib (`pip install '.[plot]'` in a checkout); `import jaxhom` does not import it.
"""

try:
    import matplotlib  # noqa: F401
except ImportError as error:
    raise ImportError("jaxhom.plotting needs matplotlib, which is not installed: pip install '.[plot]'") from error

from jaxhom.plotting.certificates import plot_bounds, plot_certificate
from jaxhom.plotting.figures import learned_policy_figure
from jaxhom.plotting.generalizations import plot_generalization, plot_radius, plot_support
from jaxhom.plotting.numbered import (
    plot_occupancy_by_state,
    plot_policy_by_state,
    plot_radius_counts,
    plot_trajectories_by_state,
)
from jaxhom.plotting.pictures import (
    plot_gridworld,
    plot_occupancy,
    plot_policy,
    plot_racetrack,
    plot_trajectories,
)
from jaxhom.plotting.style import AMOUNT, BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, YELLOW

__all__ = [
    "AMOUNT",
    "BLACK",
    "BLUE",
    "GREEN",
    "ORANGE",
    "PURPLE",
    "SKY",
    "VERMILLION",
    "YELLOW",
    "learned_policy_figure",
    "plot_bounds",
    "plot_certificate",
    "plot_generalization",
    "plot_gridworld",
    "plot_occupancy",
    "plot_occupancy_by_state",
    "plot_policy",
    "plot_policy_by_state",
    "plot_racetrack",
    "plot_radius",
    "plot_radius_counts",
    "plot_support",
    "plot_trajectories",
    "plot_trajectories_by_state",
]
