"""Which problems the sweeps pose: the paper's gridworlds and racetracks, and variations of them."""

import dataclasses

GRID_LENGTHS = {16: 50, 24: 50, 32: 100, 48: 200}
"""Steps of a demonstration, and of a trial, per size of the grid (section VI.A)."""
GRID_DEMONSTRATIONS = 10
GRID_REGIONS = {16: (16, 64, 256), 24: (64, 144, 576), 32: (64, 256, 1024), 48: (64, 256, 2304)}
"""The rows of Table I."""
TRACK_LENGTHS = {"track_a": (20, 30), "track_b": (40, 50), "track_corner": (10, 15)}
"""Steps of a demonstration and of a trial (section VI.B); the corner is a small track of ours (`tracks/`)."""
OTHER_LENGTHS = {"lake8": (40, 100), "lake16": (80, 200), "road": (40, 60)}
"""Steps of a demonstration and of a trial on frozen lakes and on a road network."""
TILED_LENGTHS = {"tiles8": (40, 100), "tiles16": (80, 200)}
"""Likewise on the same lakes with features of their goal, holes and tiles of ice."""
QUESTIONS_PER_ROUND = {"tiles8": 5}
"""How many states are asked about before the next policy is learned; 20 where nothing else is said."""
WEIGHT_SUMS = {"track_a": 205.0, "track_b": 205.0}
"""What the weights of the true reward sum to on tracks, where losses are reported in weights of sum 1."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """A family of problems, of which draws are numbered.

    Attributes:
      domain: "grid" and its size, or a key of `TRACK_LENGTHS` or `OTHER_LENGTHS`.
      regions: K of a gridworld, 0 on tracks.
      demonstrations: how many of the draw's trajectories the learner sees: the first ones, so that the demonstrations
        of one number are among those of a larger one.
      pool: how many trajectories are drawn.
      length: steps of a trajectory. trial: steps of a trial at most.
      distance, threshold: d and epsilon of Algorithm 1.
      samples: draws per state and action from which the learner's model is estimated; 0 for the true model.
    """

    domain: str
    regions: int
    demonstrations: int
    pool: int
    length: int
    trial: int
    distance: int = 1
    threshold: float = 0.0
    samples: int = 0

    @property
    def name(self) -> str:
        """For people, and for choosing settings on the command line."""
        regions = f"/{self.regions}" if self.regions else ""
        options = f"/d{self.distance}/eps{self.threshold:g}" if (self.distance, self.threshold) != (1, 0.0) else ""
        samples = f"/n{self.samples}" if self.samples else ""
        return f"{self.domain}{regions}/{self.demonstrations}{options}{samples}"

    @property
    def source(self) -> str:
        """What the random draws depend on: settings that differ in the learner alone share their draws."""
        return f"{self.domain}/{self.regions}/{self.pool}/{self.length}"


def grid(size: int, regions: int, demonstrations: int = GRID_DEMONSTRATIONS, pool: int | None = None) -> Setting:
    """A gridworld of section VI.A."""
    length = GRID_LENGTHS[size]
    return Setting(f"grid{size}", regions, demonstrations, pool or demonstrations, length, length)


def track(domain: str, demonstrations: int, pool: int, **options) -> Setting:
    """A racetrack of section VI.B."""
    return Setting(domain, 0, demonstrations, pool, *TRACK_LENGTHS[domain], **options)


def tiled(domain: str, demonstrations: int, pool: int) -> Setting:
    """A lake whose features are its goal, its holes and tiles of 2 x 2 cells."""
    return Setting(domain, 0, demonstrations, pool, *TILED_LENGTHS[domain])


def misled(size: int, regions: int, demonstrations: int, pool: int) -> Setting:
    """A gridworld whose learner has features of the wrong regions (`problems.build_domain`)."""
    return Setting(f"wrong{size}", regions, demonstrations, pool, GRID_LENGTHS[size], GRID_LENGTHS[size])


def other(domain: str, demonstrations: int, pool: int) -> Setting:
    """A lake or the road network."""
    return Setting(domain, 0, demonstrations, pool, *OTHER_LENGTHS[domain])


def table1() -> list[Setting]:
    """The rows of Table I."""
    return [grid(size, regions) for size, all_regions in GRID_REGIONS.items() for regions in all_regions]


def figure1() -> list[Setting]:
    """The points of Figure 1."""
    short = [track("track_a", count, 10) for count in range(2, 11)]
    return short + [track("track_b", count, 100) for count in range(10, 101, 10)]


def threshold_question() -> list[Setting]:
    """Error threshold and distance, with two demonstrations.

    A change of speed succeeds with probability 0.9 or 0.5, so that errors pile up at 0.2, 0.25, 0.3, 0.45 and the like.
    The thresholds lie between those: whether e <= 0.2 takes a solver long where e = 0.2.
    """
    thresholds = (0.0, 0.1, 0.19, 0.23, 0.28, 0.4, 0.46, 0.55, 0.8, 1.0)
    few = (0.0, 0.23, 0.4, 0.55, 0.8)  # local models of up to 21 states take their time
    chosen = {("track_a", 1): thresholds, ("track_corner", 1): thresholds, ("track_corner", 2): few}
    return [track(name, 2, 10, distance=d, threshold=e) for (name, d), values in chosen.items() for e in values]


def noise_question() -> list[Setting]:
    """A model estimated from few transitions, and the threshold that forgives it."""
    thresholds = (0.0, 0.05, 0.1, 0.19, 0.28, 0.4, 0.55)
    samples = (5, 20, 100, 1000, 0)
    return [track("track_corner", 2, 10, threshold=e, samples=count) for count in samples for e in thresholds]


def enough_question() -> list[Setting]:
    """How many demonstrations are needed, on grids with regions of 2 x 2 to 6 x 6 cells and on both tracks."""
    grids = [grid(size, 64, count, 100) for size in GRID_LENGTHS for count in (1, 2, 3, 5, 10, 20, 50, 100)]
    tracks = [track(name, count, 500) for name in ("track_a", "track_b") for count in (2, 5, 10, 20, 50, 100, 200, 500)]
    return grids + tracks


def relations_question() -> list[Setting]:
    """Racetracks, grids and lakes on which relations are compared."""
    tracks = [track(name, count, 30) for name in ("track_a", "track_corner") for count in (2, 5, 10)]
    tracks += [track("track_b", count, 30) for count in (10, 30)]
    grids = [grid(size, 64, count, 10) for size in (16, 24) for count in (2, 5, 10)]
    return tracks + grids + [other(name, count, 10) for name in ("lake8", "lake16") for count in (2, 5, 10)]


def roads_question() -> list[Setting]:
    """A road network, on which labels say how much of a detour an exit is."""
    return [other("road", count, 30) for count in (2, 5)]


def transfer_question() -> list[Setting]:
    """The second racetrack; what is demonstrated is the first one (`relations.across`)."""
    return [track("track_b", count, 30) for count in (2, 5)]


_FEW = (1, 2, 5, 10, 20)


def learners_question() -> list[Setting]:
    """Where learners of weights are compared with generalizations: right features, wrong ones, telling ones."""
    grids = [make(16, 64, count, 20) for make in (grid, misled) for count in _FEW]
    tracks = [track(name, count, 30) for name in ("track_a", "track_b") for count in (2, 5, 10, 20)]
    return grids + tracks + [tiled(name, count, 20) for name in TILED_LENGTHS for count in _FEW]


def guarantees_question() -> list[Setting]:
    """As for learners, but for wrong features, in which the true reward has no weights."""
    return [setting for setting in learners_question() if not setting.domain.startswith("wrong")]


def queries_question() -> list[Setting]:
    """Where single states are asked about, after 2 and 5 demonstrations."""
    grids = [make(16, 64, count, 20) for make in (grid, misled) for count in (2, 5)]
    tracks = [track(name, count, 30) for name in ("track_a", "track_b") for count in (2, 5)]
    return grids + tracks + [tiled(name, count, 20) for name in TILED_LENGTHS for count in (2, 5)]


def normalisation_question() -> list[Setting]:
    """Rows of Table I, for Monte Carlo expectations in two normalisations."""
    return [setting for setting in table1() if setting.domain != "grid48"]
