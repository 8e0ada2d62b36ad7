"""The helicopter field test of DIMES (Johnson, Willson, Goguen, Alexander & Meller, sections III and IV).

Read it in the order of the paper: `parameters`; a `run` with its flight, `targets`, `attitude`, `drift`, `elevation`
and `ephemeris`; its `triples`; the `pictures` of one of them; and the `scenario`, whose case i is one triple.
"""
