"""Localisation of a lander on a map: sites, map product, flight, instruments, scenario and scoring."""
