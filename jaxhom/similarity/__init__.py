"""How well a state's local model maps onto another's: LP (9), its classes, brackets, decisions, maps (section V)."""
