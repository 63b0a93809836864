"""`python -m jaxhom learn`: a policy for a user's own model and demonstrations."""

import jax.numpy as jnp
import numpy as np

from jaxhom.cli.tables import format_table
from jaxhom.demonstrations import empirical_policy, monte_carlo_feature_expectations
from jaxhom.generalization import (
    Generalization,
    maximum_entropy,
    nearest_neighbors,
    soft_local_homomorphism,
)
from jaxhom.interop.files import FileError, load_demonstrations, load_mdp, save_policy
from jaxhom.lpal import lpal
from jaxhom.occupancy import feature_expectations
from jaxhom.pdhg import Status

METHODS = ("soft-local-homomorphism", "nearest-neighbors", "maximum-entropy", "monte-carlo")


def run(options) -> None:
    """Reads, learns, prints a summary and writes the policy; raises `FileError` or `ValueError` on bad input."""
    mdp = load_mdp(options.mdp)
    demonstrations = load_demonstrations(options.demonstrations)
    try:
        demonstrations.validate(mdp)
    except ValueError as error:
        raise FileError(f"{options.demonstrations}: {error}") from None
    wants_lpal = options.lpal or options.method == "monte-carlo"
    if wants_lpal and not mdp.num_features:
        raise FileError(f"{options.mdp}: LPAL needs features, and the model has none")
    if wants_lpal:
        expectations, generalization = _expectations(mdp, demonstrations, options)
        initial = None if generalization is None else generalization.policy
        solution = lpal(mdp, expectations, initial_policy=initial, progress=True)
        policy = solution.policy
        certificate = {"margin": solution.margin, "margin_bound": solution.margin_bound}
    else:
        generalization, solution = _generalize(mdp, demonstrations, options), None
        policy, certificate = generalization.policy, {}
    extras = {} if generalization is None else {"radius": generalization.radius, "support": generalization.support}
    visited, _ = empirical_policy(mdp, demonstrations)
    save_policy(options.output, policy, visited=visited, **extras, **certificate)
    print(_summary(mdp, demonstrations, visited, generalization, solution))
    print(f"\nPolicy written to {options.output}")


def _generalize(mdp, demonstrations, options) -> Generalization:
    if options.method == "nearest-neighbors":
        return nearest_neighbors(mdp, demonstrations)
    if options.method == "maximum-entropy":
        return maximum_entropy(mdp, demonstrations)
    return soft_local_homomorphism(
        mdp,
        demonstrations,
        distance=options.distance,
        threshold=options.threshold,
        anchored=not options.printed,
        mutual=options.mutual,
        progress=True,
    )


def _expectations(mdp, demonstrations, options):
    """What LPAL is to match, and the generalization it came from, if any."""
    if options.method == "monte-carlo":
        return monte_carlo_feature_expectations(mdp, demonstrations), None
    generalization = _generalize(mdp, demonstrations, options)
    return feature_expectations(mdp, generalization.policy), generalization


def _summary(mdp, demonstrations, visited, generalization, solution) -> str:
    rows = [
        ("states, actions, features", f"{mdp.num_states}, {mdp.num_actions}, {mdp.num_features}"),
        ("demonstrations", f"{demonstrations.num_trajectories}"),
        ("steps in them", f"{int(np.asarray(demonstrations.mask).sum())}"),
        ("states demonstrated", _share(visited)),
    ]
    if generalization is not None:
        radius = np.asarray(generalization.radius)
        rows.append(("states generalized to", _share(radius > 0)))
        rows.append(("states without a vote (uniform policy)", _share(radius < 0)))
        if (radius > 0).any():
            found = radius[radius > 0]
            rows.append(("steps to the voters, median and largest", f"{int(np.median(found))}, {found.max()}"))
    if solution is not None:
        rows.append(("LPAL margin", f"{float(solution.margin):.6g}"))
        rows.append(("no policy's margin exceeds", f"{float(solution.margin_bound):.6g}"))
        rows.append(("LPAL status", Status(int(solution.status)).message))
    return format_table(("quantity", "value"), rows)


def _share(mask) -> str:
    mask = jnp.asarray(mask)
    return f"{int(mask.sum())} ({100 * float(mask.mean()):.1f}%)"
