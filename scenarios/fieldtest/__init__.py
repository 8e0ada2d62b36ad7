"""The helicopter field test of DIMES.

The paper is Johnson, Willson, Goguen, Alexander & Meller, "Field Testing of the MER DIMES", sections III and IV.

- `parameters`: parameters of campaigns
- `flight`, `sun_position`, `images`: flight of a run with its camera, direction to the sun, and the images
- `targets`, `attitude`: surveyed targets, and attitudes from them and gyros
- `run`, `triples`: simulation and processing of a run, and selection of its triples
- `measurements`, `conditions`, `scenario`: a case is one triple
"""
