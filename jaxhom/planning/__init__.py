"""What a policy is worth in a model: occupancies, values, optimal policies, trials, and their derivatives."""
