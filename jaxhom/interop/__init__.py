"""Ways in and out: files of models, demonstrations and policies."""

from jaxhom.interop.files import (
    FileError,
    load_demonstrations,
    load_mdp,
    load_policy,
    save_demonstrations,
    save_mdp,
    save_policy,
)

__all__ = [
    "FileError",
    "load_demonstrations",
    "load_mdp",
    "load_policy",
    "save_demonstrations",
    "save_mdp",
    "save_policy",
]
