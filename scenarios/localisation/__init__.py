"""Localisation of a lander on a map: flight, instruments and measurement stream of the scenario."""
