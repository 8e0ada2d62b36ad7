"""The helicopter field test of DIMES (Johnson, Willson, Goguen, Alexander & Meller, sections III and IV).

- `parameters`: parameters of campaigns
- `flown_run`, `imaging`: flight of a run with its camera, and the images
- `targets`, `target_detection`, `gyros`, `attitude`: surveyed targets, and attitudes from them and gyros
- `run`: simulation and processing of a run, and selection of its triples
- `measurement`, `conditions`, `scenario`: a case is one triple
"""
