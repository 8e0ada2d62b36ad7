"""Marsyard, a virtual Mars Yard: runs vision software through rendered, truth-known cases and says whether it holds."""
