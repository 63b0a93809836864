"""What all pictures look like: colours told apart without colour vision (Okabe and Ito 2008), signs, plain axes."""

from matplotlib import colors
from matplotlib.axes import Axes

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
"""The palette of Okabe and Ito (2008)."""
AMOUNT = colors.LinearSegmentedColormap.from_list("jaxhom_amount", ["#FFFFFF", "#A9D8F4", "#2C8CC9"])
"""Colours of amounts, white to blue, light enough everywhere for black on top."""

INK, WALL, ROAD, FAINT = "#222222", "#C9C9C9", "#FFFFFF", "#BBBBBB"
START, TINT = "#9AD9C3", "#F6EC86"

SIGNS = ("\N{MULTIPLICATION SIGN} nothing found", "\N{BULLET} demonstrated")
"""Of states to which nothing was generalized, and of those that the expert visited."""

OCCUPANCY_RANGE = 1e4
"""Occupancies that are so many times smaller than the largest are not drawn."""


def plain_axes(ax: Axes) -> Axes:
    """A faint grid of heights, and no frame at the top and on the right."""
    ax.grid(axis="y", color="#E3E3E3", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return ax
