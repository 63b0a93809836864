"""The navigation domains of Boularias and Chaib-draa (2010), section VI, as models.

`gridworld` is the square grid of regions of section VI.A, `racetrack` the car of section VI.B.
`TileMap` lays the states of any other model out on a map.
"""

from jaxhom.domains.gridworld import Gridworld, gridworld, sample_weights
from jaxhom.domains.racetrack import Racetrack, racetrack
from jaxhom.domains.tile_map import TileMap

__all__ = ["Gridworld", "Racetrack", "TileMap", "gridworld", "racetrack", "sample_weights"]
