"""Parachute descent over Mars with three pictures: DIMES' scenario.

Read it in the order of a case: `parameters`, `world`, `flight`, `optics`, `exposure`, `measurement`, `score`;
`scenario` runs them one after the other.
"""
