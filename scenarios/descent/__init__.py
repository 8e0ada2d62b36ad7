"""Parachute descent over Mars with a downward camera: the scenario of DIMES.

Modules in the order of a case: `parameters` and `faults`, `world`, `flight` (or a `recorded` one), `images`,
`measurements`, `conditions`, `overlap`, `touchdown`; `simulation` runs those without an algorithm, `scenario` all.
"""
