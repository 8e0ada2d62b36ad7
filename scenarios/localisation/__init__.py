"""Localisation scenario: a lander estimates its position on a map made from orbital images."""
