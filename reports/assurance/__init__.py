"""Assurance package: the argument for the verdicts of campaigns, with all its evidence, in one folder."""
