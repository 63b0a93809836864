"""Ways in and out of the library: environments, models, data of others, and files.

* `from_gymnasium`, `make_environment`: an environment with a transition table, with its reward.
* `from_mdptoolbox`, `from_scipy`: transition matrices.
* `from_samples`: recorded transitions, with the uncertainty of each row.
* `demonstrations_from_episodes`, `demonstrations_from_steps`, `demonstrations_from_csv`: trajectories of `imitation`,
  Minari, arrays and CSV files, with a report of what was dropped; `answers_from_csv`: answers about single states.
* `save_*`, `load_*`: models, demonstrations and policies in `.npz` files, and whatever else is in these.
* `save_similarity`, `load_similarity`: what a table of similarities has solved, for a later process to go on from.
* `save_all_brackets`, `load_all_brackets`: those of all pairs, in a folder, for several processes and in turns.

Maps of racetracks, `.track` files among them, are read by `jaxhom.racetrack` itself. No other library is imported
before it is needed.
"""

from jaxhom.interop.all_brackets import AllBrackets, load_all_brackets, save_all_brackets
from jaxhom.interop.csv_steps import answers_from_csv, demonstrations_from_csv
from jaxhom.interop.environment_makers import make_environment
from jaxhom.interop.environments import GymnasiumModel, from_gymnasium
from jaxhom.interop.files import (
    FileError,
    load_arrays,
    load_demonstrations,
    load_mdp,
    load_policy,
    save_demonstrations,
    save_mdp,
    save_policy,
)
from jaxhom.interop.import_reports import ImportReport
from jaxhom.interop.matrices import from_mdptoolbox, from_scipy
from jaxhom.interop.samples import SampledModel, from_samples
from jaxhom.interop.similarity_files import load_similarity, save_similarity
from jaxhom.interop.trajectories import (
    demonstrations_from_episodes,
    demonstrations_from_steps,
    demonstrations_from_transitions,
)

__all__ = [
    "AllBrackets",
    "FileError",
    "GymnasiumModel",
    "ImportReport",
    "SampledModel",
    "answers_from_csv",
    "demonstrations_from_csv",
    "demonstrations_from_episodes",
    "demonstrations_from_steps",
    "demonstrations_from_transitions",
    "from_gymnasium",
    "from_mdptoolbox",
    "from_samples",
    "from_scipy",
    "load_all_brackets",
    "load_arrays",
    "load_demonstrations",
    "load_mdp",
    "load_policy",
    "load_similarity",
    "make_environment",
    "save_all_brackets",
    "save_demonstrations",
    "save_mdp",
    "save_policy",
    "save_similarity",
]
