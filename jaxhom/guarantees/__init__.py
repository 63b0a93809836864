"""How much a policy can lose against an expert whose reward is not known, and where to ask the expert next."""
