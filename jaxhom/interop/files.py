"""Models, demonstrations and policies as `.npz` files: NumPy archives of plain arrays, no pickles.

    model           discount          scalar in (0, 1)
                    transition        [S, A, S], rows sum to 1                        one of
                    next_state        integers [S, A, N] and                          these
                    probability       [S, A, N], rows sum to 1                        two
                    initial           [S], optional: uniform if missing
                    features          [S, A, K] or [S, K], optional
                    allowed           bool [S, A], optional: the actions that exist
                    state_names       texts [S], or integers [S] or [S, D], optional: see `name_arrays`
                    action_names      likewise, of actions
    beside a model  reward            [S, A] or [S]                                   all optional,
                    coordinates       [S, D], positions of the states                 read by the
                    terminal          bool [S], where episodes end                    command line
    demonstrations  states, actions   integers [M, H] (or [H] for one trajectory); an action of -1: not known, hidden
                    length            integers [M], optional: steps of each trajectory; H if missing
                    terminated        bool [M], optional: whether its episode ended; False if missing
                    final_states      integers [M], optional: the state after the last step; -1: unknown
    policy          policy            [S, A], rows sum to 1
                    and whatever else its maker put there
    similarities    what `save_similarity` and `--table` of the command line write
    each            format_version    1, optional

Anything that `numpy.savez` wrote with these names is read. What is read goes through the same checks as fresh input;
whatever is wrong is one `FileError` that names the file and the array. A file of a newer format is refused.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of, read_archive, require_arrays, write_archive
from jaxhom.interop.name_arrays import names_as_array, names_of
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float, Shaped

DEMONSTRATIONS = ("states", "actions", "length", "terminated", "final_states", "is_answer")
_ALONE = "marks a trajectory of more than one step"
_ENDS_HIDDEN = "must be False where the last step is hidden: what it led to is not known"


def load_mdp(path: str | os.PathLike, *, discount: Float[ArrayLike, ""] | None = None) -> MDP:
    """Reads a model (see the module's table), in the dtype of its probabilities.

    Args:
      path: the file.
      discount: the model's, if the file holds none.

    Raises:
      FileError: if the file is missing, truncated, of another kind, or holds invalid values, or if there are two
        discounts.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "rooms.npz")
      >>> np.savez(path, transition=np.full((2, 1, 2), 0.5), discount=0.9)
      >>> load_mdp(path).num_states
      2
    """
    arrays = read_archive(path)
    options: dict[str, Any] = {name: arrays[name] for name in ("initial", "features", "allowed") if name in arrays}
    if discount is not None:
        if "discount" in arrays:
            raise FileError(f"{path}: it has a discount of its own, {checks.in_one_line(arrays['discount'].tolist())}")
        arrays["discount"] = np.asarray(discount)
    require_arrays(path, arrays, "discount")
    with errors_of(path):
        options |= {name: names_of(name, arrays[name]) for name in ("state_names", "action_names") if name in arrays}
        if "transition" in arrays:
            return MDP.from_dense(arrays["transition"], discount=arrays["discount"], **options)
        if "next_state" not in arrays and "probability" not in arrays:
            raise ValueError("neither transition nor next_state and probability are in it")
        require_arrays(path, arrays, "next_state", "probability")
        return MDP.from_successors(arrays["next_state"], arrays["probability"], discount=arrays["discount"], **options)


def load_demonstrations(path: str | os.PathLike) -> Demonstrations:
    """Reads demonstrations (see the module's table).

    Raises:
      FileError: as `load_mdp`.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "walks.npz")
      >>> np.savez(path, states=[[0, 1, 1], [0, 2, 0]], actions=[[1, 1, 0], [1, 0, 0]], length=[2, 3])
      >>> load_demonstrations(path).mask.tolist()
      [[True, True, False], [True, True, True]]
    """
    arrays = read_archive(path)
    require_arrays(path, arrays, "states", "actions")
    with errors_of(path):
        states, actions = np.atleast_2d(arrays["states"]), np.atleast_2d(arrays["actions"])
        checks.require_shape("states", states, "[M, H]", states.ndim == 2)
        checks.require_shape("actions", actions, str(states.shape), actions.shape == states.shape)
        count, horizon = states.shape
        length = arrays.get("length", np.full(count, horizon))
        checks.require_shape("length", length, f"({count},)", length.shape == (count,))
        length = checks.require_integers("length", length, upper=horizon + 1)
        steps = np.arange(horizon) < length[:, None]
        mask = steps & (actions != -1)
        final = arrays.get("final_states", np.full(count, -1))
        checks.require_shape("final_states", final, f"({count},)", final.shape == (count,))
        if (mask != steps).any():  # hidden steps; text is left to the checks below
            actions = np.where(mask, actions, 0)
            shown = np.where(mask.any(axis=1), horizon - mask[:, ::-1].argmax(axis=1), length)
            if "terminated" in arrays:
                terminated = checks.require_flags("terminated", arrays["terminated"], count)
                checks.require_all("terminated", terminated, ~terminated | (shown == length), _ENDS_HIDDEN)
            final = np.where(shown < length, states[np.arange(count), np.minimum(shown, horizon - 1)], final)
            length = shown  # the state after the last step that is shown is the final one
        rows = zip(states, actions, length, final, strict=True)
        trajectories = [(np.append(s[:n], z) if z != -1 else s[:n], a[:n]) for s, a, n, z in rows]
        is_answer = arrays.get("is_answer", np.zeros(count, bool))
        is_answer = checks.require_flags("is_answer", is_answer, count)
        checks.require_all("is_answer", is_answer, ~is_answer | (length == 1), _ALONE)
        demonstrations = Demonstrations.from_trajectories(trajectories, terminated=arrays.get("terminated"))
        mask = checks.to_device(mask[:, : demonstrations.horizon])
        return demonstrations.replace(mask=mask, is_answer=checks.to_device(is_answer))


def load_arrays(path: str | os.PathLike, *names: str) -> dict[str, np.ndarray]:
    """Reads those of the named arrays that a file holds, whatever else is in it; their values are not checked.

    Raises:
      FileError: if the file is missing, truncated or of another kind, or one of the arrays holds pickled objects.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "model.npz")
      >>> np.savez(path, reward=[0.0, 1.0])
      >>> load_arrays(path, "reward", "terminal")
      {'reward': array([0., 1.])}
    """
    return read_archive(path, names)


def load_policy(path: str | os.PathLike) -> Float[np.ndarray, "S A"]:
    """Reads a policy [S, A].

    Raises:
      FileError: as `load_mdp`.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "policy.npz")
      >>> np.savez(path, policy=[[0.5, 0.5], [1.0, 0.0]])
      >>> load_policy(path).tolist()
      [[0.5, 0.5], [1.0, 0.0]]
    """
    arrays = read_archive(path)
    require_arrays(path, arrays, "policy")
    with errors_of(path):
        return _validated_policy(arrays["policy"])


def save_mdp(path: str | os.PathLike, mdp: MDP) -> None:
    """Writes a model, in the layout it has; `load_mdp` gives it back bit by bit.

    Names that Python writes as literals (texts, numbers, tuples of them) come back as they are, others as their texts.

    Raises:
      ValueError: if two names have the same text, and neither is a literal.
      OSError: if the file cannot be written.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "grid.npz")
      >>> save_mdp(path, jaxhom.gridworld(3).mdp)
      >>> load_mdp(path).num_states
      9
    """
    layout = {"transition": np.asarray(mdp.probability)} if mdp.is_dense else _fields(mdp, "next_state", "probability")
    allowed = _fields(mdp, "allowed") if mdp.restricts_actions else {}
    names = {name: names_as_array(getattr(mdp, name)) for name in ("state_names", "action_names") if mdp[name]}
    write_archive(path, {**layout, **_fields(mdp, "initial", "features", "discount"), **allowed, **names})


def save_demonstrations(path: str | os.PathLike, demonstrations: Demonstrations) -> None:
    """Writes demonstrations.

    Raises:
      ValueError: if `mask` leaves a trajectory without a step.
      OSError: as `save_mdp`.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "walks.npz")
      >>> save_demonstrations(path, Demonstrations.from_trajectories([([0, 1], [1, 1])]))
      >>> load_demonstrations(path).states.tolist()
      [[0, 1]]
    """
    mask = np.asarray(demonstrations.mask)
    checks.require_all("mask", mask, np.any(mask, axis=1), "must be True on one step of each trajectory at least")
    length = mask.shape[1] - mask[:, ::-1].argmax(axis=1)
    answers = _fields(demonstrations, "is_answer") if np.asarray(demonstrations.is_answer).any() else {}
    fields = _fields(demonstrations, "states", "terminated", "final_states")
    hidden = (np.arange(mask.shape[1]) < length[:, None]) & ~mask
    actions = np.where(hidden, -1, demonstrations.actions)
    write_archive(path, {**fields, **answers, "actions": actions, "length": length})


def save_policy(path: str | os.PathLike, policy: Float[ArrayLike, "S A"], **extras: Shaped[ArrayLike, "..."]) -> None:
    """Writes a policy [S, A] and any further arrays by name.

    Raises:
      ValueError: if `policy` is none, or an extra has a reserved name or is no plain array.
      OSError: as `save_mdp`.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile, jaxhom
      >>> path = pathlib.Path(tempfile.mkdtemp(), "policy.npz")
      >>> save_policy(path, [[0.5, 0.5], [1.0, 0.0]], margin=0.25)
      >>> load_arrays(path, "margin")["margin"].tolist()
      0.25
    """
    checked = _validated_policy(checks.as_host_array("policy", policy))
    arrays = {name: checks.as_host_array(name, array) for name, array in extras.items()}
    for name, array in arrays.items():
        if name in ("file", "format_version", "allow_pickle"):
            raise ValueError(f"an array of a policy's file cannot be called {name!r}")
        if array.dtype.hasobject:
            raise ValueError(f"{name} must be a plain array, got dtype {array.dtype}")
    write_archive(path, {"policy": checked, **arrays})


def _validated_policy(policy: np.ndarray) -> np.ndarray:
    checks.require_shape("policy", policy, "[S, A] with S, A >= 1", policy.ndim == 2 and policy.size > 0)
    return checks.require_distribution("policy", policy)


def _fields(value, *names: str) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(value, name)) for name in names}
