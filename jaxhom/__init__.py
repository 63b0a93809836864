"""jaxhom: apprenticeship learning when demonstrations cover only a small part of a large state space.

From a few expert trajectories in a finite MDP without a reward to a policy for every state: the expert's actions are
carried over to states whose local model is softly homomorphic to a demonstrated one (Boularias and Chaib-draa 2010),
feature expectations come from linear solves, and LPAL turns them into a policy with a certified margin.

Importing the library changes no JAX setting. For float64, set `jax_enable_x64` before making models.
"""

from jaxhom import interrupts

interrupts.watch_while_loading()  # before the imports below, which take a second; in `python -m jaxhom` alone

from jaxhom.apprenticeship.inverse_lp import inverse_lp
from jaxhom.apprenticeship.learned import Learned
from jaxhom.apprenticeship.lpal import LPAL, LPALMethod, LPALSolution, lpal
from jaxhom.apprenticeship.max_causal_entropy import max_causal_entropy
from jaxhom.apprenticeship.mwal import mwal
from jaxhom.apprenticeship.projection import projection
from jaxhom.domains.gridworld import Gridworld, gridworld, sample_weights
from jaxhom.domains.racetrack import Racetrack, racetrack
from jaxhom.domains.tile_map import TileMap
from jaxhom.generalization.algorithm1 import soft_local_homomorphism
from jaxhom.generalization.choice import choose_generalization
from jaxhom.generalization.explanation import Explanation
from jaxhom.generalization.model_map import SoftHomomorphism
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.regression import occupancy_regression
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.soft_homomorphism import soft_homomorphism
from jaxhom.generalization.uniform import maximum_entropy, uniform_elsewhere
from jaxhom.guarantees.loss_bound import LossBound, loss_bound
from jaxhom.guarantees.queries import Queries, query_states
from jaxhom.guarantees.robust_policy import RobustPolicy, robust_policy
from jaxhom.models.demonstrations import (
    Demonstrations,
    empirical_policy,
    monte_carlo_feature_expectations,
    sample_demonstrations,
)
from jaxhom.models.disjoint_union import DisjointUnion, disjoint_union
from jaxhom.models.impossible_steps import ImpossibleStepsWarning
from jaxhom.models.mdp import MDP
from jaxhom.models.stacking import stack_models
from jaxhom.planning.occupancy import feature_expectations, occupancy, policy_value
from jaxhom.planning.optimal import Plan, optimal_policy
from jaxhom.planning.soft_optimal import soft_optimal_policy
from jaxhom.planning.trials import Evaluation, agreement, evaluate_by_sampling, evaluate_exactly
from jaxhom.similarity.brackets import LocalSimilarity
from jaxhom.similarity.local_pairs import local_similarity, locally_similar
from jaxhom.similarity.model_errors import homomorphism_error
from jaxhom.similarity.regularized_map import homomorphism_map
from jaxhom.similarity.table import SimilarityTable
from jaxhom.status import Status

__version__ = "0.2.0"

__all__ = [
    "LPAL",
    "MDP",
    "Demonstrations",
    "DisjointUnion",
    "Evaluation",
    "Explanation",
    "Generalization",
    "Gridworld",
    "ImpossibleStepsWarning",
    "LPALMethod",
    "LPALSolution",
    "Learned",
    "LocalSimilarity",
    "LossBound",
    "Plan",
    "Queries",
    "Racetrack",
    "RobustPolicy",
    "SimilarityTable",
    "SoftHomomorphism",
    "Status",
    "TileMap",
    "agreement",
    "choose_generalization",
    "disjoint_union",
    "empirical_policy",
    "evaluate_by_sampling",
    "evaluate_exactly",
    "feature_expectations",
    "gridworld",
    "homomorphism_error",
    "homomorphism_map",
    "inverse_lp",
    "local_similarity",
    "locally_similar",
    "loss_bound",
    "lpal",
    "max_causal_entropy",
    "maximum_entropy",
    "monte_carlo_feature_expectations",
    "mwal",
    "nearest_neighbors",
    "occupancy",
    "occupancy_regression",
    "optimal_policy",
    "policy_value",
    "projection",
    "query_states",
    "racetrack",
    "robust_policy",
    "sample_demonstrations",
    "sample_weights",
    "soft_homomorphism",
    "soft_local_homomorphism",
    "soft_optimal_policy",
    "stack_models",
    "uniform_elsewhere",
]
