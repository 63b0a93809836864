"""The navigation domains of Boularias and Chaib-draa (2010), section VI, as models.

`gridworld` is the square grid of regions of section VI.A, `racetrack` the car of section VI.B.
"""

from jaxhom.domains.gridworld import Gridworld, gridworld, sample_weights
from jaxhom.domains.racetrack import Racetrack, racetrack

__all__ = ["Gridworld", "Racetrack", "gridworld", "racetrack", "sample_weights"]
