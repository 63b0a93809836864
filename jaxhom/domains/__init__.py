"""The navigation domains of the paper as models (section VI), and a map for the states of any other model."""
