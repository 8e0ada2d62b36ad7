"""Studies that choose their cases: probabilities of rare violations, searches for failures, error budgets."""
