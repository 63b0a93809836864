"""The colours of all pictures, told apart without colour vision (Okabe and Ito 2008)."""

from matplotlib import colors

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
"""The palette of Okabe and Ito (2008)."""
AMOUNT = colors.LinearSegmentedColormap.from_list("jaxhom_amount", ["#FFFFFF", "#A9D8F4", "#2C8CC9"])
"""Colours of amounts, white to blue, light enough everywhere for black on top."""

INK, WALL, ROAD, FAINT = "#222222", "#C9C9C9", "#FFFFFF", "#BBBBBB"
START, TINT = "#9AD9C3", "#F6EC86"
