"""The command line: `python -m jaxhom` runs the main job, `python -m jaxhom learn` a user's own problem."""
