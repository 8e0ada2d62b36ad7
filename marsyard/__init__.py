"""Marsyard: a virtual Mars Yard that runs vision software through rendered, truth-known cases, and says whether it holds."""
