"""Campaigns run, gone on with and estimated; single cases run again."""
