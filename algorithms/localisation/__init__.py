"""Localisation of a lander on a map from descent images and inertial data (terrain-relative navigation)."""
