"""From feature expectations to a policy that earns them whatever the weights: LPAL and its methods (section III)."""
