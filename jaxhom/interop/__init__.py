"""Ways in and out of the library: environments, models, data of others, and files.

* `from_gymnasium`, `make_environment`: an environment with a transition table, with its reward.
* `from_mdptoolbox`, `from_scipy`: transition matrices.
* `from_cassandra`, `from_prism`, `from_table`, `from_octile`, `from_gridworld`, `from_networkx`, `from_edges`: models
  that others wrote, as an `ImportedModel` with reward, names and remarks; `read_model` chooses by a file's suffix.
* `from_samples`: recorded transitions of environments without a table, with the uncertainty of each row.
* `demonstrations_from`: trajectories from a file, a folder or an object, with a report of what was dropped. What it
  goes through are `demonstrations_from_csv` (text), `demonstrations_from_episodes` (`imitation`, Minari, pairs),
  `demonstrations_from_steps`, `demonstrations_from_transitions` (flat arrays) and `demonstrations_from_states` (states
  without actions). `answers_from_csv`: answers about single states.
* `save_*`, `load_*`: models, demonstrations and policies in `.npz` files, and whatever else is in these.
* `save_similarity`, `load_similarity`: what a table of similarities has solved, for a later process to go on from.
* `save_all_brackets`, `load_all_brackets`: those of all pairs, in a folder, for several processes and in turns.

Maps of racetracks, `.track` files among them, are read by `jaxhom.racetrack` itself. No other library is imported
before it is needed.
"""

from jaxhom.interop.all_brackets import AllBrackets, load_all_brackets, save_all_brackets
from jaxhom.interop.archives import FileError
from jaxhom.interop.cassandra import from_cassandra
from jaxhom.interop.csv_answers import answers_from_csv
from jaxhom.interop.csv_steps import demonstrations_from_csv
from jaxhom.interop.environment_makers import make_environment
from jaxhom.interop.environments import GymnasiumModel, from_gymnasium
from jaxhom.interop.files import (
    load_arrays,
    load_demonstrations,
    load_mdp,
    load_policy,
    save_demonstrations,
    save_mdp,
    save_policy,
)
from jaxhom.interop.flat_steps import demonstrations_from_steps, demonstrations_from_transitions
from jaxhom.interop.gridworld_files import from_gridworld
from jaxhom.interop.import_reports import ImportReport
from jaxhom.interop.imported_model import ImportedModel
from jaxhom.interop.matrices import from_mdptoolbox, from_scipy
from jaxhom.interop.model_files import read_model
from jaxhom.interop.networks import from_edges, from_networkx
from jaxhom.interop.octile import from_octile
from jaxhom.interop.prism import from_prism
from jaxhom.interop.samples import SampledModel, from_samples
from jaxhom.interop.similarity_files import load_similarity, save_similarity
from jaxhom.interop.state_sequences import demonstrations_from_states
from jaxhom.interop.tables import from_table
from jaxhom.interop.trajectories import demonstrations_from_episodes
from jaxhom.interop.trajectory_sources import demonstrations_from

__all__ = [
    "AllBrackets",
    "FileError",
    "GymnasiumModel",
    "ImportReport",
    "ImportedModel",
    "SampledModel",
    "answers_from_csv",
    "demonstrations_from",
    "demonstrations_from_csv",
    "demonstrations_from_episodes",
    "demonstrations_from_states",
    "demonstrations_from_steps",
    "demonstrations_from_transitions",
    "from_cassandra",
    "from_edges",
    "from_gridworld",
    "from_gymnasium",
    "from_mdptoolbox",
    "from_networkx",
    "from_octile",
    "from_prism",
    "from_samples",
    "from_scipy",
    "from_table",
    "load_all_brackets",
    "load_arrays",
    "load_demonstrations",
    "load_mdp",
    "load_policy",
    "load_similarity",
    "make_environment",
    "read_model",
    "save_all_brackets",
    "save_demonstrations",
    "save_mdp",
    "save_policy",
    "save_similarity",
]
