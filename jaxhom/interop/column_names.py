"""What the columns of recorded steps are called: the roles, the usual names for each, and which column has which.

Case, blanks, dashes and underscores in names do not count. The same names are understood in text files, data frames,
dictionaries, archives of arrays and objects.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

NAMES: Mapping[str, tuple[str, ...]] = {
    "episode": (
        *("episode", "episodes", "episode_id", "episode_ids", "ep", "run"),
        *("trajectory", "trajectories", "trajectory_id", "traj", "traj_id"),
    ),
    "step": ("step", "steps", "t", "time", "timestep", "timesteps", "time_step", "step_id"),
    "state": ("state", "states", "s", "obs", "observation", "observations"),
    "action": ("action", "actions", "a", "act", "acts"),
    "next_state": (
        *("next_state", "next_states", "next", "next_s", "s_next", "s'", "s_prime", "new_state"),
        *("next_obs", "next_observation", "next_observations", "new_obs"),
    ),
    "terminated": ("terminated", "terminal", "terminals", "termination", "terminations", "is_terminal"),
    "truncated": ("truncated", "truncation", "truncations", "timeout", "timeouts"),
    "start": ("episode_start", "episode_starts", "is_first"),
}
# Names that mean a role only where no other column does.
WEAK: Mapping[str, tuple[str, ...]] = {"episode": ("id",), "terminated": ("done", "dones")}
ROLES = tuple(NAMES)


def plain(name: object) -> str:
    """A column's name without what does not count: `NextState`, `next state` and `next_state` are one."""
    return re.sub(r"[ _-]", "", str(name).strip()).lower()


_PLAIN = {role: frozenset(map(plain, names)) for role, names in NAMES.items()}
_PLAIN_WEAK = {role: frozenset(map(plain, names)) for role, names in WEAK.items()}
KNOWN = frozenset().union(*_PLAIN.values(), *_PLAIN_WEAK.values())
_ATTRIBUTES = tuple(sorted(set().union(*NAMES.values(), *WEAK.values())))


def fields_by_role(source: Any, columns: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The columns of a mapping, a data frame or an object by their roles; None counts as not there.

    Raises:
      ValueError: as `find_columns`.
    """
    fields = {role: field(source, name) for role, name in names_by_role(source, columns).items()}
    return {role: found for role, found in fields.items() if found is not None}


def names_by_role(source: Any, columns: Mapping[str, str] | None = None) -> dict[str, Any]:
    """What the columns of a mapping, a data frame or an object are called, by their roles.

    Raises:
      ValueError: as `find_columns`.
    """
    attributes = (*_ATTRIBUTES, *(columns or {}).values())
    names = list(source) if is_keyed(source) else [name for name in attributes if _is_field(source, name)]
    found = _found(tuple(map(str, names)), tuple(sorted((columns or {}).items())))
    return {role: names[place] for role, place in found.items()}


def is_keyed(source: Any) -> bool:
    """Whether something has columns by name: a mapping or a data frame."""
    return isinstance(source, Mapping) or (hasattr(source, "columns") and hasattr(source, "__getitem__"))


def field(source: Any, name: Any) -> Any:
    """The column of one name, None if there is none."""
    if is_keyed(source):
        return source[name] if name in source else None  # noqa: SIM401 (data frames have no `get` of this kind)
    return getattr(source, name, None)


def _is_field(source: Any, name: str) -> bool:
    value = getattr(source, name, None)
    return value is not None and not callable(value)


@functools.lru_cache(256)
def _found(names: tuple[str, ...], columns: tuple[tuple[str, str], ...]) -> dict[str, int]:
    return find_columns(names, dict(columns))


def find_columns(names: Sequence[str], columns: Mapping[str, str] | None = None) -> dict[str, int]:
    """Where the columns of each role stand among the given names.

    Args:
      names: of all columns.
      columns: what the caller says that some are called, by their roles.

    Raises:
      ValueError: if two columns could have one role; if `columns` names a role that there is none of, or a column.
    """
    columns = dict(columns or {})
    for role in columns:
        if role not in ROLES:
            raise ValueError(f"columns: there is no role {role!r}, but {', '.join(ROLES)}")
    plainly = [plain(name) for name in names]
    places = {}
    for role in ROLES:
        found = _places(plainly, role, columns)
        if len(found) > 1:
            called = " and ".join(repr(names[place].strip()) for place in found)
            use = f"keep one, or say which by columns={{{role!r}: ...}}"
            raise ValueError(f"columns {called} could both be the {role.replace('_', ' ')}: {use}")
        if found:
            places[role] = found[0]
    return places


def _places(names: Sequence[str], role: str, columns: Mapping[str, str]) -> list[int]:
    """Where the columns stand that could have a role."""
    taken = {plain(name) for other, name in columns.items() if other != role}
    if role in columns:
        found = [place for place, name in enumerate(names) if name == plain(columns[role])]
        if not found:
            raise ValueError(f"columns[{role!r}]: there is no column {columns[role]!r}, but {listed(names)}")
        return found
    for known in (_PLAIN[role], _PLAIN_WEAK.get(role, frozenset())):
        found = [place for place, name in enumerate(names) if name in known and name not in taken]
        if found:
            return found
    return []


def listed(names: Iterable[str]) -> str:
    """Names for a message."""
    return ", ".join(map(repr, names)) or "nothing"
