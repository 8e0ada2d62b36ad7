"""Parachute descent over Mars with a downward camera: the scenario of DIMES.

Modules in the order of a case: `parameters`, `world`, `flight`, `optics`, `exposure`, `measurement`, `score`;
`scenario` runs them.
"""
