"""Gymnasium environments by their id, with options that mean what they say.

Gymnasium takes most options without a look: `is_slippery="false"` would be a text, which counts as true. So the names
are held against the constructor's, and what is on or off there has to be on or off here.
"""

from __future__ import annotations

import inspect
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks

if TYPE_CHECKING:
    import gymnasium


def make_environment(name: str, **options: Any) -> gymnasium.Env:
    """Makes a Gymnasium environment.

    Args:
      name: its id, `"FrozenLake-v1"`.
      **options: what its constructor takes, `is_slippery=False`.

    Returns:
      The environment.

    Raises:
      ValueError: if there is no such environment, it lacks an option, one that is on or off is given something else
        (a text would count as on, whatever it says), or it refuses the options.
      ImportError: if Gymnasium is not installed.

    Outside jit, vmap and grad only.

    Example:
      >>> env = make_environment("FrozenLake-v1", is_slippery=False)
      >>> print(*(int(outcome[1]) for outcome in env.unwrapped.P[0][1]))  # from state 0, by action 1: down
      4
    """
    try:
        import gymnasium
    except ImportError as error:
        raise ImportError(
            f"making {name!r} needs gymnasium, which is not installed: pip install '.[interop]'"
        ) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the version is the caller's choice
            _require_options(gymnasium, name, options)
            return gymnasium.make(name, **options)
    except gymnasium.error.Error as error:
        reason = checks.first_line(error)
    except _OptionError as error:
        raise ValueError(f"environment {name!r}: {error}") from None
    except Exception as error:  # constructors raise what they come upon
        reason = f"{type(error).__name__} {' '.join(str(error).split())}"
    given = f" with {', '.join(f'{key}={value!r}' for key, value in options.items())}" if options else ""
    raise ValueError(f"environment {name!r} cannot be made{given}: {reason}")


class _OptionError(ValueError):
    """An option that an environment does not have, or that cannot mean what it says."""


def _require_options(library, name: str, options: dict) -> None:
    """Raises on an option that a constructor does not name, and on one that is on or off and neither."""
    if not options:
        return
    known = _parameters(library.envs.registration.load_env_creator, library.spec(name).entry_point)
    if known is None:
        return
    of_make = inspect.signature(library.make).parameters
    for option, value in options.items():
        if option not in known and option not in of_make:
            raise _OptionError(f"it has no option {option!r}; it has {', '.join(known) or 'none'}")
        default = known[option].default if option in known else None
        if isinstance(default, bool) and not (isinstance(value, bool | np.bool_) or value in (0, 1)):
            raise _OptionError(f"{option} must be true or false, got {value!r}")


def _parameters(load, entry_point) -> dict | None:
    """The named parameters of what makes an environment; None where they are not known, or any name will do."""
    try:
        parameters = inspect.signature(load(entry_point) if isinstance(entry_point, str) else entry_point).parameters
    except (TypeError, ValueError):
        return None
    kinds = {parameter.kind for parameter in parameters.values()}
    return None if inspect.Parameter.VAR_KEYWORD in kinds else dict(parameters)
