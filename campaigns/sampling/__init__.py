"""Variation of parameters over a campaign's cases: distributions, formulas, correlated groups, designs."""
