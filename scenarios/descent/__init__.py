"""Parachute descent over Mars with a downward camera: the scenario of DIMES.

Modules in the order of a case: `parameters`, `flight`, `exposure`, `measurement`, `score`; `scenario` runs them.
"""
