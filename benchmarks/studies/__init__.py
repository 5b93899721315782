"""The evidence for the base and for personal versions: studies whose rows are kept and resumed."""
