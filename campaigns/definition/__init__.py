"""Definition of a campaign: its checked file, the parameters of each case, and its identity."""
