"""The helicopter field test of DIMES (Johnson, Willson, Goguen, Alexander & Meller, sections III and IV).

- `parameters`: parameters of campaigns
- `imaging`: camera, sun, scene and exposure
- `targets`, `attitude`: detection of surveyed targets, and estimation of attitudes from the targets and gyros
- `run`: simulation and processing of a run, and selection of its triples
- `scenario`: a case is one triple
"""
