"""How parameters vary over a campaign's cases: distributions, formulas, correlated groups, designs."""
