"""The helicopter field test of DIMES (Johnson, Willson, Goguen, Alexander & Meller, sections III and IV).

Modules in the order of the paper: `parameters`; a `run` with its `attitude`, sun and triples; and the `scenario`, whose
case i is one triple.
"""
